"""Evaluation: what it counts, with what confidence, and that any policy runs the same trials."""

import pytest
from scipy import stats

from equipoise.control.baselines import baselines
from equipoise.control.bound_policy import bind_policy
from equipoise.learning.train import train
from equipoise.model.actuator import Actuator
from equipoise.model.arms.iiwa import iiwa
from equipoise.outcomes import Outcome
from equipoise.settings import resolve
from equipoise.worlds.evaluation import TrialResults, evaluate

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


@pytest.mark.parametrize("trials", [1, 20, 1000])
@pytest.mark.parametrize("share", [0.0, 0.99, 1.0])
def test_the_interval_is_that_of_clopper_and_pearson(trials, share):
    k = round(share * trials)
    low, high = results(k, trials).summary().interval
    # Closed form by quantiles of the beta distribution, with the two ends that it lacks.
    assert low == pytest.approx(stats.beta.ppf(0.025, k, trials - k + 1) if k else 0.0, abs=1e-9)
    assert high == pytest.approx(
        stats.beta.ppf(0.975, k + 1, trials - k) if k < trials else 1.0, abs=1e-9
    )
    assert low <= k / trials <= high


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
    assert (evaluation.policy, evaluation.arm) == (small_policy.digest, "iiwa14")
    assert (evaluation.world, evaluation.world_settings) == ("model", None)
    assert evaluation.actuators == (small_policy.actuator.digest,)
    assert (evaluation.settings, evaluation.seed, evaluation.duration) == (settings, 3, 1.5)
    names = list(baselines(small_policy.pendulum.parameters(), 0.01))
    assert [beside.name for beside in evaluation.baselines] == names


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
    assert told == [1] * 20
    assert len(plain.asked) == round(sum(other.results.survival) * 100)
    assert all(state.shape == (4,) for state in plain.asked)


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


# Behind an actuator


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
