"""The search for the best table: where it begins, what it keeps, and what it finds."""

from itertools import pairwise
from math import radians

import numpy as np
import pytest

from equipoise import paper
from equipoise.control.baselines import baselines
from equipoise.control.grid import box_index, partition
from equipoise.control.policy import act, shipped_policy
from equipoise.errors import InputError
from equipoise.learning.select import Candidate, race, trial_plants
from equipoise.model.actuator import shipped_actuator
from equipoise.model.arms.iiwa import iiwa
from equipoise.settings import RECIPES, BoxSettings, resolve
from equipoise.studies.table_search import (
    LEVELS,
    NAME,
    SearchSize,
    lqr_table,
    search_table,
    whole_table,
)

SMALL = SearchSize(generations=3, tables=12, trials=2)
SHORT = ("selection.round_trials=24", "selection.rounds=3", "selection.duration=4")


@pytest.fixture(scope="module")
def found(pendulum):
    return searched(pendulum)


def searched(pendulum, **options):
    settings = resolve(overrides=SHORT)
    given = {"actuator": shipped_actuator(), "size": SMALL, "seed": 5} | options
    return search_table(pendulum, iiwa(7), settings, **given)


def test_the_whole_table_is_the_half_and_its_mirror_image():
    half = np.array([[0, 7, 3], [1, 1, 1]])
    assert whole_table(half).tolist() == [[0, 7, 3, 4, 0, 7], [1, 1, 1, 6, 6, 6]]


@pytest.mark.parametrize("recipe", ["robust", "fine", "paper"])
def test_the_first_table_is_the_snapped_lqr_at_the_centre_of_each_box(pendulum, recipe):
    settings, parameters = resolve(recipe).boxes, pendulum.parameters()
    table = lqr_table(settings, parameters)
    boxes = partition(settings, parameters.k)
    snapped = baselines(parameters, paper.STEP)["LQR, snapped"]
    seen = set()

    def middles(ends, outer):
        ends = [-outer, *ends, outer]
        return [(a + b) / 2 for a, b in pairwise(ends)]

    rates, speeds = settings.phi_dot_deg, settings.x_dot
    for phi in np.radians(middles(settings.phi_deg, 11.0)):
        for phi_dot in np.radians(middles(rates, 1.5 * rates[-1])):
            for ahead in middles(settings.x, 0.22):
                for x_dot in middles(speeds, 1.5 * speeds[-1]):
                    drift = x_dot + phi_dot / parameters.k
                    state = ahead - settings.look_ahead * drift, x_dot, phi, phi_dot
                    box = box_index(*state, boxes)
                    seen.add(box)
                    assert table[box] == act(snapped, *state, 0.0)
    assert seen == set(range(settings.count))


def test_the_result_is_a_symmetric_table_that_says_how_it_was_made(found):
    u = found.u_of_box
    assert u.tolist() == (-u[::-1]).tolist()
    assert set(np.unique(found.table)) == {0.0, 1.0}
    assert (found.table.sum(axis=1) == 1.0).all()
    assert found.settings.learning.learner == NAME
    assert NAME in found.recipe
    assert found.episodes == SMALL.generations * SMALL.tables * SMALL.trials
    assert [point.episodes for point in found.learning_curve] == [24, 48, 72]
    assert found.steps == found.learning_curve[-1].steps > 0


def test_it_scores_as_well_as_every_table_that_it_begins_with(pendulum):
    good, bad = shipped_policy().u_of_box, np.full(270, LEVELS[0])
    bad[135:] = LEVELS[-1]
    found = searched(pendulum, starts=[bad, good])
    plants = trial_plants(
        pendulum,
        iiwa(7),
        resolve(overrides=(*SHORT, f"selection.spread={SMALL.spread}")),
        (shipped_actuator(),),
        5,
    )
    again = race(plants, [Candidate(0, u) for u in (bad, good, found.u_of_box)])
    scores = {index: result.score for index, result in again}
    assert scores[2] >= scores[1] > scores[0]


def test_equal_seeds_give_equal_tables_with_any_number_of_workers(pendulum, found):
    assert searched(pendulum, workers=3).digest == found.digest
    assert searched(pendulum, seed=6).checkpoints[0].score != found.checkpoints[0].score


def test_a_start_of_other_boxes_is_refused(pendulum):
    fine = BoxSettings(**{k.split(".")[1]: v for k, v in RECIPES["fine"].items()})
    start = lqr_table(fine, pendulum.parameters())
    with pytest.raises(InputError, match="756"):
        searched(pendulum, starts=[start])


@pytest.mark.slow
def test_the_search_finds_tables_that_last_longer_than_where_it_began(pendulum):
    """Releases of twice the angle: LQR at the centres of the boxes fails in some of them."""
    settings = resolve(
        overrides=(
            *SHORT,
            "selection.duration=20",
            f"evaluation.phi_high={radians(5.0)}",
            f"evaluation.phi_low={radians(3.0)}",
        )
    )
    size = SearchSize(generations=20, tables=64, trials=8)
    given = {"actuator": shipped_actuator(), "size": size, "seed": 1}
    found = search_table(pendulum, iiwa(7), settings, **given)
    spread = settings.selection.model_copy(update={"spread": size.spread})
    harder = settings.model_copy(update={"selection": spread})
    plants = trial_plants(pendulum, iiwa(7), harder, (shipped_actuator(),), 99)
    begun = lqr_table(settings.boxes, pendulum.parameters())
    candidates = [Candidate(0, begun), Candidate(0, found.u_of_box)]
    results = dict(race(plants, candidates))
    assert results[1].score > results[0].score
