"""Training of learners until a policy meets a target in trials that did not select it."""

import functools
from collections.abc import Sequence
from contextlib import closing
from typing import Any, Final, NamedTuple

from equipoise.artefacts import Count, Number, Value
from equipoise.control.policy import Checkpoint, LearningPoint, TabularPolicy, TargetTest
from equipoise.errors import InputError
from equipoise.executors import ThreadExecutor, Workers, executor_of
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
    TrainingTask,
    check_task,
    make_task,
    train_learner,
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


class TargetObserver(TrainingObserver):
    """Callbacks of a training to a target, for any thread."""

    def finished(self, result: LearnerResult) -> None:
        """Receive the figures of a tested learner."""


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
    workers: Workers = 1,
    observer: TargetObserver | None = None,
) -> TrainedLearners:
    """Train learners of one seed until one meets a target.

    The first learner has all workers for its trials. If it misses the target, the next ones are
    trained in parallel; the lowest number that meets the target is the result, so that it does not
    depend on the number of workers. Of the others only figures are kept, and the best policy.

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
        workers: Threads, or an executor; the result does not depend on it.
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
    task = make_task(pendulum, arm, settings, actuator, world, seed)
    search = _Search(task, target, observer or TargetObserver(), learners)
    search.finish(search.run(0, workers))
    executor = executor_of(workers)
    if world != MODEL:
        executor = ThreadExecutor(1)  # there is one CoppeliaSim, and Python steps a twin
    function = functools.partial(_run_elsewhere, task, target) if executor.is_remote else search.run
    needed = [learner for learner in range(1, learners) if search.is_needed(learner)]
    with closing(executor.completed(function, needed)) as completed:
        for _, policy in completed:
            search.finish(policy)
            if not any(map(search.is_needed, needed)):
                break
    results = sorted(search.results.values(), key=lambda result: result.learner)
    policy = search.best
    return TrainedLearners(policy, tuple(each for each in results if each.learner <= search.last))


class _DecidedError(Exception):
    """A learner of a lower number meets the target."""


class _Search(TrainingObserver):
    """Learners of a task that have finished, and the best policy of them.

    It passes callbacks on, and ends a learner that is no longer needed at its next report.
    """

    best: TabularPolicy

    def __init__(
        self, task: TrainingTask, target: float, observer: TargetObserver, learners: int
    ) -> None:
        self._task, self._target, self._observer = task, target, observer
        self.results: dict[int, LearnerResult] = {}
        self.last = learners
        """Lowest number of a learner that meets the target, else the number of learners."""
        self.selecting, self.testing = observer.selecting, observer.testing

    def is_needed(self, learner: int) -> bool:
        """Return whether a learner has not finished, and none of a lower number is enough."""
        return learner <= self.last and learner not in self.results

    def report(self, learner: int, point: LearningPoint) -> None:
        """Pass a point of a learning curve on, or end a learner that is not needed."""
        if not self.is_needed(learner):
            raise _DecidedError
        self._observer.report(learner, point)

    def run(self, learner: int, workers: Workers = 1) -> TabularPolicy | None:
        """Train and test a learner in this process; return None if it is not needed."""
        if not self.is_needed(learner):
            return None
        try:
            policy = train_learner(self._task, learner, workers, self)
        except _DecidedError:
            return None
        return _tested(
            policy,
            self._target,
            workers,
            lambda done, of: self._observer.testing(learner, done, of),
        )

    def finish(self, policy: TabularPolicy | None) -> None:
        """Keep the figures of a tested learner, and its policy if it is the best."""
        if policy is None or (test := policy.test) is None:
            return
        chosen = policy.checkpoints[0] if policy.checkpoints else None
        result = LearnerResult(
            learner=policy.learner,
            steps=policy.steps,
            episodes=policy.episodes if chosen is None else chosen.episodes,
            score=None if chosen is None else chosen.score,
            test=test,
        )
        if not self.results or _rank(policy) > _rank(self.best):
            self.best = policy
        self.results[policy.learner] = result
        if test.met:
            self.last = min(self.last, policy.learner)
        self._observer.finished(result)


def _rank(policy: TabularPolicy) -> tuple[float, ...]:
    """Return the sort key of a tested policy; the highest one is the best."""
    if policy.shortfall == "":
        return (1.0, -policy.learner)
    low = 0.0 if policy.test is None else policy.test.interval[0]
    return (0.0, low, policy.checkpoints[0].score if policy.checkpoints else 0.0, -policy.learner)


def _run_elsewhere(task: TrainingTask, target: float, learner: int) -> TabularPolicy:
    """Train, select and test one learner in another process."""
    return _tested(train_learner(task, learner, 1, TrainingObserver()), target, 1)


def _tested(
    policy: TabularPolicy,
    target: float,
    workers: Workers,
    running: Running = lambda _, __: None,
) -> TabularPolicy:
    """Return a policy of `train_to_target` with its tests."""
    error = _error(policy.learner)
    tests = measure_policy(policy, target=target, error=error, workers=workers, running=running)
    return policy.model_copy(update={"tests": tests})


def _error(learner: int) -> float:
    """Return the error of the test of a learner; the sum over all learners is `ERROR`."""
    return ERROR / ((learner + 1) * (learner + 2))


def measure_policy(
    policy: TabularPolicy,
    *,
    target: float = TARGET,
    error: float = ERROR,
    workers: Workers = 1,
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
    workers: Workers = 1,
    running: Running = lambda _, __: None,
) -> list[Checkpoint]:
    """Race policies on the model of the first one; return their results, in the given order.

    Args:
        policies: At least one.
        seed: Master seed of the trials; choose one that trained none of the policies.
        workers: Threads, or an executor; the result does not depend on it.
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
