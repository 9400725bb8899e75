"""The gap: what is compared with what, its statistics, and words that follow the numbers."""

from math import radians

import numpy as np
import pytest
from scipy import stats

from equipoise.artefacts import Estimate
from equipoise.errors import InputError, SettingsError
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import WORLDS, TwinSettings, World, read_world
from equipoise.outcomes import Outcome
from equipoise.settings import EvaluationSettings
from equipoise.studies import gap as study
from equipoise.studies.gap import (
    CLEAN,
    EFFECTS,
    FULL,
    SHORT,
    expected_actuator,
    trials_of,
)
from equipoise.studies.gap_results import (
    CURED,
    NO_BIAS,
    NO_PREDICTION,
    PAPER,
    UNTUNED,
    Gap,
    Seconds,
    difference,
    differs,
    mean,
    sentences,
    track_share,
)
from equipoise.worlds.evaluation import TrialResults, evaluate
from equipoise.worlds.twin.servo_model import equivalent_actuator
from equipoise.worlds.twin.twin import Twin
from tests.apps.report.made_up_gap import falls_early, measured, paper_policy, with_cures

WORLD = read_world("twin:nominal").settings
NO_EFFECT = {
    *("cycle", "inner", "pd_frequency", "pivot_outward", "substeps", "guards", "t1"),
    *("drag", "assumed_coulomb", "rotor_inertia"),
}
"""Numbers of the twin that belong to no effect: guesses at the cabinet, geometry, precision, what
ends a trial, and the pendulum's friction as the controller knows it."""


def known(actuator, changed):
    """The actuator that an identification would find on a changed nominal twin."""
    return expected_actuator(actuator, equivalent_actuator(WORLD), equivalent_actuator(changed))


@pytest.fixture(scope="module")
def policy(small_policy):
    """A policy that knows an actuator."""
    return with_cures(small_policy)


@pytest.fixture(scope="module")
def full(policy):
    return measured(policy, falls_early)


@pytest.fixture(scope="module")
def short(policy):
    return measured(policy, falls_early, quick=True)


def lasting(*survival, duration=60.0, cause=Outcome.TRACK):
    causes = tuple("lasted" if s >= duration else cause for s in survival)
    return TrialResults(name="", survival=survival, outcomes=causes)


# What is compared


def test_each_number_of_the_twin_belongs_to_one_effect():
    switched = [number for numbers in EFFECTS.values() for number in numbers]
    assert len(switched) == len(set(switched))
    assert set(switched) == set(CLEAN)
    assert set(switched) | NO_EFFECT == set(TwinSettings.model_fields)
    assert not set(switched) & NO_EFFECT
    TwinSettings.model_validate(CLEAN)


def test_an_effect_is_all_that_differs_from_the_clean_twin_or_from_the_twin(policy):
    def number_of_changes(call, i):
        if call.world is None:
            return 60.0
        clean = WORLD.model_copy(update=CLEAN)
        return float(
            sum(getattr(call.world, n) != getattr(clean, n) for n in TwinSettings.model_fields)
        )

    gap, _ = measured(policy, number_of_changes)
    for controller in (PAPER, CURED):
        assert gap.point("clean", controller).results.survival[0] == 0.0
        everything = gap.point("world", controller).results.survival[0]
        for name, numbers in EFFECTS.items():
            # An offset of the zero is in no named twin.
            own = len([n for n in numbers if n != "zero_offset"])
            assert gap.point("alone", controller, name).results.survival[0] == own
            assert gap.point("without", controller, name).results.survival[0] == everything - own


def test_controllers_differ_in_their_cures_alone(full):
    gap, calls = full
    cures = {(c.settings.controller.predict, c.settings.controller.estimate_bias) for c in calls}
    assert cures == {(True, True), (False, True), (True, False), (False, False)}
    for call in calls:
        plain = call.settings.controller == call.settings.controller.model_copy(
            update={"predict": False, "estimate_bias": False}
        )
        assert plain == ("paper" in call.table.recipe)
        if "paper" in call.table.recipe:
            assert call.actuator is None
            assert call.table.actuator.kind == "ideal"
    asked = {call.settings.evaluation for call in calls}
    assert asked == {gap.settings.evaluation}
    assert {call.seed for call in calls} == {0}


