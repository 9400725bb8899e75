"""Evaluation: what it counts, with what confidence, and that any policy runs the same trials."""

import hypothesis
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from equipoise import paper
from equipoise.control.baselines import baselines
from equipoise.control.bound_policy import bind_policy
from equipoise.control.policy import act
from equipoise.errors import ArtefactError
from equipoise.learning.train import train
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator
from equipoise.model.arms.iiwa import iiwa
from equipoise.outcomes import Outcome
from equipoise.settings import resolve
from equipoise.worlds.evaluation import Evaluation, TrialResults, evaluate

SHORT = ["evaluation.trials=20", "evaluation.duration=1.5"]


class Plain:
    """Any object with `act`: here it hands the question on."""

    def __init__(self, policy):
        self.policy = policy
        self.asked = []

    def reset(self):
        self.policy.reset()

    def act(self, state):
        self.asked.append(state)
        return self.policy.act(state)


class Yardstick:
    """A compiled yardstick as a plain object."""

    def __init__(self, kernel):
        self._kernel = kernel

    def act(self, state):
        return act(self._kernel, *(float(value) for value in state), 0.0)


class Constant:
    """Always the same acceleration."""

    def __init__(self, u):
        self.u = u

    def act(self, _):
        return self.u


def results(survived, trials, duration=60.0):
    lasted = [(duration, "lasted")] * survived
    fell = [(1.0 + i, "angle" if i % 2 else "track") for i in range(trials - survived)]
    survival, causes = zip(*lasted, *fell, strict=True)
    return TrialResults(name="policy", survival=survival, outcomes=causes)


@pytest.fixture(scope="module")
def settings():
    return resolve(overrides=SHORT)


@pytest.fixture(scope="module")
def evaluation(small_policy, settings):
    return evaluate(small_policy, settings, seed=3)


# Numbers


@pytest.mark.parametrize("trials", [1, 2, 20, 200, 1000])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.99, 1.0])
def test_the_interval_is_that_of_clopper_and_pearson(trials, share):
    k = round(share * trials)
    low, high = results(k, trials).summary().interval
    # Closed form by quantiles of the beta distribution, with the two ends that it lacks.
    assert low == pytest.approx(stats.beta.ppf(0.025, k, trials - k + 1) if k else 0.0, abs=1e-9)
    assert high == pytest.approx(
        stats.beta.ppf(0.975, k + 1, trials - k) if k < trials else 1.0, abs=1e-9
    )
    assert low <= k / trials <= high


def test_the_interval_of_none_and_all_has_its_known_ends():
    # (alpha/2)^(1/n): where all of n lasted, and where none did.
    end = 0.025 ** (1 / 200)
    assert results(200, 200).summary().interval == pytest.approx((end, 1.0), abs=1e-12)
    assert results(0, 200).summary().interval == pytest.approx((0.0, 1.0 - end), abs=1e-12)


@hypothesis.settings(max_examples=30)
@given(trials=st.integers(1, 40), p=st.floats(0.01, 0.99))
def test_the_interval_holds_the_true_probability_in_95_percent_of_cases(trials, p):
    # Exactly, by summing the binomial probabilities of all outcomes whose interval holds p.
    covered = sum(
        stats.binom.pmf(k, trials, p)
        for k in range(trials + 1)
        if (interval := results(k, trials).summary().interval)[0] <= p <= interval[1]
    )
    assert covered >= 0.95 - 1e-9


def test_a_summary_counts_what_happened():
    summary = TrialResults(
        name="policy",
        survival=(60.0, 1.0, 2.0, 3.0, 60.0),
        outcomes=tuple(map(Outcome, ("lasted", "angle", "track", "angle", "lasted"))),
    ).summary()
    assert (summary.trials, summary.survived, summary.rate) == (5, 2, 0.4)
    assert summary.median == 3.0
    # Linear between the ordered numbers 1, 2, 3, 60, 60.
    assert summary.quantiles == pytest.approx((1.2, 2.0, 60.0, 60.0))
    assert summary.outcomes == {"lasted": 2, "angle": 2, "track": 1}


# The trials


@pytest.mark.compiled_only
def test_an_evaluation_says_what_was_evaluated(evaluation, small_policy, settings):
    assert evaluation.policy == small_policy.digest
    assert evaluation.pendulum == small_policy.pendulum.digest
    assert (evaluation.arm, evaluation.arm_digest) == ("iiwa14", small_policy.arm.digest)
    assert (evaluation.world, evaluation.world_settings) == ("model", None)
    assert evaluation.actuators == (small_policy.actuator.digest,)
    assert (evaluation.settings, evaluation.seed, evaluation.duration) == (settings, 3, 1.5)
    assert len(evaluation.results.survival) == len(evaluation.results.outcomes) == 20
    assert [beside.name for beside in evaluation.baselines] == list(
        baselines(small_policy.pendulum.parameters(), 0.01)
    )


