"""Grid of a table, by default the paper's 270: box of a state, mirror image of a box.

Section 4.1. The ends come from the settings `boxes`, converted to radians. An inner end belongs to
exactly one of its two neighbours; the outer limits of phi and x belong to no box: a state on them
is a failure. Index of a box: ((i_phi * n_phi_dot + i_phi_dot) * n_x + i_x) * n_x_dot + i_x_dot,
each axis counted from its lowest interval; n is the number of its intervals.

Mirror symmetry (x, phi -> -x, -phi) is a map of *indices*. Re-binning -phi is not the same, since
the intervals of phi are half open.
"""

from math import nextafter, radians
from typing import Final, NamedTuple, TypeVar

import numpy as np

from equipoise import paper
from equipoise.arrays import Array, IntArray
from equipoise.jit import inlined, kernel
from equipoise.settings import BoxSettings

Box = TypeVar("Box", int, IntArray)
"""Index of a box, or an array of them."""
ACTIONS: Final = len(paper.ACTIONS)

TRUNCATED, ANGLE, TRACK, JOINT_LIMIT, NOT_UPRIGHT, SAFETY_STOP = range(6)
"""Codes of the ends of a trial, the places in `equipoise.outcomes.TRIAL_OUTCOMES`; `SAFETY_STOP` is
the lowest one of a safety rule."""


class Grid(NamedTuple):
    """The four axes: the least number of each interval but the lowest, rising, in SI units."""

    phi: tuple[float, ...]
    phi_dot: tuple[float, ...]
    x: tuple[float, ...]
    x_dot: tuple[float, ...]
    x_per_x_dot: float
    """Time over which x is continued [s]."""
    x_per_phi_dot: float
    """The same, times the distance from the pivot to the centre of percussion [m s]."""


def make_grid(settings: BoxSettings, k: float) -> Grid:
    """Return the boxes in SI units, for kernels.

    Args:
        settings: Inner ends, and the time over which x is continued at the velocity
            x_dot + phi_dot / k of the pendulum's centre of percussion. The flange's acceleration
            does not act on that point: its velocity is the drift along the track.
        k: Coupling of the pendulum to the pivot's acceleration [1/m].
    """
    phi, phi_dot = (tuple(map(radians, ends)) for ends in (settings.phi_deg, settings.phi_dot_deg))
    return Grid(
        phi=phi,
        phi_dot=_outward(phi_dot),
        x=_outward(settings.x),
        x_dot=_outward(settings.x_dot),
        x_per_x_dot=settings.look_ahead,
        x_per_phi_dot=settings.look_ahead / k,
    )


def _outward(edges: tuple[float, ...]) -> tuple[float, ...]:
    """Return the axis whose edges belong to the intervals farther from zero."""
    return tuple(edge if edge >= 0.0 else nextafter(edge, 0.0) for edge in edges)


@inlined
def interval_index(value: float, axis: tuple[float, ...]) -> int:
    """Return the interval of an axis that holds `value`."""
    index = 0
    for i in range(len(axis)):
        index += value >= axis[i]
    return index


@inlined
def box_index(x: float, x_dot: float, phi: float, phi_dot: float, boxes: Grid) -> int:
    """Return the box that holds a state; states beyond a limit fall in the outermost box.

    Args:
        x: Displacement of the flange [m].
        x_dot: Its velocity [m/s].
        phi: Angle of the pendulum from upright [rad].
        phi_dot: Its angular velocity [rad/s].
        boxes: From `make_grid`.
    """
    i = interval_index(phi, boxes.phi)
    j = interval_index(phi_dot, boxes.phi_dot)
    ahead = x + boxes.x_per_x_dot * x_dot + boxes.x_per_phi_dot * phi_dot
    k = interval_index(ahead, boxes.x)
    m = interval_index(x_dot, boxes.x_dot)
    i = i * (len(boxes.phi_dot) + 1) + j
    return (i * (len(boxes.x) + 1) + k) * (len(boxes.x_dot) + 1) + m


@kernel
def box_indices(states: Array, boxes: Grid) -> IntArray:
    """Return the boxes that hold some states.

    Args:
        states: x, x_dot, phi, phi_dot in SI units, shape (n, 4).
        boxes: From `make_grid`.

    Returns:
        Index of each box, shape (n,).
    """
    indices = np.empty(len(states), np.int64)
    for i in range(len(states)):
        indices[i] = box_index(states[i, 0], states[i, 1], states[i, 2], states[i, 3], boxes)
    return indices


@inlined
def mirrored_box(box: Box, count: int) -> Box:
    """Return the box of the mirror image, of `count` boxes.

    Counting each axis from its other end counts all boxes from the other end.
    """
    return count - 1 - box


def greedy_accelerations(Q: Array) -> Array:
    """Return the best acceleration of each box [m/s^2], ties broken mirror-symmetrically.

    Of equal values the lowest action wins in a box of the lower half (phi < 0) and the highest in
    its mirror image, so that a symmetric table gives a symmetric policy.

    Args:
        Q: State-action values, shape (boxes, 8).

    Returns:
        Accelerations, shape (boxes,).
    """
    box = np.arange(len(Q))
    lowest, highest = np.argmax(Q, axis=1), Q.shape[1] - 1 - np.argmax(Q[:, ::-1], axis=1)
    return np.array(paper.ACTIONS)[np.where(box < mirrored_box(box, len(Q)), lowest, highest)]
