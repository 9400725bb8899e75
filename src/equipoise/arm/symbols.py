"""Symbolic expressions that are simplified as they are built.

A `Tape` records sums and products of inputs and numbers. Numbers are folded, signs are moved
outwards and cancelled, and the operands of + and * are kept in one order. Equal expressions are one
object, so each is computed once. `Tape.fuse` joins products that one sum needs to it, as fused
multiply-adds. `Tape.python` prints the expressions that the outputs need.
"""

from collections.abc import Iterator, Mapping
from typing import Any

Vector = Any
"""Three symbols as an array of NumPy, whose types know numbers alone, shape (3,)."""


class Symbol:
    """A number, an input, or an operation on other symbols."""

    def __init__(
        self, tape: "Tape", operation: str, operands: "tuple[Symbol, ...]", number: float = 0.0
    ) -> None:
        self.tape, self.operation, self.operands, self.number = tape, operation, operands, number
        self.order, self.block = len(tape.symbols), tape.block
        self.name = ""
        self.fused = False
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
            if b.operation == "*" and b.operands[0].operation == "number":
                return (a * b.operands[0]) * b.operands[1]
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
        if plus is minus:
            return self.tape.number(0.0)
        if ("-", minus, plus) in self.tape.symbols:
            return -self.tape.symbol("-", minus, plus)
        return self.tape.symbol("-", plus, minus)

    def __sub__(self, other: "Symbol") -> "Symbol":
        return self + -other

    def __str__(self) -> str:
        """Return the name, or the formula of an unnamed symbol."""
        return self.name or self.formula()

    def formula(self) -> str:
        """Return the expression itself as Python."""
        match self.operation, self.operands:
            case "number", _:
                return repr(self.number)
            case formula, ():
                return formula
            case "neg", (a,):
                return f"-{a._inside()}"
            case "*", (a, b):
                return f"{a._inside()} * {b._inside()}"
            case _:
                return self._sum()

    def _sum(self) -> str:
        """Return a sum or difference, with one fused multiply-add for each of its products."""
        terms = sorted(self._terms(), key=lambda term: term[0])  # positive ones first
        rest = [(sign, term) for sign, term in terms if not term.fused]
        products = [(sign, term) for sign, term in terms if term.fused]
        (sign, first), *rest = rest or [products.pop(0)]
        text = f"{sign}{first._inside() if sign else first}"
        text += "".join(f" {sign or '+'} {term._inside()}" for sign, term in rest)
        for sign, product in products:
            a, b = product.operands
            text = f"fma({sign}{a._inside() if sign else a}, {b}, {text})"
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

    def _inside(self) -> str:
        """Return the text as an operand, in brackets where it is a sum."""
        bare = self.name or self.operation not in "+-" or str(self).startswith("fma(")
        return str(self) if bare else f"({self})"


class Tape:
    """Symbols of one computation, in order of creation, in titled blocks."""

    def __init__(self) -> None:
        self.symbols: dict[tuple[object, ...], Symbol] = {}
        self.block = ""

    def number(self, value: float) -> Symbol:
        """Return a constant."""
        key = ("number", float(value) + 0.0)  # no negative zero
        if key not in self.symbols:
            self.symbols[key] = Symbol(self, "number", (), key[1])
        return self.symbols[key]

    def input(self, name: str, formula: str) -> Symbol:
        """Return a symbol whose value is the Python expression `formula`."""
        symbol = self.symbols[("input", formula)] = Symbol(self, formula, ())
        symbol.name = name
        return symbol

    def pair(self, names: tuple[str, str], formula: str) -> "tuple[Symbol, Symbol]":
        """Return the two symbols of a Python expression with a pair as its value."""
        both = self.input(", ".join(names), formula)
        first, second = (self.symbol(f"part {i}", both) for i in range(2))
        first.name, second.name = names
        return first, second

    def symbol(self, operation: str, *operands: Symbol) -> Symbol:
        """Return the one symbol of this operation on these operands."""
        key = (operation, *operands)
        if key not in self.symbols:
            self.symbols[key] = Symbol(self, operation, operands)
        return self.symbols[key]

    def named(self, name: str, vector: Vector) -> Vector:
        """Name the unnamed sums, differences and products of a vector; return the vector."""
        for symbol, component in zip(vector, "xyz", strict=True):
            negated = symbol.operation == "neg"
            if negated:
                symbol = symbol.operands[0]
            better = symbol.name.startswith("neg_") and not negated
            if symbol.operation in "+-*" and (better or not symbol.name):
                symbol.name = f"{'neg_' if negated else ''}{name}_{component}"
        return vector

    def fuse(self, record: Mapping[str, Mapping[str, Symbol]]) -> None:
        """Make sums and products that only one sum of a record needs terms of that sum."""
        users = _users(record)
        for symbol in users:
            for term in symbol.operands if symbol.operation in ("+", "-") else ():
                if users[term] == 1 and term.operation in ("+", "-", "*"):
                    term.fused, term.name = True, ""

    def python(self, record: Mapping[str, Mapping[str, Symbol]]) -> Iterator[str]:
        """Yield the lines that compute a record: for each title, its targets and their symbols.

        Expressions with several uses get a line of their own; unused ones are left out.
        """
        users = _users(record)
        needed = sorted(users, key=lambda symbol: symbol.order)
        shared = (s for s in needed if s.operation in "+-*" and users[s] > 1 and not s.name)
        for count, symbol in enumerate(shared, start=1):
            symbol.name = f"t{count}"
        block = ""
        for symbol in needed:
            if symbol.name and not symbol.operation.startswith("part"):
                if symbol.block != block:
                    block = symbol.block
                    yield f"# {block}"
                yield f"{symbol.name} = {symbol.formula()}"
        for title, entries in record.items():
            yield f"# {title}"
            yield from (f"{target} = {symbol}" for target, symbol in entries.items())


def _users(record: Mapping[str, Mapping[str, Symbol]]) -> dict[Symbol, int]:
    """Return the symbols that a record needs, with the number of uses of each."""
    users: dict[Symbol, int] = {}
    pending = [symbol for entries in record.values() for symbol in entries.values()]
    while pending:
        symbol = pending.pop()
        users[symbol] = users.get(symbol, 0) + 1
        if users[symbol] == 1:
            pending.extend(symbol.operands)
    return users