@pytest.mark.compiled_only
def test_a_trial_lasted_when_it_took_all_of_its_time(evaluation):
    for beside in (evaluation.results, *evaluation.baselines):
        for survival, cause in zip(beside.survival, beside.outcomes, strict=True):
            assert cause in Outcome
            assert 0.0 < survival <= 1.5
            assert survival == 1.5 or cause != "lasted"
            # A whole number of steps.
            assert survival * 100 == pytest.approx(round(survival * 100), abs=1e-9)


@pytest.mark.compiled_only
def test_equal_seeds_give_equal_evaluations_whatever_the_workers(
    small_policy, settings, evaluation
):
    many = settings.model_copy(
        update={"evaluation": settings.evaluation.model_copy(update={"trials": 150})}
    )
    digests = {evaluate(small_policy, many, seed=3, workers=w).digest for w in (1, 2, 3)}
    assert len(digests) == 1
    assert evaluate(small_policy, settings, seed=3).digest == evaluation.digest
    assert evaluate(small_policy, settings, seed=4).results != evaluation.results
    # More trials begin with the same ones.
    few = evaluation.results
    first = evaluate(small_policy, many, seed=3).results
    assert (first.survival[:20], first.outcomes[:20]) == (few.survival, few.outcomes)


@pytest.mark.compiled_only
def test_without_settings_those_of_the_policy_hold(small_policy):
    evaluation = evaluate(small_policy, seed=3, with_baselines=False)
    assert evaluation.settings == small_policy.settings
    assert evaluation.baselines == ()
    assert evaluation.duration == 2.0


@pytest.mark.compiled_only
def test_every_finished_trial_is_told_of_once(small_policy, settings):
    told = []
    evaluate(small_policy, settings, done=told.append)
    assert sum(told) == 20 * 5  # the policy and four yardsticks
    told.clear()
    evaluate(small_policy, settings, with_baselines=False, done=told.append)
    assert sum(told) == 20


@pytest.mark.compiled_only
def test_the_yardsticks_stand_as_they_should(evaluation):
    beside = {results.name: results.summary() for results in evaluation.baselines}
    assert beside["LQR"].rate == beside["LQR, snapped"].rate == 1.0
    assert beside["random"].rate == 0.0
    assert beside["random"].median < 0.5


@pytest.mark.compiled_only
def test_the_table_as_a_plain_object_runs_the_same_trials(small_policy, settings, evaluation):
    plain = Plain(small_policy)
    told = []
    other = evaluate(
        bind_policy(plain, name="plain", pendulum=small_policy.pendulum, arm=small_policy.arm),
        settings,
        world="ideal",
        seed=3,
        with_baselines=False,
        done=told.append,
    )
    assert other.baselines == ()
    assert other.results.survival == evaluation.results.survival
    assert other.results.outcomes == evaluation.results.outcomes
    assert other.results.name == "plain"
    assert (other.pendulum, other.arm_digest) == (evaluation.pendulum, evaluation.arm_digest)
    assert told == [0] + [1] * 20
    assert len(plain.asked) == round(sum(other.results.survival) * 100)
    assert all(state.shape == (4,) for state in plain.asked)


@pytest.mark.compiled_only
@pytest.mark.parametrize("world", ["ideal", "model", "twin:nominal"])
def test_yardsticks_as_plain_objects_run_the_same_trials(small_policy, world):
    overrides = ["evaluation.trials=6", "evaluation.duration=1.5", "plant.linearised=true"]
    settings = resolve(overrides=overrides)
    there = {"world": world, "actuator": KST, "seed": 3}
    evaluated = evaluate(small_policy, settings, **there)
    compiled = {results.name: results for results in evaluated.baselines}
    kernels = baselines(small_policy.pendulum.parameters(linearised=True), 0.01)
    for name in ("LQR", "LQR, snapped", "PD"):
        plain = evaluate(
            bind_policy(
                Yardstick(kernels[name]),
                name=name,
                pendulum=small_policy.pendulum,
                arm=small_policy.arm,
            ),
            settings,
            **there,
            with_baselines=False,
        )
        assert plain.results == compiled[name]
    ideal = evaluated.actuators == (IDEAL_ACTUATOR.digest,)
    assert ideal == (world == "ideal")


def test_a_policy_in_python_cannot_change_the_plant(pendulum, settings):
    class Meddles(Constant):
        def act(self, state):
            state[:] = 0.0
            return self.u

    few = settings.model_copy(
        update={"evaluation": settings.evaluation.model_copy(update={"trials": 4})}
    )
    honest, meddling = (
        evaluate(bind_policy(policy, pendulum=pendulum, arm=iiwa(14)), few, world="ideal")
        for policy in (Constant(0.5), Meddles(0.5))
    )
    assert honest.results.survival == meddling.results.survival


