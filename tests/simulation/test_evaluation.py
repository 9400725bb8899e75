"""Evaluation: what it counts, with what confidence, and that any policy runs the same trials."""

import pytest
from scipy import stats

from equipoise import bind_policy, resolve
from equipoise.control.linear import baselines
from equipoise.executors import counted
from equipoise.outcomes import Outcome
from equipoise.simulation.evaluation import TrialResults, evaluate

SHORT = resolve(overrides=["evaluation.trials=20", "evaluation.duration=1.5"])


class Plain:
    """Any object with `act`: here it hands the question on, and meddles with what it was shown."""

    def __init__(self, policy):
        self.policy, self.reset, self.asked = policy, policy.reset, []

    def act(self, state):
        self.asked.append(state.shape)
        u = self.policy.act(state)
        state[:] = 0.0
        return u


@pytest.fixture(scope="module")
def evaluation(small_policy):
    return evaluate(small_policy, SHORT, seed=3)


def test_a_summary_counts_what_happened():
    summary = TrialResults(
        name="policy",
        survival=(60.0, 1.0, 2.0, 3.0, 60.0),
        outcomes=tuple(map(Outcome, ("survived", "angle", "track", "angle", "survived"))),
    ).summary()
    assert (summary.trials, summary.survived, summary.rate) == (5, 2, 0.4)
    # Clopper and Pearson's, as quantiles of the beta distribution.
    assert summary.interval == pytest.approx(stats.beta.ppf((0.025, 0.975), (2, 3), (4, 3)))
    assert summary.median == 3.0
    assert summary.outcomes == {"survived": 2, "angle": 2, "track": 1}


def test_progress_moves_within_a_trial():
    shown = []
    done = counted("evaluate", 2, lambda *progress: shown.append(progress))
    for part in (0.3, 0.3, 0.3, 0.1):
        done(part)
    assert [fraction for _, fraction, _ in shown] == pytest.approx([0.15, 0.3, 0.45, 0.5])
    assert [text for *_, text in shown] == ["0 of 2 trials"] * 3 + ["1 of 2 trials"]


# The trials


def test_an_evaluation_says_what_was_evaluated(evaluation, small_policy):
    assert (evaluation.policy, evaluation.arm) == (small_policy.digest, "iiwa14")
    assert (evaluation.world, evaluation.world_settings) == ("model", None)
    assert evaluation.actuator == small_policy.actuator.digest
    assert (evaluation.settings, evaluation.seed, evaluation.duration) == (SHORT, 3, 1.5)
    names = list(baselines(small_policy.pendulum.parameters(), 0.01))
    assert [beside.name for beside in evaluation.baselines] == names


def test_the_table_as_a_plain_object_runs_the_same_trials(small_policy, evaluation):
    plain, told = Plain(small_policy), []
    bound = bind_policy(plain, name="plain", pendulum=small_policy.pendulum, arm=small_policy.arm)
    other = evaluate(bound, SHORT, world="ideal", seed=3, with_baselines=False, done=told.append)
    assert other.baselines == ()
    assert other.results.survival == evaluation.results.survival
    assert other.results.outcomes == evaluation.results.outcomes
    assert other.results.name == "plain"
    assert (other.pendulum, other.arm_digest) == (evaluation.pendulum, evaluation.arm_digest)
    assert len(told) == 20 + sum(time >= 1.0 for time in other.results.survival)
    assert sum(told) == pytest.approx(20)
    assert len(plain.asked) == round(sum(other.results.survival) * 100)
    assert set(plain.asked) == {(4,)}
