"""The map of the recoverable set: what a policy holds, on plants and on a twin."""

import numpy as np
import pytest
from scipy.special import betaincinv

from equipoise.apps.report.figures.recovery_map import recovery_figure
from equipoise.apps.report.style import render
from equipoise.control.bound_policy import load_policy
from equipoise.control.policy import shipped_policy
from equipoise.errors import InputError, SettingsError
from equipoise.studies.recovery_map import (
    MapSlice,
    RecoveryMap,
    held_share,
    map_recovery,
    planes_of,
    starts_of,
    trials_of,
)

SHORT = {"starts": 100, "duration": 3.0}


@pytest.fixture(scope="module")
def mapped():
    return map_recovery(shipped_policy(), **SHORT)


@pytest.mark.slow
def test_no_policy_holds_a_start_outside_the_necessary_set(mapped):
    lqr = map_recovery(load_policy("lqr"), **SHORT)
    for found in (mapped, lqr):
        for one in found.slices:
            assert one.held_share("outside").held == 0
            assert one.held_share("outside").starts > 20
            assert one.held_share("necessary").held > 10
            assert one.held_share("sufficient").starts <= one.held_share("necessary").starts
    # A linear controller without boxes holds most of what can be held: the set is no vain bound.
    first = lqr.slices[0].held_share("sufficient")
    assert first.share > max(0.7, mapped.slices[0].held_share("sufficient").share)


def test_starts_fill_the_grid_and_depth_is_one_on_the_boundary(mapped):
    one = mapped.slices[0]
    starts = np.array(one.starts)
    half = np.abs(starts).max(axis=0)
    cells = np.floor(10.0 * (starts / (2.0 * half) + 0.5)).clip(0, 9)
    assert len({tuple(cell) for cell in cells}) > 90
    assert half[0] <= np.deg2rad(11.0)
    assert np.abs(np.array(one.necessary)[:, 0]).max() == pytest.approx(np.deg2rad(11.0))
    inside = np.array(one.depth) <= 1.0
    assert np.array_equal(inside, within(np.array(one.necessary), starts))


def within(polygon, points):
    """Whether points lie in a polygon, by the number of its edges above each."""
    count = np.zeros(len(points), int)
    for p, q in zip(np.roll(polygon, 1, axis=0), polygon, strict=True):
        spans = (p[0] > points[:, 0]) != (q[0] > points[:, 0])
        with np.errstate(divide="ignore", invalid="ignore"):
            edge = p[1] + (points[:, 0] - p[0]) * (q[1] - p[1]) / (q[0] - p[0])
        count += spans & (edge > points[:, 1])
    return count % 2 == 1


@pytest.mark.slow
def test_equal_seeds_give_equal_maps_for_any_number_of_workers(mapped):
    again = map_recovery(shipped_policy(), workers=2, **SHORT)
    assert again == mapped
    other = map_recovery(shipped_policy(), seed=1, **SHORT)
    assert other.slices[0].starts != mapped.slices[0].starts
    assert other.slices[0].necessary == mapped.slices[0].necessary


@pytest.mark.compiled_only
def test_a_twin_has_one_slice_with_its_own_delay_and_friction():
    counted = []
    found = map_recovery(
        shipped_policy(), world="twin:harsh", starts=5, duration=0.5, done=counted.append
    )
    assert [one.plane for one in found.slices] == ["pendulum"]
    assert sum(counted) == len(found.slices[0].starts) == 9
    assert found.delay == pytest.approx(0.036, abs=0.002)


def test_the_number_of_starts_is_a_square_within_its_limits():
    assert [starts_of(count) for count in (1, 2, 16, 17)] == [1, 4, 16, 25]
    assert planes_of("ideal") == ("pendulum", "flange")
    assert trials_of("model", 10) == 32
    for starts in (0, 2_000_000):
        with pytest.raises(InputError, match="give a number from 1 to 1,000,000"):
            map_recovery(shipped_policy(), starts=starts)
    with pytest.raises(SettingsError, match="there is no world 'mars'"):
        map_recovery(shipped_policy(), world="mars")


def test_shares_have_exact_intervals():
    held = np.array([True] * 7 + [False] * 3)
    found = held_share(held)
    assert found[:3] == (7, 10, 0.7)
    # Quantiles of the beta distributions (7, 4) and (8, 3).
    assert found.interval == pytest.approx(betaincinv([7, 8], [4, 3], [0.025, 0.975]), abs=1e-6)
    assert held_share(held[:0]) == (0, 0, 0.0, (0.0, 1.0))


def test_a_slice_with_missing_results_is_refused(mapped):
    fields = dict(mapped.slices[0])
    with pytest.raises(ValueError, match="need as many results"):
        MapSlice(**fields | {"held": fields["held"][1:]})


def test_a_map_survives_its_file_and_is_drawn(mapped, tmp_path):
    path = tmp_path / "map.json"
    mapped.save(path, command="test")
    loaded = RecoveryMap.load(path)
    assert loaded == mapped
    figure = recovery_figure(loaded)
    assert len(figure.axes) == 2
    labels = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"held by the policy", "releases by hand"} <= labels
    part = f"holds {100.0 * mapped.slices[0].held_share('necessary').share:.0f} %"
    assert part in figure.axes[0].get_title(loc="left")
    assert render(figure, "svg") == render(recovery_figure(mapped), "svg")
