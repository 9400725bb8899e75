"""Change one operator or number at a time, and see whether a test notices.

For each mutant of the given modules a child process is forked, in which the module is replaced and
its tests run until one fails. What survives is printed with its line; why each of those may is
written in `docs/decisions/mutants.md`. The safety rules take some ten minutes on one core.

    python benchmarks/mutants.py safety states stop

Changed are comparisons, `and` and `or`, `not`, signs, sums and products, numbers and truth values;
not texts, nor types, nor what only goes into a message.
"""

import argparse
import ast
import contextlib
import copy
import importlib.util
import io
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import equipoise.model.arms.iiwa

ROOT = Path(__file__).resolve().parent.parent
ROOM = "equipoise.control"
TESTS = {
    "safety": ["test_safety.py"],
    "states": ["test_states.py"],
    "stop": ["test_stop.py"],
    "release": ["test_release.py"],
}
"""The tests of each module, in tests/control."""
LONGEST = 60
"""A mutant whose tests take longer than this has been noticed [s]."""
SWAPS: dict[type, list[type]] = {
    ast.Lt: [ast.LtE, ast.Gt],
    ast.LtE: [ast.Lt, ast.Gt],
    ast.Gt: [ast.GtE, ast.Lt],
    ast.GtE: [ast.Gt, ast.Lt],
    ast.Eq: [ast.NotEq],
    ast.NotEq: [ast.Eq],
    ast.Is: [ast.IsNot],
    ast.IsNot: [ast.Is],
    ast.In: [ast.NotIn],
    ast.NotIn: [ast.In],
    ast.And: [ast.Or],
    ast.Or: [ast.And],
    ast.Add: [ast.Sub],
    ast.Sub: [ast.Add],
    ast.Mult: [ast.Div],
    ast.Div: [ast.Mult],
    ast.Pow: [ast.Mult],
}


def main() -> int:
    """Run every mutant of the chosen modules."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("modules", nargs="*", default=list(TESTS))
    survivors = total = 0
    for module in parser.parse_args().modules:
        path = ROOT / "src" / ROOM.replace(".", "/") / f"{module}.py"
        for line, change, tree in mutants(path.read_text()):
            total += 1
            if not noticed(module, path, tree):
                survivors += 1
                print(f"{module}.py:{line}: {change}", flush=True)
    print(f"{total} mutants, {survivors} survived")
    return 1 if survivors else 0


def mutants(source: str) -> Iterator[tuple[int, str, ast.Module]]:
    """Yield line, change and tree of each mutant."""
    tree = ast.parse(source)
    for number, node in enumerate(places(tree)):
        for change in changes(node):
            mutant = copy.deepcopy(tree)
            there = list(places(mutant))[number]
            before = ast.unparse(there)
            next(c for c in changes(there) if c == change)[1](there)
            yield node.lineno, f"{before}  ->  {ast.unparse(there)}", mutant


def places(node: ast.AST) -> Iterator[ast.expr]:
    """Yield every expression that counts, outer ones first."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or isinstance(child, ast.JoinedStr):
                continue
            if isinstance(child, ast.expr):
                yield child
            yield from places(child)


class Change(tuple[str, object]):
    """A name and a function that makes the change; equal by name."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Change) and self[0] == other[0]

    def __hash__(self) -> int:
        return hash(self[0])


def changes(node: ast.expr) -> Iterator[Change]:
    """Yield what can be changed at an expression."""

    def put(field, value):
        def apply(there):
            if field == "ops":
                there.ops[value[0]] = value[1]()
            else:
                setattr(there, field, value() if isinstance(value, type) else value)

        return apply

    match node:
        case ast.Compare():
            for i, op in enumerate(node.ops):
                for other in SWAPS.get(type(op), []):
                    yield Change((f"{i}{other.__name__}", put("ops", (i, other))))
        case ast.BoolOp() | ast.BinOp():
            for other in SWAPS.get(type(node.op), []):
                yield Change((other.__name__, put("op", other)))
        case ast.UnaryOp(op=ast.USub() | ast.Not()):
            # In front of a truth value, + takes the `not` away.
            yield Change(("plus", put("op", ast.UAdd)))
        case ast.Constant(value=bool()):
            yield Change(("flip", put("value", not node.value)))
        case ast.Constant(value=int() | float()):
            for other in (node.value * 1.02 + (node.value == 0), node.value + 1):
                yield Change((f"{other}", put("value", other)))
        case _:
            pass


def noticed(module: str, path: Path, tree: ast.Module) -> bool:
    """Run the tests of a mutant in a child, and return whether one failed."""
    child = os.fork()
    if child:
        return os.waitpid(child, 0)[1] != 0
    signal.alarm(LONGEST)
    code = 1
    # Whatever a mutant raises, it has been noticed.
    with contextlib.suppress(BaseException), contextlib.redirect_stdout(io.StringIO()):
        name = f"{ROOM}.{module}"
        spec = importlib.util.spec_from_file_location(name, path)
        mutated = importlib.util.module_from_spec(spec)
        sys.modules[name] = mutated
        exec(compile(ast.fix_missing_locations(tree), str(path), "exec"), mutated.__dict__)
        tests = [str(ROOT / "tests" / "control" / test) for test in TESTS[module]]
        options = ["-x", "-q", "-p", "no:cacheprovider", "--hypothesis-seed=1"]
        code = int(pytest.main([*options, *tests]))
    os._exit(code)


if __name__ == "__main__":
    # Generated code is imported before the forks, so that no child has to.
    equipoise.model.arms.iiwa.iiwa(14).kinematics((0.1,) * 6)
    sys.exit(main())
