"""The 270 boxes, against the paper's own notation at every edge, and their mirror images."""

import itertools
from math import inf, nextafter, pi

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from equipoise.control.grid import (
    box_count,
    box_index,
    greedy_actions,
    interval_index,
    mirrored_box,
    partition,
)
from equipoise.errors import SettingsError
from equipoise.settings import BoxSettings, resolve
from tests.reference import intervals as printed

BOXES = partition(BoxSettings(look_ahead=0.0), 1.0)
CENTRE = {"phi": 0.01, "phi_dot": 0.0, "x": 0.0, "x_dot": 0.0}
INNER_EDGES = [
    (axis, interval.low * unit)
    for axis, (intervals, unit) in printed.AXES.items()
    for interval in intervals[1:]
]
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


def unpacked(box):
    """Return (i, j, k, m) of phi, phi_dot, x, x_dot."""
    return tuple(int(index) for index in np.unravel_index(box, (6, 5, 3, 3)))


def box_of(**state):
    return int(box_index(boxes=BOXES, **(CENTRE | state)))


def test_there_are_fourteen_inner_edges():
    # Five of phi, four of phi_dot, two of x, two of x_dot.
    assert len(INNER_EDGES) == 5 + 4 + 2 + 2


@pytest.mark.parametrize(("axis", "edge"), INNER_EDGES)
@pytest.mark.parametrize("side", ["just below", "on", "just above"])
def test_each_side_of_each_edge_is_in_the_interval_that_the_paper_prints(axis, edge, side):
    towards = {"just below": -inf, "on": edge, "just above": inf}[side]
    value = nextafter(edge, towards)
    expected = CENTRE | {axis: value}
    assert unpacked(box_of(**{axis: value})) == printed.place(**expected)


@pytest.mark.compiled_only
def test_all_combinations_of_edges_are_in_the_box_that_the_paper_prints():
    names = tuple(VALUES)
    for values in itertools.product(*VALUES.values()):
        state = dict(zip(names, values, strict=True))
        assert unpacked(box_of(**state)) == printed.place(**state), state


@given(
    x=st.floats(-0.2199, 0.2199),
    x_dot=st.floats(-3, 3),
    phi=st.floats(-0.19, 0.19),
    phi_dot=st.floats(-10, 10),
)
def test_any_state_is_in_the_box_that_the_paper_prints(x, x_dot, phi, phi_dot):
    state = {"x": x, "x_dot": x_dot, "phi": phi, "phi_dot": phi_dot}
    assert unpacked(box_of(**state)) == printed.place(**state)


def test_all_270_boxes_can_be_reached():
    middles = {
        "phi": [angle * pi / 180 for angle in (-8, -3, -0.5, 0.5, 3, 8)],
        "phi_dot": [rate * pi / 180 for rate in (-99, -30, 0, 30, 99)],
        "x": [-0.15, 0.0, 0.15],
        "x_dot": [-0.7, 0.0, 0.7],
    }
    found = [
        box_of(**dict(zip(middles, values, strict=True)))
        for values in itertools.product(*middles.values())
    ]
    # In the order of the indices: that of the file, with x_dot the fastest.
    assert found == list(range(270))
    assert BoxSettings().count == box_count(BOXES) == np.prod(BoxSettings().shape) == 270


@pytest.mark.parametrize("far", [1e3, 1e300])
def test_states_beyond_a_limit_fall_in_the_outermost_boxes(far):
    assert box_of(x=far, x_dot=far, phi=far, phi_dot=far) == 269
    assert box_of(x=-far, x_dot=-far, phi=-far, phi_dot=-far) == 0
    assert box_of(x=0.22) == box_of(x=0.2)
    assert box_of(phi=-11 * pi / 180) == box_of(phi=-10 * pi / 180)


def test_minus_zero_is_zero():
    assert box_of(phi=-0.0) == box_of(phi=0.0) == box_of(phi=0.001)


def test_the_mirror_image_counts_each_axis_from_its_other_end():
    for box in range(270):
        i, j, k, m = unpacked(box)
        assert unpacked(int(mirrored_box(box, 270))) == (5 - i, 4 - j, 2 - k, 2 - m)


def test_mirroring_is_an_involution_without_a_fixed_point():
    images = [int(mirrored_box(box, 270)) for box in range(270)]
    assert sorted(images) == list(range(270))
    assert all(images[images[box]] == box != images[box] for box in range(270))


@given(
    x=st.floats(-0.2199, 0.2199),
    x_dot=st.floats(-3, 3),
    phi=st.floats(-0.19, 0.19),
    phi_dot=st.floats(-10, 10),
)
def test_away_from_the_edges_the_mirrored_state_is_in_the_mirrored_box(x, x_dot, phi, phi_dot):
    state = {"x": x, "x_dot": x_dot, "phi": phi, "phi_dot": phi_dot}
    mirrored = {axis: -value for axis, value in state.items()}
    on_an_edge = any(abs(state[axis]) == abs(edge) for axis, edge in INNER_EDGES)
    if not on_an_edge:
        assert box_of(**mirrored) == mirrored_box(box_of(**state), 270)