def test_the_cures_know_the_delay_where_they_are_told(policy):
    def believed(call, _):
        return 0.0 if call.actuator is None else 1e3 * call.actuator.delay.value

    gap, _ = measured(policy, believed)
    found = 1e3 * policy.actuator.delay.value
    for controller in (CURED, NO_PREDICTION, NO_BIAS):
        beliefs = [p.results.survival[0] for p in gap.curve("delay", controller)]
        assert beliefs == pytest.approx([max(found + d, 0.0) for d in (-10, -5, 0, 10, 20)])
    not_told = [p.results.survival[0] for p in gap.curve("delay", UNTUNED)]
    assert not_told == pytest.approx([found] * 5)


def test_curves_go_over_true_delays_and_wrong_zeros(full):
    gap, calls = full
    assert [p.at for p in gap.curve("delay", CURED)] == [0.0, 0.005, 0.01, 0.02, 0.03]
    degrees = [np.degrees(p.at) for p in gap.curve("zero", NO_BIAS)]
    assert degrees == pytest.approx([0.0, 0.25, 0.5, 0.75, 1.0])
    assert gap.curve("zero", NO_PREDICTION) == ()
    wrong = {call.world.zero_offset for call in calls if call.world is not None}
    assert wrong == set(FULL.zeros)
    constant = [c.world for c in calls if c.world is not None and c.world.zero_offset > 0.0]
    assert all(world.zero_error == 0.0 for world in constant)


def test_points_on_the_same_conditions_share_their_trials(full, short, policy):
    for (gap, calls), quick in ((full, False), (short, True)):
        conditions = {
            (c.table.recipe, c.settings.controller, c.world, c.actuator and c.actuator.digest)
            for c in calls
        }
        assert len(calls) == len(conditions) < len(gap.points)
        assert trials_of(quick=quick) == len(calls) * gap.trials
    told_of, not_told = (full[0].curve("delay", who)[2] for who in (CURED, UNTUNED))
    assert told_of.results == not_told.results
    seen = []
    measured(policy, falls_early, quick=True, trials=3, done=seen.append)
    assert sum(seen) == trials_of(quick=True, trials=3)


def test_the_short_form_is_short_and_says_so(full, short):
    long, brief = full[0], short[0]
    assert (long.trials, long.duration, long.quick) == (40, 60.0, False)
    assert (brief.trials, brief.duration, brief.quick) == (8, 20.0, True)
    assert (long.by_effect, brief.by_effect) == ((PAPER, CURED), (PAPER,))
    assert long.names("named") == tuple(WORLDS)
    assert brief.names("named") == ()
    assert sentences(brief)[-1].startswith("This is the short form.")
    assert set(SHORT.delays) < set(FULL.delays)
    assert set(SHORT.zeros) < set(FULL.zeros)


def test_another_twin_is_the_one_that_is_taken_apart(policy):
    harsh = read_world("twin:harsh")
    gap, calls = measured(policy, falls_early, world="twin:harsh", quick=True)
    assert (gap.world, gap.world_settings) == ("twin:harsh", harsh.settings)
    assert harsh.settings in {call.world for call in calls}
    assert {call.world.coulomb for call in calls if call.world} == {0.0, None}
    own = World("mine", WORLD.model_copy(update={"transport": 0.015}))
    assert measured(policy, falls_early, world=own, quick=True)[0].world == "mine"


def test_identification_on_a_changed_twin_is_that_of_the_twin_moved():
    found = Actuator.assumed("kst", delay=0.0102, lag=0.0085, cycle=0.0011).model_copy(
        update={"delay": Estimate(value=0.0102, low=0.0099, high=0.0105, source="identified")}
    )
    longer = WORLD.model_copy(update={"transport": 0.03, "lag": 0.004, "cycle": 4})
    moved = known(found, longer)
    assert (moved.delay.low, moved.delay.value, moved.delay.high) == pytest.approx(
        (0.0299, 0.0302, 0.0305)
    )
    assert [lag.value for lag in moved.lags] == pytest.approx([0.0045] * 6)
    assert moved.cycle.value == pytest.approx(0.0044)
    at_once = known(found, WORLD.model_copy(update={"transport": 0.0}))
    assert at_once.delay.value == pytest.approx(0.0002)
    assert at_once.delay.low == 0.0
    assert known(found, WORLD).digest == found.digest
    unshaped = known(found, longer.model_copy(update={"shaped": False}))
    assert unshaped == moved.model_copy(update={"kind": "unshaped"})


# Statistics


