"""Count the floating-point operations of a control step, by running its code on counting numbers.

Kernels run as plain Python, with all their numbers replaced by objects that count additions,
multiplications, divisions and roots; a fused multiply-add counts as two. Comparisons, random
numbers and the update of the table are not counted. Prints one JSON object, operations per step::

    NUMBA_DISABLE_JIT=1 python benchmarks/operations.py
"""

import json
import math
import sys
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np

from equipoise import paper
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator, shipped_actuator
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.elementary import BATCH_SIZE
from equipoise.model.pendulum import shipped_pendulum
from equipoise.settings import Settings
from equipoise.worlds.plant import (
    BatchState,
    DomainRandomization,
    make_loop_params,
    new_batch_state,
    reset,
)
from equipoise.worlds.plant import step as advance

NOMINAL: Final = DomainRandomization(1.0, 1.0, 0.0, 1.0, 0.0)
START: Final = (0.01, 0.05, 0.01, 0.1)
"""x [m], x_dot [m/s], phi [rad], phi_dot [rad/s]."""


class Count:
    """Number of operations so far."""

    operations = 0


class Counting:
    """A number that counts the operations it takes part in."""

    __slots__ = ("value",)

    def __init__(self, value: Any) -> None:
        """Wrap a number."""
        self.value = float(value)

    def __float__(self) -> float:
        """Return the number itself."""
        return self.value

    def __neg__(self) -> "Counting":
        """Change the sign, which a processor does for nothing."""
        return Counting(-self.value)

    def __abs__(self) -> "Counting":
        """Drop the sign, for nothing."""
        return Counting(abs(self.value))

    def __floor__(self) -> "Counting":
        """Round down: one operation."""
        Count.operations += 1
        return Counting(math.floor(self.value))

    def __round__(self) -> int:
        """Round to a whole number."""
        return round(self.value)

    def __int__(self) -> int:
        """Cut to a whole number."""
        return int(self.value)

    def __hash__(self) -> int:
        """Return the hash of the number."""
        return hash(self.value)


def _count(name: str, cost: int) -> None:
    """Give `Counting` an operator that counts."""
    operator: Callable[[float, float], Any] = getattr(float, name)

    def result(self: Counting, other: Any) -> Any:
        Count.operations += cost
        value = operator(self.value, float(other))
        return Counting(value) if cost else value

    setattr(Counting, name, result)


for each in ("add", "sub", "mul", "truediv"):
    _count(f"__{each}__", 1)
    _count(f"__r{each}__", 1)
for each in ("lt", "le", "gt", "ge", "eq", "ne"):
    _count(f"__{each}__", 0)


def fma(a: Any, b: Any, c: Any) -> Counting:
    """Return a b + c: two operations."""
    Count.operations += 2
    return Counting(math.fsum((float(a) * float(b), float(c))))


def sqrt(x: Any) -> Counting:
    """Return the root: one operation."""
    Count.operations += 1
    return Counting(math.sqrt(float(x)))


def counting(value: Any) -> Any:
    """Return a tree of named tuples with counting numbers in its arrays of floats."""
    if isinstance(value, np.ndarray):
        if value.dtype != np.float64:
            return value
        array = np.empty(value.shape, object)
        array.flat[:] = [Counting(number) for number in value.flat]
        return array
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*map(counting, value))
    return value


class Step(NamedTuple):
    """A plant and the state of its lanes."""

    plant: Any
    block: BatchState


def prepare(actuator: Actuator) -> Step:
    """Return a plant in motion."""
    settings, pendulum = Settings(), shipped_pendulum().parameters()
    plant = make_loop_params(iiwa(7), settings, paper.STEP, pendulum, actuator)
    block = new_batch_state()
    for n in range(BATCH_SIZE):
        reset(plant, block, pendulum, NOMINAL, START, n)
        block.controller.u[n] = 0.5
    return Step(plant, block)


def operations(step: Step) -> float:
    """Return the number of operations of a step, per lane."""
    block = counting(step.block)
    Count.operations = 0
    advance(step.plant, block, BATCH_SIZE)
    return Count.operations / BATCH_SIZE


def main() -> None:
    """Print the operations of a step with the ideal arm, and behind the shipped actuator."""
    steps = {"ideal": prepare(IDEAL_ACTUATOR), "actuator": prepare(shipped_actuator())}
    for name, module in list(sys.modules.items()):
        for own in (fma, sqrt):
            if name.startswith("equipoise") and hasattr(module, own.__name__):
                setattr(module, own.__name__, own)
    print(json.dumps({name: operations(step) for name, step in steps.items()}))


if __name__ == "__main__":
    main()
