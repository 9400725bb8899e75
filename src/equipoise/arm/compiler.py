"""Generator of straight-line kinematics from the constants of a chain.

`trace` runs a plain recursion from the base to the flange on symbols instead of numbers. Constants
are folded (most entries of an arm's constant rotations are 0, 1 or -1), equal expressions become
one, and expressions that no entry of the record needs are not written. `source` prints the rest as
a Python module with two functions of `(q, dq, frame, lanes)`, without small matrices: one loop over
the lanes each. `kinematics` writes the whole record, with some 300 operations and six pairs of sine
and cosine for an iiwa; `motion` writes position, rotation and twist alone, with equal bits.

The module of an arm is named by the digest of its geometry and has no file: see `docs/decisions`.

A `Tape` records sums and products of inputs and numbers. Numbers are folded, signs are moved
outwards and cancelled, and the operands of + and * are kept in one order. Equal expressions are one
object, so each is computed once. `fuse` joins products that one sum needs to it, as fused
multiply-adds. `statements` prints the expressions that the outputs need.

The kinematics writes one record of `FRAME_SIZE` rows for each lane of a block (see
`equipoise.elementary`), all in base axes::

    POSITION  0:3    position of the flange [m]
    ROTATION  3:12   R, flange to base, row by row
    TWIST    12:18   J dq: linear [m/s], angular [rad/s]
    J_DOT_DQ 18:24   J_dot dq [m/s^2], [rad/s^2]
    JACOBIAN 24:60   J, row by row, linear rows first
"""

import functools
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from equipoise.arm.chain import FREE_JOINTS, Link, links
from equipoise.arrays import Array
from equipoise.elementary import BATCH_SIZE
from equipoise.jit import compilable, pointer

if TYPE_CHECKING:
    from equipoise.arm.arm import Arm

KinematicsFunction = Callable[[Any, Any, Any, int], None]
"""Function kinematics(q, dq, frame, lanes): reads blocks of joint angles [rad] and velocities
[rad/s] and writes the records of the first `lanes` lanes."""


POSITION, ROTATION, TWIST, J_DOT_DQ, JACOBIAN = PARTS = (0, 3, 12, 18, 24)
"""First row of each part of a record."""
FRAME_SIZE: Final = 60
"""Number of rows of a record."""

FUNCTION: Final = """
def {name}(q, dq, frame, lanes):
    for n in range(lanes):
{body}
"""

Vector = Any
"""Three symbols as an array of NumPy, whose types know numbers alone, shape (3,)."""
Record = Mapping[str, "Symbol"]
"""Symbol of each target, such as an entry of the record."""