def test_intervals_are_students():
    rng = np.random.default_rng(5)
    one, two = rng.uniform(5.0, 30.0, (2, 12))
    a, b = lasting(*one), lasting(*two)
    witness = stats.ttest_1samp(one, 0.0).confidence_interval(0.95)
    assert mean(a, 60.0) == pytest.approx((np.mean(one), *witness))
    paired = stats.ttest_rel(one, two).confidence_interval(0.95)
    assert difference(a, b) == pytest.approx((np.mean(one - two), *paired))


def test_a_mean_survival_stays_within_the_trial():
    found = mean(lasting(0.1, 0.1, 0.1, 60.0), 60.0)
    assert found.low == 0.0
    assert mean(lasting(1.0, 60.0, 60.0, 60.0), 60.0).high == 60.0
    assert mean(lasting(60.0, 60.0), 60.0) == Seconds(60.0, 60.0, 60.0)


def test_a_difference_is_told_from_none_where_its_interval_leaves_zero():
    assert differs(Seconds(2.0, 1.0, 3.0))
    assert differs(Seconds(-2.0, -3.0, -1.0))
    assert not differs(Seconds(1.0, -0.1, 2.1))
    assert not differs(Seconds(0.0, 0.0, 0.0))


def test_the_track_has_its_share_of_the_failures_not_of_the_trials():
    results = TrialResults(
        name="",
        survival=(1.0, 2.0, 3.0, 60.0, 60.0),
        outcomes=tuple(map(Outcome, ("track", "angle", "track", "lasted", "lasted"))),
    )
    assert track_share(results) == pytest.approx(2.0 / 3.0)
    assert track_share(lasting(60.0, 60.0)) is None
    assert track_share(lasting(1.0, cause=Outcome.JOINT_LIMIT)) == 0.0
    guarded = TrialResults(
        name="",
        survival=(1.0, 2.0, 60.0),
        causes=("guard", "guard", "lasted"),
        guards=("track", "angle", ""),
    )
    assert track_share(guarded) == pytest.approx(0.5)


# Words


def test_words_follow_the_numbers(full):
    gap, _ = full
    short, way, latency, zero, effects, cured, *others = sentences(gap)
    unpredicted, unbiased, worlds, caveat = others
    clean, world = (gap.point(part, PAPER).results for part in ("clean", "world"))
    # At 10 ms the rule gives 90 / (1 + 800 * 0.01) s without prediction.
    assert "with its cures stands 60.0 of 60 s" in short
    assert f"as the paper describes {np.mean(world.survival):.1f} s" in short
    assert "It needs the prediction (without it " in short
    assert "stands 60.0 of 60 s on its own training plant, 60.0 s on the clean twin" in way
    assert f"{np.mean(world.survival):.1f} s on twin:nominal, 50 % of its falls" in way
    assert "The paper's stood 5 s on the real arm, once." in way
    # By the rule: 90 / (1 + 800 * 0.005) and 90 / (1 + 800 * 0.03), and 0.1 s on average.
    assert "60.0 s at 0 ms, 18.1 s at 5 ms," in latency
    assert "3.7 s at 30 ms (5 ms costs 41.9 s [" in latency
    assert "60.0 s at 0 deg," in zero
    assert "1 deg (0.25 deg costs " in zero
    alone = difference(clean, gap.point("alone", PAPER, "transport delay").results)
    assert f"these cost: transport delay ({alone.text}), zero error" in effects
    assert "these gain: transport delay" in effects
    assert "no significant difference" in cured
    assert "costs" in unpredicted
    assert "costs" in unbiased
    assert "pd 60.0 s (60.0 s), trajectory40 60.0 s (60.0 s)" in worlds
    assert "40 trials of 60 s" in caveat
    assert "not measurements of the authors' robot" in caveat


def test_other_numbers_make_other_words(policy):
    def stands(call, i):
        return 60.0

    def better_when_late(call, i):
        return 0.5 + 500.0 * (call.world.transport if call.world else 0.0) + 0.01 * i

    said = sentences(measured(policy, stands)[0])
    assert said[0].endswith("; these trials do not show that the cures help.")
    assert "these cost: none." in said[4]
    assert said[4].endswith("these gain: none.")
    assert all("no significant difference" in sentence for sentence in said[2:4])
    said = sentences(measured(policy, better_when_late)[0])
    assert "5 ms adds 2.5 s [2.5, 2.5]" in said[2]
    assert "these cost: none." in said[4]
    assert "Added alone, these gain: transport delay (5.0 s [5.0, 5.0])." in said[4]
    assert "Removed alone, these cost: transport delay (5.0 s [5.0, 5.0])." in said[4]