def test_on_an_edge_of_phi_binning_the_mirrored_state_is_another_box():
    # Why mirroring is a map of indices: [1, 5[ holds 1 degree, its image [-5, -1[ not -1 degree.
    one = 1 * pi / 180
    assert box_of(phi=-one) != mirrored_box(box_of(phi=one), 270)
    # x closes outward, ]-0.22, -0.08] and [0.08, 0.22[: there both are the same.
    assert box_of(x=-0.08, phi=-0.01) == mirrored_box(box_of(x=0.08, phi=0.01), 270)


@given(
    edges=st.lists(st.integers(-9, 9), min_size=1, max_size=6, unique=True).map(sorted),
    value=st.integers(-10, 10),
    data=st.data(),
)
def test_an_index_counts_the_edges_that_a_value_has_passed(edges, value, data):
    upper = data.draw(st.lists(st.booleans(), min_size=len(edges), max_size=len(edges)))
    axis = type(BOXES.phi)(tuple(map(float, edges)), tuple(upper))
    passed = [edge for edge, own in zip(edges, upper, strict=True) if value > edge - own / 2]
    if not any(value == edge and not own for edge, own in zip(edges, upper, strict=True)):
        assert interval_index(float(value), axis) == len(passed)


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
    boxes = partition(given, 1.0)
    state = np.array(state) * (0.19, 8.0, 0.22, 2.5)
    unit = (np.pi / 180, np.pi / 180, 1.0, 1.0)
    places = [
        int(np.searchsorted(np.array(ends[name]) * scale, value, side="right"))
        for name, scale, value in zip(LIMITS, unit, state, strict=True)
    ]
    phi, phi_dot, x, x_dot = state.tolist()
    assume(bool(np.all(state)))  # zero is its own mirror image
    box = int(box_index(x, x_dot, phi, phi_dot, boxes))
    assert box == np.ravel_multi_index(places, given.shape)
    assert int(box_index(-x, -x_dot, -phi, -phi_dot, boxes)) == mirrored_box(box, given.count)


@pytest.mark.parametrize(
    ("ends", "message"),
    [
        ("boxes.x=[0.1, -0.1]", "x must rise"),
        ("boxes.x=[-0.1, 0.05]", "x must be symmetric about zero"),
        ("boxes.x=[-0.22, 0.22]", "x must lie within the limit 0.22"),
        ("boxes.phi_deg=[-5, 5]", "phi_deg must have the end 0"),
        ("boxes.phi_dot_deg=[]", "phi_dot_deg"),
        ("boxes.x_dot=fast", "x_dot"),
        ("boxes.x_dot=[nan]", "x_dot"),
    ],
)
def test_ends_that_divide_nothing_are_refused_with_one_sentence(ends, message):
    with pytest.raises(SettingsError, match=message) as refused:
        resolve(overrides=[ends])
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
    assert row[greedy_actions(Q)[box]] == max(row)


@given(box=st.integers(0, 269), row=rows, seed=st.integers(0, 999))
def test_a_symmetric_table_gives_a_symmetric_policy_whatever_its_ties(box, row, seed):
    Q = np.random.default_rng(seed).integers(-1, 2, (270, 8)).astype(float)
    Q[box] = row
    Q[135:] = mirror_image(Q)[135:]
    assert np.array_equal(Q, mirror_image(Q))
    chosen = greedy_actions(Q)
    for box in range(270):
        assert chosen[mirrored_box(box, 270)] == 7 - chosen[box]


def test_a_table_of_zeros_pushes_towards_the_side_to_which_the_pendulum_tips():
    chosen = greedy_actions(np.zeros((270, 8))).reshape(6, -1)
    assert np.all(chosen[:3] == 0)
    assert np.all(chosen[3:] == 7)


@pytest.mark.parametrize("x_dot", [-0.3, 0.1, 0.4])
@pytest.mark.parametrize("phi_dot", [-1.0, 0.0, 0.3])
def test_x_is_continued_at_the_velocity_of_the_centre_of_percussion(x_dot, phi_dot):
    state = {"x_dot": x_dot, "phi": 0.0, "phi_dot": phi_dot}
    plain, ahead = (partition(BoxSettings(look_ahead=time), 8.0) for time in (0.0, 0.5))
    for x in (-0.2, -0.05, 0.0, 0.1, 0.2):
        assert box_index(x, **state, boxes=plain) == box_index(x, **state, boxes=BOXES)
        # I / (m l) = 1 / k = 0.125 m from the pivot.
        there = x + 0.5 * (x_dot + 0.125 * phi_dot)
        seen = box_index(x, **state, boxes=ahead)
        assert seen == box_index(there, **state, boxes=BOXES)
