r"""The intervals of section 4.1, copied a second time from the paper's LaTeX source.

Nothing here comes from `equipoise.paper`: the strings are the source's own, between its `$` signs.
"""

import re
from math import inf, pi
from typing import NamedTuple

PHI_DEG = (
    r"]-11{^\circ},-5{^\circ}[",
    r"[-5{^\circ},-1{^\circ}[",
    r"[-1{^\circ},0{^\circ}[",
    r"[0{^\circ},1{^\circ}[",
    r"[1{^\circ},5{^\circ}[",
    r"[5{^\circ},11{^\circ}[",
)
PHI_DOT_DEG = (r"]-\infty,-50]", r"]-50,-10]", r"]-10,10[", r"[10,50[", r"[50,+\infty[")
X = (r"]-0.22,-0.08]", r"]-0.08,0.08[", r"[0.08,0.22[")
X_DOT = (r"]-\infty,-0.5]", r"]-0.5,0.5[", r"[0.5,+\infty[")


class Printed(NamedTuple):
    """An interval as it is printed."""

    low: float
    high: float
    low_closed: bool
    high_closed: bool

    def holds(self, value, unit=1.0):
        """Tell whether a value lies in the interval, the ends being multiplied by `unit`."""
        low, high = self.low * unit, self.high * unit
        return (low < value or (self.low_closed and value == low)) and (
            value < high or (self.high_closed and value == high)
        )


def read(latex):
    """Return the interval that a string of the source means: `]a,b[` is open at both ends."""
    left, low, high, right = re.fullmatch(r"([\[\]])(.+),(.+)([\[\]])", latex).groups()
    return Printed(_number(low), _number(high), left == "[", right == "]")


def _number(latex):
    text = latex.replace(r"{^\circ}", "")
    return {r"-\infty": -inf, r"+\infty": inf}.get(text) or float(text)


DEGREE = pi / 180.0
AXES = {
    "phi": (tuple(map(read, PHI_DEG)), DEGREE),
    "phi_dot": (tuple(map(read, PHI_DOT_DEG)), DEGREE),
    "x": (tuple(map(read, X)), 1.0),
    "x_dot": (tuple(map(read, X_DOT)), 1.0),
}
"""Intervals of each axis, and the size of their unit in SI."""


def holders(axis, value):
    """Return the numbers of the intervals of an axis that hold a value in SI units."""
    intervals, unit = AXES[axis]
    return [i for i, interval in enumerate(intervals) if interval.holds(value, unit)]


def place(x, x_dot, phi, phi_dot):
    """Return the indices (i, j, k, m) of phi, phi_dot, x, x_dot; each value must have one home."""
    state = {"phi": phi, "phi_dot": phi_dot, "x": x, "x_dot": x_dot}
    homes = {axis: holders(axis, value) for axis, value in state.items()}
    if any(len(found) != 1 for found in homes.values()):
        raise ValueError(f"{state} is in the intervals {homes}")
    return tuple(found[0] for found in homes.values())
