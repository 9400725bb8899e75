"""Training of learners until a policy meets a target in trials that did not select it."""

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

from equipoise.artefacts import Count, Number, Value
from equipoise.control.policy import Checkpoint, TabularPolicy, TargetTest
from equipoise.errors import InputError
from equipoise.learning.select import (
    ERROR,
    Candidate,
    Running,
    TrialPlant,
    measure_share,
    race,
    trial_plants,
    trials_to_meet,
)
from equipoise.learning.train import (
    Actuators,
    TrainingObserver,
    check_task,
    train,
)
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import Pendulum
from equipoise.model.worlds import MODEL
from equipoise.settings import Settings

LEARNERS: Final = 6
"""Maximum number of learners of a training by default."""
TARGET: Final = 0.99
"""Required share of trials that last, by default [-]."""


class LearnerResult(Value):
    """Figures of a learner that has been trained and tested."""

    learner: Count
    """Number of the learner."""
    steps: Count
    """Number of its control steps."""
    episodes: Count
    """Number of episodes of the selected policy."""
    score: Number | None
    """Score of the selected policy in the race; None without a selection."""
    test: TargetTest
    """Test of the selected policy."""


class TrainedLearners(NamedTuple):
    """Result of a training to a target."""

    policy: TabularPolicy
    """Policy of the first learner that meets the target; if none meets it, the one with the highest
    lower end of the interval."""
    learners: tuple[LearnerResult, ...]
    """Figures of all learners up to the first that meets the target."""


def train_to_target(
    pendulum: Pendulum,
    arm: Arm,
    settings: Settings,
    *,
    target: float = TARGET,
    learners: int = LEARNERS,
    actuator: Actuators = None,
    world: str = MODEL,
    seed: int = 0,
    workers: int = 1,
    observer: TrainingObserver | None = None,
) -> TrainedLearners:
    """Train learners of one seed, one after the other, until one meets a target.

    A policy below the target is accepted with a probability of at most 5 %, over all learners.

    Args:
        pendulum: The identified pendulum.
        arm: The arm with its home posture.
        settings: Resolved settings; as in `train`.
        target: Share of trials that a policy has to last: the lower end of its interval.
        learners: Maximum number of learners.
        actuator: Actuator of the arm; as in `train`.
        world: World of the episodes; as in `train`.
        seed: Master seed.
        workers: Number of threads of the trials; the result does not depend on it.
        observer: Callbacks.

    Raises:
        InputError: The test has too few trials for the target, even without a failure.
        SettingsError: No controller saves as many of the releases as the target needs.
    """
    most = settings.selection.test_trials
    if trials_to_meet(target, _error(0), 0, 0, most) is None:
        raise InputError(
            f"{most:,} trials cannot show a share of {target:g}, even without a failure; lower "
            "--target, or raise selection.test_trials"
        )
    if learners < 1:
        raise InputError(f"{learners} learners are given, expected at least one")
    check_task(pendulum, arm, settings, actuator, world=world, target=target)
    observer = observer or TrainingObserver()
    tested: list[TabularPolicy] = []
    results: list[LearnerResult] = []
    for learner in range(learners):

        def testing(done: int, of: int, learner: int = learner) -> None:
            observer.testing(learner, done, of)

        policy = train(
            pendulum,
            arm,
            settings,
            actuator=actuator,
            world=world,
            seed=seed,
            learner=learner,
            workers=workers,
            observer=observer,
        )
        tests = measure_policy(
            policy, target=target, error=_error(learner), workers=workers, running=testing
        )
        tested.append(policy.model_copy(update={"tests": tests}))
        if (test := tested[-1].test) is not None:
            results.append(_figures(tested[-1], test))
            if test.met:
                break
    best = max(range(len(results)), key=lambda i: _rank(results[i]))
    return TrainedLearners(tested[best], tuple(results))


def _rank(result: LearnerResult) -> tuple[bool, float, float]:
    """Return the sort key of a tested learner; the highest one is the best."""
    return result.test.met, result.test.interval[0], result.score or 0.0


def _figures(policy: TabularPolicy, test: TargetTest) -> LearnerResult:
    """Return the figures of a tested learner."""
    chosen = policy.checkpoints[0] if policy.checkpoints else None
    return LearnerResult(
        learner=policy.learner,
        steps=policy.steps,
        episodes=policy.episodes if chosen is None else chosen.episodes,
        score=None if chosen is None else chosen.score,
        test=test,
    )


def _error(learner: int) -> float:
    """Return the error of the test of a learner; the sum over all learners is `ERROR`."""
    return ERROR / ((learner + 1) * (learner + 2))


def measure_policy(
    policy: TabularPolicy,
    *,
    target: float = TARGET,
    error: float = ERROR,
    workers: int = 1,
    running: Running = lambda _, __: None,
) -> tuple[TargetTest, ...]:
    """Test a policy behind each of its actuators; see `equipoise.learning.select.measure_share`.

    A policy whose share is below the target behind any of them meets it behind all with a
    probability of at most `error`.
    """
    finished, tests = 0, list[TargetTest]()
    for plant in _plants(policy, policy.seed):

        def add(done: int, of: int, before: int = finished) -> None:
            running(before + done, before + of)

        given: Any = {"target": target, "error": error, "workers": workers, "running": add}
        tests.append(measure_share(plant, policy.u_of_box, **given))
        finished += tests[-1].trials
    return tuple(tests)


def compare_policies(
    policies: Sequence[TabularPolicy],
    *,
    seed: int = 0,
    workers: int = 1,
    running: Running = lambda _, __: None,
) -> list[Checkpoint]:
    """Race policies on the model of the first one; return their results, in the given order.

    Args:
        policies: At least one.
        seed: Master seed of the trials; choose one that trained none of the policies.
        workers: Number of threads of the trials; the result does not depend on it.
        running: Called as trials finish.
    """
    plants = _plants(policies[0], seed)
    candidates = [Candidate(policy.episodes, policy.u_of_box) for policy in policies]
    return [
        result for _, result in sorted(race(plants, candidates, workers=workers, running=running))
    ]


def _plants(policy: TabularPolicy, seed: int) -> list[TrialPlant]:
    """Return the inputs of trials on the plants of a policy's training."""
    return trial_plants(policy.pendulum, policy.arm, policy.settings, policy.actuators, seed)
