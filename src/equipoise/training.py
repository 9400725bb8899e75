"""Training of a policy for a pendulum and an arm.

A training runs its episodes in one compiled loop (`equipoise.learning.episodes`) and takes the
greedy policies of its later tables as candidates. They race on common trials, and the winner is
tested in trials that chose nothing (`equipoise.selection`). Learners are trained one after the
other until one meets the target. Equal seeds give equal bits, for any number of workers, and also
after a resumed interruption.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from threading import Lock
from typing import Any, Final, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.artefacts import PartialFile, Provenance, StrPath, value_digest
from equipoise.checks.recoverable import check_releases
from equipoise.compiled import kernel_sources_digest
from equipoise.control.boxes import ACTIONS, partition
from equipoise.control.policy import (
    Checkpoint,
    LearningPoint,
    TabularPolicy,
    TargetTest,
    greedy_accelerations,
)
from equipoise.errors import ArtefactError, InputError
from equipoise.learning.checkpoint import (
    LearnerResult,
    LearnerState,
    ResumePoint,
    StoredCandidate,
    pack,
    table,
    unpack,
)
from equipoise.learning.choice import compile_learner, load_learner, with_digests
from equipoise.learning.episodes import (
    ENDED,
    ENDED_STEPS,
    STEPS,
    TrainingConfig,
    TrainingState,
    new_training_loop,
    new_training_state,
    train_episodes,
)
from equipoise.learning.learner import UpdateParams
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator, shipped_actuator
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import Pendulum
from equipoise.selection import (
    ERROR,
    Candidate,
    Running,
    measure_share,
    race,
    trial_plant,
    trials_to_meet,
)
from equipoise.settings import SelectionSettings, Settings
from equipoise.simulation.trials import run_over_cores

Array = npt.NDArray[np.float64]

MAX_REPORTS: Final = 200
"""Number of progress reports of a training without candidates."""
LEARNERS: Final = 6
"""Maximum number of learners of a training by default."""
TARGET: Final = 0.99
"""Required share of trials that last, by default [-]."""

Report = Callable[[LearningPoint], None]
"""Callback for each new point of the learning curve."""


def train(
    pendulum: Pendulum,
    arm: Arm,
    settings: Settings,
    *,
    actuator: Actuator | None = None,
    seed: int = 0,
    learner: int = 0,
    init_policy: TabularPolicy | None = None,
    workers: int = 1,
    partial: StrPath | None = None,
    report: Report = lambda _: None,
    selecting: Running = lambda _, __: None,
) -> TabularPolicy:
    """Train one learner, and select its best policy; `train_to_target` tests it, too.

    Args:
        pendulum: The identified pendulum.
        arm: The arm with its home posture.
        settings: Resolved settings; the sections clik, controller, plant, learning and selection
            are used.
        actuator: Actuator of the arm; by default ideal with `plant.ideal`, else the shipped one,
            identified from the twin.
        seed: Master seed.
        learner: Index of the learner, each with its own random numbers.
        init_policy: Policy with the initial table and visits; by default zeros.
        workers: Threads for the selection trials; the result does not depend on it.
        partial: File for checkpoints. The training resumes from an existing one. The file is kept;
            delete it once the policy is saved.
        report: Called with each new point of the learning curve; first with the last one of a
            checkpoint.
        selecting: Called as trials of the race finish, with their number and the expected one; also
            from other threads.

    Returns:
        The policy, with its learning curve and the results of its race.

    Raises:
        ArtefactError: `partial` is the checkpoint of another training, or damaged.
        OutsideError: The disk rejects a checkpoint.
        SettingsError: No controller saves any of the releases.
    """
    task = _task(pendulum, arm, settings, actuator, seed, init_policy)
    with _Checkpoints(partial, task, {"number of the learner": str(learner)}) as checkpoints:
        return _train(task, learner, workers, checkpoints, report, selecting)


class TrainedLearners(NamedTuple):
    """Result of a training to a target."""

    policy: TabularPolicy
    """Policy of the first learner that meets the target, of a population that of the best score; if
    none meets it, the one with the highest lower end of the interval."""
    learners: tuple[LearnerResult, ...]
    """Figures of all learners up to the first that meets the target; of a population, of all."""


class TargetProgress:
    """Callbacks of a training to a target, each with the number of the learner; for any thread."""

    def report(self, learner: int, point: LearningPoint) -> None:
        """Receive a point of a learning curve."""

    def selecting(self, learner: int, done: int, of: int) -> None:
        """Receive the number of finished trials of a race, and the expected one."""

    def testing(self, learner: int, done: int, of: int) -> None:
        """Receive the number of finished trials of a test, and the one that meets the target."""

    def finished(self, result: LearnerResult) -> None:
        """Receive the figures of a tested learner."""

    def ended(self) -> None:
        """Receive the end of the training."""


def train_to_target(
    pendulum: Pendulum,
    arm: Arm,
    settings: Settings,
    *,
    target: float = TARGET,
    learners: int = LEARNERS,
    population: bool = False,
    actuator: Actuator | None = None,
    seed: int = 0,
    workers: int = 1,
    partial: StrPath | None = None,
    progress: TargetProgress | None = None,
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
        population: Whether all learners are trained, in parallel, also if one meets the target.
        actuator: Actuator of the arm; as in `train`.
        seed: Master seed.
        workers: Threads; the result does not depend on it.
        partial: File for the checkpoints of all learners; as in `train`.
        progress: Callbacks.

    Raises:
        ArtefactError: `partial` is the checkpoint of another training, or damaged.
        InputError: The test has too few trials for the target, even without a failure.
        OutsideError: The disk rejects a checkpoint.
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
    task = _task(pendulum, arm, settings, actuator, seed, None, target)
    shown = progress or TargetProgress()
    wanted = {"target": str(target), "--all": str(population)}
    with _Checkpoints(partial, task, wanted, population) as checkpoints:

        def run(learner: int, workers: int = 1) -> None:
            def report(point: LearningPoint) -> None:
                if checkpoints.is_decided(learner):
                    raise _DecidedError
                shown.report(learner, point)

            def selecting(done: int, of: int) -> None:
                shown.selecting(learner, done, of)

            def testing(done: int, of: int) -> None:
                shown.testing(learner, done, of)

            if checkpoints.is_decided(learner) or checkpoints.is_finished(learner):
                return
            try:
                policy = _train(task, learner, workers, checkpoints, report, selecting)
            except _DecidedError:
                return
            given: Any = {"error": _error(learner), "workers": workers, "running": testing}
            test = measure_policy(policy, target=target, **given)
            policy = policy.model_copy(update={"test": test})
            checkpoints.finish(policy, test)
            shown.finished(_result(policy, test))

        if not population:
            run(0, workers)
        run_over_cores(run, range(learners), workers)
        shown.ended()
        policy = cast(TabularPolicy, checkpoints.best)
        decided = not population and policy.test and policy.test.met
        last = policy.learner if decided else learners
        results = sorted(checkpoints.finished, key=lambda result: result.learner)
    return TrainedLearners(policy, tuple(each for each in results if each.learner <= last))


def measure_policy(
    policy: TabularPolicy,
    *,
    target: float = TARGET,
    error: float = ERROR,
    workers: int = 1,
    running: Running = lambda _, __: None,
) -> TargetTest:
    """Test a policy on its own model; see `equipoise.selection.measure_share`."""
    plant = trial_plant(policy.pendulum, policy.arm, policy.settings, policy.actuator, policy.seed)
    given: Any = {"target": target, "error": error, "workers": workers, "running": running}
    return measure_share(plant, policy.u_of_box, **given)


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
        workers: Threads; the result does not depend on it.
        running: Called as trials finish, also from other threads.
    """
    model = policies[0]
    plant = trial_plant(model.pendulum, model.arm, model.settings, model.actuator, seed)
    candidates = [Candidate(policy.episodes, policy.u_of_box) for policy in policies]
    return [
        result for _, result in sorted(race(plant, candidates, workers=workers, running=running))
    ]