@dataclass(eq=False)
class Symbol:
    """A number, an input, or an operation on other symbols."""

    tape: "Tape"
    """Symbols of the same computation."""
    operation: str
    """`number`, `neg`, `*`, `+` or `-`; of an input its name."""
    operands: "tuple[Symbol, ...]"
    """Symbols that the operation takes."""
    number: float
    """Value of a number."""
    order: int
    """Place in the order of creation."""
    fused: bool = False
    """Whether it is a term of the one sum that needs it."""

    def __neg__(self) -> "Symbol":
        if self.operation == "number":
            return self.tape.number(-self.number)
        return self.operands[0] if self.operation == "neg" else self.tape.symbol("neg", self)

    def __mul__(self, other: "Symbol") -> "Symbol":
        a, b = sorted((self, other), key=lambda s: (s.operation != "number", s.order))
        if a.operation == "number":
            if b.operation == "number":
                return self.tape.number(a.number * b.number)
            if a.number == 0.0:
                return a
            if a.number == 1.0:
                return b
            if a.number < 0.0:
                return -(-a * b)
        if a.operation == "neg":
            return -(a.operands[0] * b)
        if b.operation == "neg":
            return -(a * b.operands[0])
        return self.tape.symbol("*", a, b)

    def __add__(self, other: "Symbol") -> "Symbol":
        a, b = sorted((self, other), key=lambda s: (s.operation != "number", s.order))
        if b.operation == "number":
            return self.tape.number(a.number + b.number)
        if a.operation == "number" and a.number == 0.0:
            return b
        if a.operation == b.operation == "neg":
            return -(-a + -b)
        if "neg" not in (a.operation, b.operation):
            return self.tape.symbol("+", a, b)
        plus, minus = (a, -b) if b.operation == "neg" else (b, -a)
        return self.tape.symbol("-", plus, minus)

    def __sub__(self, other: "Symbol") -> "Symbol":
        return self + -other

    def __str__(self) -> str:
        """Return the number, or the name that holds the result."""
        if self.operation == "number":
            return repr(self.number)
        if self.operation == "neg":
            return f"-{self.operands[0]}"
        return f"t{self.order}" if self.operands else self.operation

    def formula(self) -> str:
        """Return a product or a sum as Python; a fused product of a sum is a multiply-add."""
        if self.operation == "*":
            return "{} * {}".format(*self.operands)
        terms = sorted(self._terms(), key=lambda term: term[0])  # positive ones first
        rest = [(sign, term) for sign, term in terms if not term.fused]
        products = [(sign, term) for sign, term in terms if term.fused]
        (sign, first), *rest = rest or [products.pop(0)]
        text = f"{sign}{first.formula() if first.fused else first}"
        text += "".join(f" {sign or '+'} {term}" for sign, term in rest)
        for sign, product in products:
            a, b = product.operands
            text = f"fma({sign}{a}, {b}, {text})"
        return text

    def _terms(self, sign: str = "") -> "Iterator[tuple[str, Symbol]]":
        """Yield the terms of a sum with their signs, those of its fused sums included."""
        other = "" if sign else "-"
        a, b = self.operands
        for term, own in ((a, sign), (b, other if self.operation == "-" else sign)):
            if term.fused and term.operation in "+-":
                yield from term._terms(own)
            else:
                yield own, term


class Tape:
    """Symbols of one computation, in order of creation."""

    def __init__(self) -> None:
        self.symbols: dict[tuple[object, ...], Symbol] = {}

    def number(self, value: float) -> Symbol:
        """Return a constant."""
        return self.symbol("number", number=float(value) + 0.0)  # no negative zero

    def symbol(self, operation: str, *operands: Symbol, number: float = 0.0) -> Symbol:
        """Return the one symbol of this operation on these operands; an input's is its name."""
        key = (operation, number, *operands)
        if key not in self.symbols:
            self.symbols[key] = Symbol(self, operation, operands, number, len(self.symbols))
        return self.symbols[key]


def fuse(record: Record) -> None:
    """Make sums and products that only one sum of a record needs terms of that sum."""
    users = _users(record)
    for symbol in users:
        for term in symbol.operands if symbol.operation in ("+", "-") else ():
            if users[term] == 1 and term.operation in ("+", "-", "*"):
                term.fused = True


def statements(record: Record) -> Iterator[str]:
    """Yield the lines that compute a record, without expressions that it does not need."""
    for symbol in sorted(_users(record), key=lambda symbol: symbol.order):
        if symbol.operation in "+-*" and not symbol.fused:
            yield f"{symbol} = {symbol.formula()}"
    yield from (f"{target} = {symbol}" for target, symbol in record.items())


def _users(record: Record) -> dict[Symbol, int]:
    """Return the symbols that a record needs, with the number of uses of each."""
    users: dict[Symbol, int] = {}
    pending = list(record.values())
    while pending:
        symbol = pending.pop()
        users[symbol] = users.get(symbol, 0) + 1
        if users[symbol] == 1:
            pending.extend(symbol.operands)
    return users


