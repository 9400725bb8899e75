"""Policies written in Python by somebody else: any function or object, made safe to evaluate.

What it returns is checked at each step, and whatever goes wrong in it is told in one sentence that
says where and in which state.
"""

import math
import numbers
from collections.abc import Callable
from typing import Any

import numpy as np

from equipoise.control.policy import Array, Policy
from equipoise.errors import InputError
from equipoise.guests import format_error


class PythonPolicy:
    """A policy from any callable `state -> u`, or from any object with `act(state) -> u`."""

    def __init__(self, decide: Policy | Callable[[Array], float], name: str | None = None) -> None:
        """Wrap what decides.

        Args:
            decide: A function of the state (x, x_dot, phi, phi_dot), SI units, shape (4,), that
                returns the acceleration u of the flange along x [m/s^2]; or an object with such an
                `act`, or a class of such objects that is made without arguments.
            name: What to call it in messages and files; by default its own name.

        Raises:
            InputError: It is neither, or its class cannot be made.
        """
        self.name = name or str(getattr(decide, "__name__", type(decide).__name__))
        if isinstance(decide, type):
            decide = self._made(decide)
        act = getattr(decide, "act", decide)
        if not callable(act):
            raise InputError(
                f"{self.name} is of type {type(decide).__name__}, expected a function state -> u "
                "or an object with act(state); give one of those"
            )
        self._act: Callable[[Array], Any] = act

    def act(self, state: Array) -> float:
        """Return u [m/s^2] for the state (x, x_dot, phi, phi_dot), shape (4,).

        Raises:
            InputError: It raised something, or returned what is not a finite number.
        """
        try:
            u = self._act(state)
        except Exception as error:
            raise InputError(
                f"{self.name} raised {format_error(error, __file__)} in the state "
                f"{_format_state(state)}; correct it"
            ) from error
        if isinstance(u, np.ndarray) and u.size == 1:
            u = u.item()
        try:
            value = float(u) if isinstance(u, numbers.Real) else math.nan
        except OverflowError:
            value = math.inf
        if not math.isfinite(value):
            raise InputError(
                f"{self.name} returned {u!r:.60} in the state {_format_state(state)}, expected a "
                "finite number: the acceleration u in m/s^2; correct it"
            )
        return value

    def _made(self, kind: type) -> Any:
        if not hasattr(kind, "act"):
            raise InputError(f"the class {self.name} has no act(state); add it, or give a function")
        try:
            return kind()
        except Exception as error:
            raise InputError(
                f"calling {self.name}() raised {format_error(error, __file__)}; give a class "
                "that needs no arguments, or an object of it"
            ) from error


def _format_state(state: Array) -> str:
    return ", ".join(
        f"{name} = {value:.3g}"
        for name, value in zip(("x", "x_dot", "phi", "phi_dot"), state.tolist(), strict=True)
    )