def _error(learner: int) -> float:
    """Return the error of the test of a learner; the sum over all learners is `ERROR`."""
    return ERROR / ((learner + 1) * (learner + 2))


class _DecidedError(Exception):
    """A learner of a lower number meets the target."""


def check_task(
    pendulum: Pendulum,
    arm: Arm,
    settings: Settings,
    actuator: Actuator | None = None,
    target: float = 0.0,
) -> str | None:
    """Compare the releases of a task with the recoverable set, before a training.

    Args:
        pendulum: The identified pendulum.
        arm: The arm with its home posture.
        settings: Resolved settings.
        actuator: Actuator of the arm; as in `train`.
        target: Share of the releases that a policy shall balance.

    Returns:
        A warning with the share of releases that no controller saves, or None.

    Raises:
        SettingsError: No controller saves any of the releases, or the share that the target needs.
    """
    parameters = pendulum.parameters(linearised=settings.plant.linearised)
    response = actuator or default_actuator(settings)
    return check_releases(parameters, arm, settings, response, least=target)


def default_actuator(settings: Settings) -> Actuator:
    """Return the actuator of a training without a given one."""
    return IDEAL_ACTUATOR if settings.plant.ideal else shipped_actuator()


class _Task(NamedTuple):
    """Inputs that determine the result of a training, except the index of the learner."""

    pendulum: Pendulum
    arm: Arm
    settings: Settings
    actuator: Actuator
    seed: int
    init_policy: TabularPolicy | None


