"""The 270 boxes of the paper: box of a state, mirror image of a box.

Section 4.1. The intervals come from `equipoise.paper`, ends included, converted to radians. An
inner edge belongs to exactly one of its two neighbours; the outer limits of phi and x belong to no
box: a state on them is a failure. Index of a box: ((i_phi * 5 + i_phi_dot) * 3 + i_x) * 3 +
i_x_dot, each axis counted from its lowest interval.

Mirror symmetry (x, phi -> -x, -phi) is a map of *indices*. Re-binning -phi is not the same, since
the intervals of phi are half open.
"""

import functools
from collections.abc import Sequence
from itertools import pairwise
from math import radians
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field

from equipoise import paper
from equipoise.artefacts import Name, Value
from equipoise.compiled import inlined, kernel

SHAPE: Final = (6, 5, 3, 3)
"""Number of intervals of phi, phi_dot, x, x_dot."""
COUNT: Final = 270
"""Number of boxes."""
ACTIONS: Final = len(paper.ACTIONS)

TRUNCATED: Final = 0
ANGLE: Final = 1
TRACK: Final = 2
JOINT_LIMIT: Final = 3
SAFETY_STOP: Final = 4
"""Lowest code of a safety stop; the rest names the rule, see
`equipoise.control.trial_safety.guard_named`."""
CAUSES: Final = ("lasted", "angle", "track", "joint limit", "guard")
"""Causes of the end of a trial, by code; `angle` and `track` are the outer limits."""


class Axis(NamedTuple):
    """The inner edges of one axis."""

    edges: tuple[float, ...]
    """Rising, in SI units."""
    upper: tuple[bool, ...]
    """Whether the edge itself belongs to the interval above it."""


class Boxes(NamedTuple):
    """The four axes and the limits of the outermost intervals."""

    phi: Axis
    phi_dot: Axis
    x: Axis
    x_dot: Axis
    phi_limit: float
    """Failure angle [rad]."""
    x_limit: float
    """Failure displacement [m]."""
    x_per_x_dot: float
    """Time over which x is continued [s]."""
    x_per_phi_dot: float
    """The same, times the distance from the pivot to the centre of percussion [m s]."""


Intervals = Annotated[tuple[Name, ...], Field(max_length=16)]
"""Intervals of one quantity in the paper's notation."""


class BoxDescription(Value):
    """The boxes as a policy's file states them, in the paper's notation and units."""

    phi_deg: Intervals
    """Intervals of the angle from upright [deg]."""
    phi_dot_deg: Intervals
    """Intervals of the angular velocity [deg/s]."""
    x: Intervals
    """Intervals of the displacement [m]."""
    x_dot: Intervals
    """Intervals of the velocity [m/s]."""


def cause_named(code: int) -> str:
    """Return the name of the cause of a trial's end, by its code."""
    return CAUSES[min(code, SAFETY_STOP)]


def describe() -> BoxDescription:
    """Return the paper's boxes for a file."""
    return BoxDescription(
        phi_deg=tuple(str(i) for i in paper.PHI_INTERVALS_DEG),
        phi_dot_deg=tuple(str(i) for i in paper.PHI_DOT_INTERVALS_DEG),
        x=tuple(str(i) for i in paper.X_INTERVALS),
        x_dot=tuple(str(i) for i in paper.X_DOT_INTERVALS),
    )


@functools.lru_cache(maxsize=64)
def boxes(look_ahead: float = 0.0, k: float = 1.0) -> Boxes:
    """Return the paper's boxes in SI units, for kernels.

    Args:
        look_ahead: Time over which x is continued at the velocity x_dot + phi_dot / k of the
            pendulum's centre of percussion [s]; 0 as in the paper. The flange's acceleration does
            not act on that point: its velocity is the drift along the track.
        k: Coupling of the pendulum to the pivot's acceleration [1/m].
    """
    return Boxes(
        phi=_axis(paper.PHI_INTERVALS_DEG, degrees=True),
        phi_dot=_axis(paper.PHI_DOT_INTERVALS_DEG, degrees=True),
        x=_axis(paper.X_INTERVALS, degrees=False),
        x_dot=_axis(paper.X_DOT_INTERVALS, degrees=False),
        phi_limit=radians(paper.PHI_LIMIT_DEG),
        x_limit=paper.X_LIMIT,
        x_per_x_dot=look_ahead,
        x_per_phi_dot=look_ahead / k,
    )


def _axis(intervals: Sequence[paper.Interval], *, degrees: bool) -> Axis:
    edges = [interval.low for interval in intervals[1:]]
    for below, above in pairwise(intervals):
        # The paper prints ]-11, -5[ beside [-5, -1[: each inner edge has exactly one owner.
        if below.high != above.low or below.high_closed == above.low_closed:
            raise ValueError(f"{below} and {above} do not share one edge with one owner")
    return Axis(
        edges=tuple(radians(edge) if degrees else edge for edge in edges),
        upper=tuple(interval.low_closed for interval in intervals[1:]),
    )


@inlined
def interval_index(value: float, axis: Axis) -> int:
    """Return the interval of an axis that holds `value`."""
    index = 0
    for i in range(len(axis.edges)):
        edge = axis.edges[i]
        index += (value > edge) | ((value == edge) & axis.upper[i])
    return index


@inlined
def box_index(x: float, x_dot: float, phi: float, phi_dot: float, boxes: Boxes) -> int:
    """Return the box that holds a state; states beyond a limit fall in the outermost box.

    Args:
        x: Displacement of the flange [m].
        x_dot: Its velocity [m/s].
        phi: Angle of the pendulum from upright [rad].
        phi_dot: Its angular velocity [rad/s].
        boxes: From `boxes()`.
    """
    i = interval_index(phi, boxes.phi)
    j = interval_index(phi_dot, boxes.phi_dot)
    ahead = x + boxes.x_per_x_dot * x_dot + boxes.x_per_phi_dot * phi_dot
    k = interval_index(ahead, boxes.x)
    m = interval_index(x_dot, boxes.x_dot)
    return ((i * 5 + j) * 3 + k) * 3 + m


@inlined
def mirrored_box(box: int) -> int:
    """Return the box of the mirror image.

    Counting each axis from its other end counts all boxes from the other end.
    """
    return COUNT - 1 - box


@kernel
def greedy_actions(Q: npt.NDArray[np.float64]) -> npt.NDArray[Any]:
    """Return the index of the best action of each box, ties broken mirror-symmetrically.

    Of equal values the lowest action wins in a box of the lower half (phi < 0) and the highest in
    its mirror image, so that a symmetric table gives a symmetric policy.

    Args:
        Q: State-action values, shape (270, 8).

    Returns:
        Indices of actions, shape (270,).
    """
    best = np.zeros(Q.shape[0], np.int64)
    last = Q.shape[1] - 1
    for box in range(Q.shape[0]):
        lower_half = box < mirrored_box(box)
        action = 0 if lower_half else last
        for i in range(last + 1):
            candidate = i if lower_half else last - i
            if Q[box, candidate] > Q[box, action]:
                action = candidate
        best[box] = action
    return best