def trace(steps: Sequence[Link]) -> Record:
    """Run the kinematics of a chain on symbols.

    Must equal Pinocchio and MuJoCo.

    Args:
        steps: Steps to the six free joints and to the flange.

    Returns:
        The symbols of the entries of the record.
    """
    tape, joints = Tape(), range(FREE_JOINTS)
    pairs = [(tape.symbol(f"s{i}"), tape.symbol(f"c{i}")) for i in joints]
    dq = [tape.symbol(f"dq{i}") for i in joints]

    def constant(vector: Array) -> Vector:
        return np.array([tape.number(entry) for entry in vector])

    def along(axes: Sequence[Vector], vector: Array) -> Vector:
        (x, y, z), (a, b, c) = axes, constant(vector)
        return x * a + y * b + z * c

    zero = constant(np.zeros(3))
    axes = [constant(axis) for axis in np.eye(3)]  # R, by columns
    w, w_dot, v, v_dot = zero, zero, zero, zero  # of the frame, at q_ddot = 0
    r, z = list[Vector](), list[Vector]()  # from frame to frame, and the axes of the joints
    for i, link in enumerate(steps):
        # To the next frame: v += w x r, v_dot += w_dot x r + w x (w x r), R = R R'.
        step = along(axes, link.translation)
        velocity = np.cross(w, step)
        v, v_dot = v + velocity, v_dot + (np.cross(w_dot, step) + np.cross(w, velocity))
        r.append(step)
        axes = [along(axes, column) for column in link.rotation.T]
        if i == FREE_JOINTS:
            break
        # Joint i turns: w_dot += w x z dq, w += z dq, R = R R_z(q).
        (rest_x, rest_y, axis), (s, c) = axes, pairs[i]
        turn = axis * dq[i]
        w_dot, w = w_dot + np.cross(w, turn), w + turn
        axes = [rest_x * c + rest_y * s, rest_y * c + rest_x * -s, axis]
        z.append(axis)
    # Column i of J: z_i x (from joint i to the flange), over z_i.
    reach, columns = zero, list[tuple[Symbol, ...]]()
    for i in reversed(joints):
        reach = r[i + 1] + reach
        columns.insert(0, (*np.cross(z[i], reach), *z[i]))
    rotation = [axis[row] for row in range(3) for axis in axes]
    J = [column[row] for row in range(6) for column in columns]
    entries = [*(r[0] + reach), *rotation, *v, *w, *v_dot, *w_dot, *J]
    return {f"frame[{_entry(row)}]": symbol for row, symbol in enumerate(entries)}


def source(arm: "Arm") -> str:
    """Return the module of an arm as text."""
    record = trace(links(arm))
    fuse(record)
    moving = dict(list(record.items())[:J_DOT_DQ])
    inputs = [f"s{i}, c{i} = sincos(q[{_entry(i)}])" for i in range(FREE_JOINTS)]
    inputs += [f"dq{i} = dq[{_entry(i)}]" for i in range(FREE_JOINTS)]
    text = "from equipoise.elementary import fma, sincos\n"
    for name, entries in (("kinematics", record), ("motion", moving)):
        body = "\n".join(f"        {line}" for line in (*inputs, *statements(entries)))
        text += FUNCTION.format(name=name, body=body)
    return text


@functools.lru_cache(maxsize=64)
def load(arm: "Arm") -> tuple[KinematicsFunction, KinematicsFunction]:
    """Return the functions of an arm, plain functions of a module.

    Returns:
        `kinematics`, which writes whole records, and `motion`, which writes position, rotation and
        twist with the same bits.
    """
    name = f"equipoise_arm_{arm.digest.removeprefix('sha256:')}"
    if name not in sys.modules:
        module = ModuleType(name)
        exec(compile(source(arm), f"{name}.py", "exec"), vars(module))
        sys.modules[name] = module  # where Numba looks when it loads the machine code again
    module = sys.modules[name]
    return module.kinematics, module.motion


@functools.cache
def addresses(arm: "Arm") -> tuple[int, int]:
    """Return the addresses of `kinematics` and `motion` of an arm, compiled or loaded, for kernels.

    Blocks are flat arrays there: of 6, 6 and `FRAME_SIZE` rows.
    """
    kinematics, motion = map(_address, load(arm))
    return kinematics, motion


def _address(function: KinematicsFunction) -> int:
    generated = compilable(function)

    def kinematics(q: Array, dq: Array, frame: Array, lanes: int) -> None:
        generated(q, dq, frame, lanes)

    block = np.zeros(1)
    return pointer(kinematics, block, block, block, 0)


def _entry(row: int) -> str:
    """Return the index of a row of a block, in lane n."""
    return f"{row * BATCH_SIZE} + n" if row else "n"