def _task(
    pendulum: Pendulum,
    arm: Arm,
    settings: Settings,
    actuator: Actuator | None,
    seed: int,
    init_policy: TabularPolicy | None,
    target: float = 0.0,
) -> _Task:
    check_task(pendulum, arm, settings, actuator, target)
    actuator = actuator or default_actuator(settings)
    if init_policy is not None and init_policy.settings.boxes != settings.boxes:
        raise InputError(
            "the policy to go on from has other boxes than the settings; train with its boxes"
        )
    settings = settings.model_copy(update={"learning": with_digests(settings.learning)})
    return _Task(pendulum, arm, settings, actuator, seed, init_policy)


def _train(
    task: _Task,
    learner: int,
    workers: int,
    checkpoints: "_Checkpoints",
    report: Report,
    selecting: Running,
) -> TabularPolicy:
    """Train one learner and select its policy; resume from its checkpoint if one exists."""
    pendulum, arm, settings, actuator, seed, _ = task
    plant = trial_plant(pendulum, arm, settings, actuator, seed)
    # The boxes do not resolve speeds below the limit; selection finds the tables that respect it.
    of_episodes = plant.params._replace(speed_limit=inf)
    config = training_config(settings, pendulum.parameters().k)
    kernel, boxes = compile_learner(settings.learning), settings.boxes.count
    training = new_training_state(boxes, load_learner(settings.learning).tables)
    tables, totals = training.tables, training.totals
    if task.init_policy is not None:
        tables.Q[:], tables.visits[:] = task.init_policy.table, task.init_policy.visits
    candidates = _Candidates(settings.selection, config.episodes, np.zeros((boxes, ACTIONS)))
    every = settings.selection.every or max(1, config.episodes // MAX_REPORTS)
    curve: list[LearningPoint] = []
    if (before := checkpoints.states.get(str(learner))) is not None:
        unpack(before.training, training)
        candidates.restore(before)
        curve += before.curve
        report(curve[-1])
    key = np.array((seed, learner))
    loop = new_training_loop(of_episodes, plant.pendulum, config, kernel, training, key)
    while totals[ENDED] < config.episodes:
        ended, steps = int(totals[ENDED]), int(totals[ENDED_STEPS])
        until = min(ended + every, config.episodes)
        train_episodes(loop, until)
        if not np.isfinite(tables.Q).all():
            raise InputError(
                f"the table holds a value that is not finite after {totals[ENDED]} episodes with "
                f"the learner {settings.learning.learner} and the reward "
                f"{settings.learning.reward}; bound the reward, or lower the learning rate"
            )
        point = LearningPoint(
            episodes=int(totals[ENDED]),
            steps=int(totals[STEPS]),
            duration=paper.STEP * (int(totals[ENDED_STEPS]) - steps) / (int(totals[ENDED]) - ended),
        )
        if settings.selection.every > 0:
            candidates.add(training)
        curve.append(point)
        checkpoints.keep(learner, candidates.state(training, curve))
        report(point)
    chosen, results = tables.Q, tuple[Checkpoint, ...]()
    if candidates.found:
        order = race(plant, candidates.greedy, workers=workers, running=selecting)
        chosen = candidates.averages[order[0][0]]
        results = tuple(result for _, result in order)
    return TabularPolicy(
        actions=paper.ACTIONS,
        Q=tuple(tuple(row) for row in chosen.tolist()),
        visits=tuple(tuple(row) for row in tables.visits.tolist()),
        h=paper.STEP,
        pendulum=pendulum,
        arm=arm,
        actuator=actuator,
        settings=settings,
        seed=seed,
        learner=learner,
        episodes=int(totals[ENDED]),
        steps=int(totals[STEPS]),
        learning_curve=tuple(curve),
        checkpoints=results,
    )


@dataclass
class _Candidates:
    """Greedy policies of the running average in the last part of a training, equal ones once."""

    rule: SelectionSettings
    episodes: int
    """Number of episodes of the training."""
    averaged: Array
    """Running average of the table, shape (boxes, 8)."""
    count: int = 0
    """Number of tables in the average."""
    found: dict[bytes, tuple[int, Array]] = field(default_factory=dict[bytes, tuple[int, Array]])
    """Number of episodes and averaged table of each candidate, by its accelerations."""

    def add(self, training: TrainingState) -> None:
        """Add the table of a training to the average; take its greedy policy if it is late."""
        self.count += 1
        share = max(self.rule.averaging, 1.0 / self.count)
        self.averaged += share * (training.tables.Q - self.averaged)
        ended = int(training.totals[ENDED])
        if ended > (1.0 - self.rule.late) * self.episodes:
            self._take(ended, self.averaged.copy())

    def _take(self, ended: int, averaged: Array) -> None:
        self.found.setdefault(greedy_accelerations(averaged).tobytes(), (ended, averaged))
        if len(self.found) > self.rule.candidates:
            del self.found[next(iter(self.found))]

    @property
    def greedy(self) -> list[Candidate]:
        """Candidates for the race, in their order."""
        return [Candidate(n, greedy_accelerations(Q)) for n, Q in self.found.values()]

    @property
    def averages(self) -> list[Array]:
        """Their tables."""
        return [Q for _, Q in self.found.values()]

    def restore(self, state: LearnerState) -> None:
        """Restore the candidates of a checkpoint."""
        boxes = len(self.averaged)
        self.averaged, self.count = table(state.averaged, boxes), state.averages
        for stored in state.candidates:
            self._take(stored.episodes, table(stored.Q, boxes))

    def state(self, training: TrainingState, curve: Sequence[LearningPoint]) -> LearnerState:
        """Return the state of the training and its candidates."""
        return LearnerState(
            training=pack(training),
            averaged=self.averaged.tobytes(),
            averages=self.count,
            candidates=tuple(
                StoredCandidate(episodes=n, Q=Q.tobytes()) for n, Q in self.found.values()
            ),
            curve=tuple(curve),
        )


def _result(policy: TabularPolicy, test: TargetTest) -> LearnerResult:
    chosen = policy.checkpoints[0] if policy.checkpoints else None
    return LearnerResult(
        learner=policy.learner,
        steps=policy.steps,
        episodes=policy.episodes if chosen is None else chosen.episodes,
        score=None if chosen is None else chosen.score,
        test=test,
    )


class _Checkpoints(PartialFile):
    """File with the states of all learners of a training, and the best policy up to now."""

    def __init__(
        self,
        path: StrPath | None,
        task: _Task,
        wanted: dict[str, str],
        population: bool = False,
    ) -> None:
        super().__init__(path, "train", self._checkpoint)
        self._population = population
        self.states: dict[str, LearnerState] = {}
        self.finished: tuple[LearnerResult, ...] = ()
        self.best: TabularPolicy | None = None
        self._lock = Lock()
        # Digests of the inputs that determine the bits, by name.
        self._deciding = {
            "pendulum": task.pendulum.digest,
            "arm": task.arm.digest,
            "actuator": task.actuator.digest,
            "learner": task.settings.learning.learner,
            "reward": task.settings.learning.reward,
            "settings": value_digest(task.settings),
            "seed": str(task.seed),
            **wanted,
            "policy to go on from": "" if task.init_policy is None else task.init_policy.digest,
            "version of Equipoise or its libraries": software(),
        }
        if path is None or not Path(path).exists():
            return
        found = ResumePoint.load(path)
        if other := [name for name, v in self._deciding.items() if found.deciding.get(name) != v]:
            raise ArtefactError(
                f"{path} holds an interrupted training with another {' and '.join(other)}; go on "
                "with what it began with, or delete it to begin anew"
            )
        self.states |= found.learners
        self.finished, self.best = found.finished, found.best

    def keep(self, learner: int, state: LearnerState) -> None:
        """Store the state of a learner."""
        with self._lock:
            self.states[str(learner)] = state
        self.update()

    def finish(self, policy: TabularPolicy, test: TargetTest) -> None:
        """Store the figures of a tested learner, and its policy if it is the best."""
        with self._lock:
            del self.states[str(policy.learner)]
            self.finished += (_result(policy, test),)
            known = self.best
            if known is None or self._key(policy) > self._key(known):
                self.best = policy
        self.update()

    def is_finished(self, learner: int) -> bool:
        """Return whether a learner has been tested."""
        return any(result.learner == learner for result in self.finished)

    def is_decided(self, learner: int) -> bool:
        """Return whether a learner is not needed: one of a lower number meets the target."""
        met = (result.learner for result in self.finished if result.test.met)
        return not self._population and any(number < learner for number in met)

    def _key(self, policy: TabularPolicy) -> tuple[float, ...]:
        """Return the sort key of a tested policy; the highest one is the best."""
        test, score = policy.test, policy.checkpoints[0].score if policy.checkpoints else 0.0
        if test is None or not test.met:
            return (0.0, 0.0 if test is None else test.interval[0], score, -policy.learner)
        return (1.0, score if self._population else 0.0, -policy.learner)

    def _checkpoint(self) -> ResumePoint | None:
        with self._lock:
            if not self.states and not self.finished:
                return None
            return ResumePoint(
                deciding=self._deciding,
                learners=dict(self.states),
                finished=self.finished,
                best=self.best,
            )


def software() -> str:
    """Return the versions and the digest of kernels, which identify software with equal bits."""
    return json.dumps(Provenance.now("", None).software) + kernel_sources_digest()


def training_config(settings: Settings, k: float) -> TrainingConfig:
    """Return the configuration of the episode loop."""
    s = settings.learning
    values: dict[str, Any] = {**dict(settings.plant), **dict(s)}
    return TrainingConfig(
        **{name: values[name] for name in TrainingConfig._fields if name in values},
        max_steps=round(s.episode_duration / paper.STEP),
        update=UpdateParams(*(values[name] for name in UpdateParams._fields)),
        start=(s.start_x, s.start_x_dot, s.start_phi, s.start_phi_dot),
        actions=paper.ACTIONS,
        boxes=partition(settings.boxes, k),
    )
