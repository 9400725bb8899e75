"""Change one thing of a module at a time, and see whether a test notices.

For each mutant of the given modules a child process is forked, in which the module is replaced and
its tests run until one fails. What survives is printed with its line; why each of those may is
written in `benchmarks/README.md`. All of them take an hour on one core.

    python benchmarks/mutants.py rules trial stop

Changed are comparisons, `and` and `or`, `not`, conditions, signs, sums and products, numbers, truth
values, bytes and words (the lines of a protocol), `min`, `max`, `abs`, `any` and `all`; calls for
their effect, and assignments to attributes and items, are left out. Not changed are types, names of
enumerations, and what only goes into a message.

Nothing is compiled: machine code of a mutant would be taken for that of its module later on.
"""

import argparse
import ast
import contextlib
import copy
import gc
import importlib.util
import io
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

os.environ |= {"NUMBA_DISABLE_JIT": "1", "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}

import hypothesis.stateful
import hypothesis.strategies
import pytest
import scipy.linalg  # noqa: F401  (imported before the forks, so that no child has to)

import equipoise.arm.iiwa
import equipoise.model.encoder
import equipoise.model.worlds  # noqa: F401

ROOT = Path(__file__).resolve().parent.parent
MODULES = {
    "rules": "safety/rules",
    "trial": "safety/trial",
    "monitors": "safety/monitors",
    "stop": "safety/stop",
    "release": "rig/release",
    "kst": "robots/kst/codec",
    "encoder": "robots/encoder/codec",
}
"""Where each module and its tests lie."""
PLUGINS_LEFT_OUT = ("cacheprovider", "doctest", "unraisableexception", "threadexception")
OPTIONS = (
    *("-x", "-q", "--tb=no", "--noconftest", "--assert=plain", "--hypothesis-profile=mutants"),
    *("-o", "addopts=--import-mode=importlib", "-m", "not slow and not compiled_only"),
    *(f"-pno:{plugin}" for plugin in PLUGINS_LEFT_OUT),
    "-p_hypothesis_pytestplugin",
)
hypothesis.settings.register_profile(
    "mutants", max_examples=20, derandomize=True, database=None, deadline=None
)
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
    ast.MatMult: [ast.Mult],
    ast.Div: [ast.Mult],
    ast.Mod: [ast.Mult],
    ast.Pow: [ast.Mult],
    ast.LShift: [ast.RShift],
    ast.RShift: [ast.LShift],
    ast.BitAnd: [ast.BitOr],
    ast.BitOr: [ast.BitAnd],
    ast.BitXor: [ast.BitOr],
}
NAMES = {"min": "max", "max": "min", "abs": "float", "any": "all", "all": "any"}


def main() -> int:
    """Run every mutant of the chosen modules."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("modules", nargs="*", default=list(MODULES), choices=list(MODULES))
    survived = False
    for module in parser.parse_args().modules:
        path = (ROOT / "src/equipoise" / MODULES[module]).with_suffix(".py")
        tests = (ROOT / "tests" / MODULES[module]).with_name(f"test_{path.name}")
        began = time.monotonic()
        if noticed(path, tests, ast.parse(path.read_text()), 600.0):
            print(f"{module}: its tests fail as it is")
            return 2
        # A mutant that takes far longer than that has been noticed.
        longest = 5.0 + 3.0 * (time.monotonic() - began)
        total = survivors = 0
        for line, change, tree in mutants(path.read_text()):
            total += 1
            if not noticed(path, tests, tree, longest):
                survivors += 1
                print(f"{module}:{line}: {change}", flush=True)
        print(f"{module}: {total} mutants, {survivors} survived", flush=True)
        survived = survived or survivors > 0
    return int(survived)


def mutants(source: str) -> Iterator[tuple[int, str, ast.Module]]:
    """Yield line, change and tree of each mutant."""
    tree = ast.parse(source)
    for number, node in enumerate(places(tree)):
        for choice in range(len(changes(node))):
            mutant = copy.deepcopy(tree)
            there = list(places(mutant))[number]
            before = ast.unparse(there)
            changes(there)[choice]()
            yield (
                getattr(there, "lineno", 0),
                f"{before.splitlines()[0]}  ->  {ast.unparse(there).splitlines()[0]}",
                ast.fix_missing_locations(mutant),
            )


def places(node: ast.AST) -> Iterator[ast.AST]:
    """Yield every node that counts, outer ones first."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            match child:
                case ast.JoinedStr() | ast.Raise() | ast.Expr(value=ast.Constant()):
                    continue
                case ast.Subscript(value=ast.Name(id="Literal")):
                    continue
                case ast.Assign(value=ast.Constant(value=str())) if isinstance(node, ast.ClassDef):
                    continue
                case ast.AST():
                    yield child
                    yield from places(child)


def changes(node: ast.AST) -> list[Callable[[], None]]:
    """Return what can be done to a node."""

    def put(field: str, *values: object) -> list[Callable[[], None]]:
        return [partial(setattr, node, field, value) for value in values]

    match node:
        case ast.Compare():
            return [
                partial(node.ops.__setitem__, i, other())
                for i, op in enumerate(node.ops)
                for other in SWAPS[type(op)]
            ]
        case ast.BoolOp() | ast.BinOp() | ast.AugAssign():
            return put("op", *(other() for other in SWAPS[type(node.op)]))
        case ast.UnaryOp(op=ast.USub() | ast.Not()):
            # In front of a truth value, + takes the `not` away.
            return put("op", ast.UAdd())
        case (
            ast.If(test=ast.Name() | ast.Attribute() | ast.Call())
            | ast.IfExp(test=ast.Name() | ast.Attribute() | ast.Call())
        ):
            return put("test", ast.UnaryOp(ast.Not(), node.test))
        case ast.comprehension(ifs=[_, *_]):
            return put("ifs", [])
        case ast.Expr(value=ast.Call()):
            return put("value", ast.Constant(None))
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]):
            return put("targets", [ast.Name("_", ast.Store())])
        case ast.Name(id=name) if name in NAMES:
            return put("id", NAMES[name])
        case ast.Constant(value=bool()):
            return put("value", not node.value)
        case ast.Constant(value=int()):
            return put("value", node.value + 1, node.value - 1)
        case ast.Constant(value=float()):
            return put("value", *{node.value * 1.02, node.value + 1.0} - {node.value})
        case ast.Constant(value=bytes()):
            return put("value", node.value + b"z")
        case ast.Constant(value=str()) if node.value.isidentifier():
            return put("value", node.value + "z")
        case _:
            return []


def noticed(path: Path, tests: Path, tree: ast.Module, longest: float) -> bool:
    """Run the tests of a mutant in a child, and return whether one failed."""
    child = os.fork()
    if child:
        return os.waitpid(child, 0)[1] != 0
    signal.setitimer(signal.ITIMER_REAL, longest)
    code = 1
    # Whatever a mutant raises, it has been noticed.
    with (
        contextlib.suppress(BaseException),
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(io.StringIO()),
    ):
        name = ".".join(path.relative_to(ROOT / "src").with_suffix("").parts)
        mutated = importlib.util.module_from_spec(
            importlib.util.spec_from_file_location(name, path)
        )
        sys.modules[name] = mutated
        exec(compile(tree, str(path), "exec"), mutated.__dict__)
        code = int(pytest.main([*OPTIONS, str(tests)]))
    os._exit(code)


if __name__ == "__main__":
    gc.freeze()
    sys.exit(main())