# Refusals


def test_what_cannot_be_compared_is_refused(policy):
    ideal = policy.model_copy(update={"actuators": (IDEAL_ACTUATOR,)})
    with pytest.raises(InputError, match="no cures to leave out"):
        measured(ideal, falls_early)
    measured(ideal, falls_early, actuator=policy.actuator, quick=True)
    with pytest.raises(InputError, match="was trained with an actuator"):
        measured(policy, falls_early, paper_policy=policy)
    other = paper_policy(policy).model_copy(update={"arm": iiwa(7)})
    with pytest.raises(InputError, match="differ in the arm"):
        measured(policy, falls_early, paper_policy=other)
    with pytest.raises(InputError, match="lies between model and a twin"):
        measured(policy, falls_early, world="model")
    with pytest.raises(SettingsError, match="there is no world 'mars'"):
        measured(policy, falls_early, world="mars")
    with pytest.raises(InputError, match="expected 2 or more"):
        measured(policy, falls_early, trials=1)


def test_a_study_is_read_as_it_was_written(short, tmp_path):
    gap, _ = short
    gap.save(tmp_path / "gap.json", command="test")
    assert Gap.load(tmp_path / "gap.json") == gap


# On the twin itself


@pytest.mark.compiled_only
def test_points_are_evaluations_whatever_the_number_of_workers(policy, monkeypatch):
    small = SHORT._replace(trials=2, duration=0.5, delays=(0.0, 0.02), zeros=(0.01,))
    monkeypatch.setattr(study, "SHORT", small)
    monkeypatch.setattr(study, "EFFECTS", {"dry friction": ("coulomb",)})
    options = {"paper_policy": paper_policy(policy), "quick": True, "seed": 3}
    gap = study.gap(policy, workers=2, **options)
    assert study.gap(policy, workers=1, **options) == gap
    late = WORLD.model_copy(update={"transport": 0.02})
    starts: EvaluationSettings = policy.settings.evaluation
    settings = policy.settings.model_copy(
        update={
            "evaluation": starts.model_copy(update={"trials": 2, "duration": 0.5}),
            "controller": policy.settings.controller.model_copy(update={"predict": False}),
        }
    )
    expected = evaluate(
        policy,
        settings,
        world=World("late", late),
        actuator=known(policy.actuator, late),
        seed=3,
        with_baselines=False,
    )
    assert gap.curve("delay", NO_PREDICTION)[1].results == expected.results


@pytest.mark.compiled_only
def test_the_table_of_the_paper_is_trained_by_its_recipe(policy, monkeypatch):
    few = ("learning.episodes=20", "selection.every=10", "selection.rounds=1")
    short = ("selection.round_trials=2", "selection.duration=1")
    monkeypatch.setattr(study, "BEST_TABLE", (*few, *short))
    table = study.train_paper(policy, seed=4)
    assert table.recipe.startswith("custom: paper with learning.episodes = ")
    assert (table.seed, table.actuator.kind) == (4, "ideal")
    assert table.settings.plant.ideal
    assert table.pendulum == policy.pendulum
    assert table.arm == policy.arm
    assert table.checkpoints


@pytest.mark.compiled_only
def test_the_pendulum_of_the_clean_twin_does_not_move_the_arm_and_swings_as_any():
    """A light pendulum must fall as a heavy one does, dry friction included."""
    pendulum = PendulumParameters(w2=70.2, k=7.16, c=0.15)
    dry = WORLD.model_copy(update={**CLEAN, "coulomb": 0.3})
    heavy = dry.model_copy(update={"pendulum_mass": 0.15, "rotor_inertia": 100.0})

    def swing(settings):
        twin = Twin(iiwa(7), pendulum, settings)
        twin.reset(phi=radians(120.0))
        angles, moved = [], 0.0
        for _ in range(200):
            twin.advance(0.01)
            angles.append(twin.truth().phi)
            moved = max(moved, abs(twin.truth().x))
        return np.array(angles), moved

    light, moved = swing(dry)
    reference, _ = swing(heavy)
    assert moved < 2e-4
    assert np.max(np.abs(light - reference)) < radians(0.5)
    _, moved_as_it_is = swing(WORLD)
    assert moved_as_it_is > 5.0 * moved
