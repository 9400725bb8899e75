"""The 270 boxes, against the paper's own notation at every edge, and their mirror images."""

import itertools
from math import inf, nextafter

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from equipoise import paper
from equipoise.errors import SettingsError
from equipoise.model.grid import box_index, greedy_accelerations, make_grid, mirrored_box
from equipoise.settings import BoxSettings, resolve
from tests.reference import intervals as printed

BOXES = make_grid(BoxSettings(look_ahead=0.0), 1.0)
VALUES = {
    axis: [
        value
        for interval in intervals
        for end in (interval.low * unit, interval.high * unit)
        if abs(end) < inf
        for value in (nextafter(end, -inf), end, nextafter(end, inf))
        if printed.holders(axis, value)
    ]
    for axis, (intervals, unit) in printed.AXES.items()
}
"""Every value just below, on and just above an end that is not a failure, in SI units."""


@pytest.mark.compiled_only
def test_all_combinations_of_edges_are_in_the_box_that_the_paper_prints():
    names = tuple(VALUES)
    for values in itertools.product(*VALUES.values()):
        state = dict(zip(names, values, strict=True))
        box = int(box_index(boxes=BOXES, **state))
        assert np.unravel_index(box, (6, 5, 3, 3)) == printed.place(**state), state


LIMITS = {"phi_deg": 10.9, "phi_dot_deg": 400.0, "x": 0.21, "x_dot": 2.0}


def ends_of(count):
    """Return a strategy for partitions with so many ends on each side; each count compiles."""

    def axis(name, limit):
        side = st.lists(st.floats(0.01, limit), min_size=count, max_size=count, unique=True)
        zero = (0.0,) if name == "phi_deg" else ()
        return side.map(lambda found: tuple(sorted({*found, *(-end for end in found), *zero})))

    return st.fixed_dictionaries({name: axis(name, limit) for name, limit in LIMITS.items()})


@given(
    ends=st.sampled_from((1, 4)).flatmap(ends_of),
    state=st.tuples(*(st.floats(-1, 1) for _ in range(4))),
)
def test_any_ends_give_the_box_that_numpy_gives_and_its_mirror_image(ends, state):
    given = BoxSettings(**ends, look_ahead=0.0)
    boxes = make_grid(given, 1.0)
    state = np.array(state) * (0.19, 8.0, 0.22, 2.5)
    unit = (np.pi / 180, np.pi / 180, 1.0, 1.0)
    scaled = [np.array(ends[name]) * scale for name, scale in zip(LIMITS, unit, strict=True)]
    places = [int(np.searchsorted(*pair)) for pair in zip(scaled, state, strict=True)]
    phi, phi_dot, x, x_dot = state.tolist()
    assume(bool(np.all(state)))  # zero is its own mirror image
    assume(not any(value in axis for axis, value in zip(scaled, state, strict=True)))
    box = int(box_index(x, x_dot, phi, phi_dot, boxes))
    assert box == np.ravel_multi_index(places, given.shape)
    assert int(box_index(-x, -x_dot, -phi, -phi_dot, boxes)) == mirrored_box(box, given.count)


@pytest.mark.parametrize(
    "ends", ["x=[0.1, -0.1]", "x=[-0.1, 0.05]", "x=[-0.22, 0.22]", "phi_deg=[-5, 5]", "x_dot=[nan]"]
)
def test_ends_that_divide_nothing_are_refused(ends):
    with pytest.raises(SettingsError) as refused:
        resolve(overrides=[f"boxes.{ends}"])
    assert "\n" not in str(refused.value)


def mirror_image(Q):
    """Return the table seen in the mirror: another box and the opposite action."""
    return Q.reshape(6, 5, 3, 3, 8)[::-1, ::-1, ::-1, ::-1, ::-1].reshape(270, 8)


# Few different values, so that ties are the rule.
rows = st.lists(st.integers(-1, 1).map(float), min_size=8, max_size=8)


@given(box=st.integers(0, 269), row=rows)
def test_the_greedy_action_has_the_largest_value_of_its_box(box, row):
    Q = np.zeros((270, 8))
    Q[box] = row
    assert row[paper.ACTIONS.index(greedy_accelerations(Q)[box])] == max(row)


@given(box=st.integers(0, 269), row=rows, seed=st.integers(0, 999))
def test_a_symmetric_table_gives_a_symmetric_policy_whatever_its_ties(box, row, seed):
    Q = np.random.default_rng(seed).integers(-1, 2, (270, 8)).astype(float)
    Q[box] = row
    Q[135:] = mirror_image(Q)[135:]
    assert np.array_equal(Q, mirror_image(Q))
    chosen = greedy_accelerations(Q)
    for box in range(270):
        assert chosen[mirrored_box(box, 270)] == -chosen[box]


@pytest.mark.parametrize(("x_dot", "phi_dot"), [(-0.3, 0.0), (0.1, -1.0), (0.4, 0.3)])
def test_x_is_continued_at_the_velocity_of_the_centre_of_percussion(x_dot, phi_dot):
    state = {"x_dot": x_dot, "phi": 0.0, "phi_dot": phi_dot}
    plain, ahead = (make_grid(BoxSettings(look_ahead=time), 8.0) for time in (0.0, 0.5))
    for x in (-0.2, -0.05, 0.0, 0.1, 0.2):
        assert box_index(x, **state, boxes=plain) == box_index(x, **state, boxes=BOXES)
        # I / (m l) = 1 / k = 0.125 m from the pivot.
        there = x + 0.5 * (x_dot + 0.125 * phi_dot)
        seen = box_index(x, **state, boxes=ahead)
        assert seen == box_index(there, **state, boxes=BOXES)