def test_a_constant_push_fails_at_once(pendulum, settings):
    few = settings.model_copy(
        update={"evaluation": settings.evaluation.model_copy(update={"trials": 6})}
    )
    evaluation = evaluate(
        bind_policy(Constant(max(paper.ACTIONS)), pendulum=pendulum), few, world="ideal"
    )
    summary = evaluation.results.summary()
    assert summary.outcomes == {"angle": 6}
    assert summary.survived == 0
    assert max(evaluation.results.survival) < 0.5


@pytest.mark.compiled_only
def test_worse_plants_are_harder(small_policy):
    def median(*overrides):
        settings = resolve(overrides=["evaluation.trials=60", "evaluation.duration=5", *overrides])
        return evaluate(small_policy, settings, with_baselines=False).results.summary().median

    shaken = median("plant.position_error_sigma=0.005", "plant.orientation_error_sigma=0.05")
    assert shaken < median()


# Behind an actuator

KST = Actuator.assumed("kst", delay=0.01, lag=0.008)


@pytest.fixture(scope="module")
def policy_behind(pendulum, quick_settings):
    """A policy that has hardly been trained, behind an actuator."""
    return train(pendulum, iiwa(14), quick_settings, actuator=KST, seed=7)


@pytest.mark.compiled_only
def test_a_policy_is_evaluated_behind_the_actuator_of_its_training(policy_behind, settings):
    evaluation = evaluate(policy_behind, settings, seed=3)
    assert evaluation.actuators == (KST.digest,)
    same = evaluate(policy_behind, settings, seed=3, actuator=KST, workers=2)
    assert same.digest == evaluation.digest
    # The yardsticks stand on what the controller shows them.
    beside = {results.name: results.summary() for results in evaluation.baselines}
    assert beside["LQR"].rate == 1.0


@pytest.mark.compiled_only
def test_another_actuator_makes_another_evaluation(policy_behind, settings):
    here = evaluate(policy_behind, settings, seed=3)
    there = evaluate(policy_behind, settings, seed=3, actuator=IDEAL_ACTUATOR)
    assert there.actuators == (IDEAL_ACTUATOR.digest,)
    assert there.policy == here.policy
    assert there.results.survival != here.results.survival


@pytest.mark.compiled_only
def test_delay_without_prediction_is_what_makes_a_policy_fall(pendulum, settings):
    # LQR, which stands behind 60 ms where it is shown what comes, and falls on what is.
    def rate(*overrides):
        changed = resolve(overrides=[*SHORT, "evaluation.duration=5", *overrides])
        policy = train(
            pendulum,
            iiwa(14),
            resolve(overrides=["learning.episodes=1", "selection.every=0", *overrides]),
            actuator=Actuator.assumed("kst", delay=0.06, lag=0.008),
        )
        beside = evaluate(policy, changed, seed=3).baselines
        return {results.name: results.summary().rate for results in beside}["LQR, snapped"]

    assert rate() == 1.0
    assert rate("controller.predict=false") < 0.5


# The file


@pytest.mark.compiled_only
def test_an_evaluation_comes_back_from_its_file(evaluation, tmp_path):
    path = tmp_path / "evaluation.json"
    evaluation.save(path, command="test")
    read = Evaluation.load(path)
    assert read == evaluation
    assert read.results.summary() == evaluation.results.summary()


@pytest.mark.compiled_only
def test_a_trial_that_was_turned_into_a_success_is_found(evaluation, tmp_path):
    path = tmp_path / "evaluation.json"
    evaluation.save(path, command="test")
    text = path.read_text()
    assert '"angle"' in text
    path.write_text(text.replace('"angle"', '"lasted"', 1))
    with pytest.raises(ArtefactError, match="does not match its digest"):
        Evaluation.load(path)


def test_rates_are_derived_and_not_stored():
    assert not {"rate", "interval", "survived"} & set(TrialResults.model_fields)
    assert not {"rate", "interval", "survived"} & set(Evaluation.model_fields)


@pytest.mark.parametrize("kind", [TrialResults, Evaluation])
def test_every_field_has_its_docstring(kind):
    assert all(field.description for field in kind.model_fields.values())


def test_survival_is_told_in_seconds_without_rounding_errors(small_policy):
    settings = resolve(overrides=["evaluation.trials=3", "evaluation.duration=0.29"])
    survival = evaluate(small_policy, settings).baselines[0].survival
    assert survival == (0.29, 0.29, 0.29)
    assert np.all(np.array(survival) == settings.evaluation.duration)
