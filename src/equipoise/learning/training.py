"""Training of a policy for a pendulum and an arm.

A training runs its episodes in one compiled loop (`equipoise.learning.episodes`) and takes the
greedy policies of its later tables as candidates. They race on common trials, and the winner is
tested in trials that chose nothing (`learning.selection`). Learners are trained one after the
other until one meets the target. Equal seeds give equal bits, for any number of workers, and also
after a resumed interruption.
"""

import functools
import json
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from threading import Lock
from typing import Any, Final, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.artefacts import PartialFile, Provenance, StrPath, value_digest
from equipoise.control.grid import ACTIONS, partition
from equipoise.control.policy import (
    MAX_ACTUATORS,
    Checkpoint,
    LearningPoint,
    TabularPolicy,
    TargetTest,
    greedy_accelerations,
)
from equipoise.errors import ArtefactError, InputError
from equipoise.executors import ThreadExecutor, Workers, executor_of
from equipoise.jit import kernel_sources_digest
from equipoise.learning.checkpoint import (
    LearnerResult,
    LearnerState,
    ResumePoint,
    StoredCandidate,
    pack,
    table,
    unpack,
)
from equipoise.learning.choice import (
    compile_learner,
    load_learner,
    raise_guest_error,
    with_digests,
)
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
from equipoise.learning.in_world import train_in_world
from equipoise.learning.learner import UpdateParams
from equipoise.learning.selection import (
    ERROR,
    Candidate,
    Running,
    TrialPlant,
    measure_share,
    race,
    trial_plants,
    trials_to_meet,
)
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator, shipped_actuator
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import Pendulum
from equipoise.model.random import TRAINING_NOISE
from equipoise.model.worlds import IDEAL, MODEL
from equipoise.settings import SelectionSettings, Settings
from equipoise.worlds import ClosedLoop, Setup, find_world, has_ideal_arm, simulate
from equipoise.worlds.reachability import check_releases

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
    actuator: Actuator | Sequence[Actuator] | None = None,
    world: str = MODEL,
    seed: int = 0,
    learner: int = 0,
    init_policy: TabularPolicy | None = None,
    workers: Workers = 1,
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
            identified from the twin. With several, the episodes take turns behind them, and the
            selection scores a policy behind the one where it is worst; the first one is the
            controller's default.
        world: World of the episodes: `model`, the compiled plant; or a twin, or an address of
            CoppeliaSim, one episode after the other. Selection and test run on the plant.
        seed: Master seed.
        learner: Index of the learner, each with its own random numbers.
        init_policy: Policy with the initial table and visits; by default zeros.
        workers: Threads, or an executor, of the trials; the result does not depend on it.
        partial: File for checkpoints. The training resumes from an existing one. The file is kept;
            delete it once the policy is saved.
        report: Called with each new point of the learning curve; first with the last one of a
            checkpoint.
        selecting: Called as trials of the race finish, with their number and the expected one.

    Returns:
        The policy, with its learning curve and the results of its race.

    Raises:
        ArtefactError: `partial` is the checkpoint of another training, or damaged.
        InputError: The world takes no such actuators.
        OutsideError: The disk rejects a checkpoint, or CoppeliaSim fails.
        SettingsError: No controller saves any of the releases, or the world is unknown.
    """
    task = _task(pendulum, arm, settings, actuator, world, seed, init_policy)
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
    actuator: Actuator | Sequence[Actuator] | None = None,
    world: str = MODEL,
    seed: int = 0,
    workers: Workers = 1,
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
        world: World of the episodes; as in `train`.
        seed: Master seed.
        workers: Threads, or an executor; the result does not depend on it.
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
    task = _task(pendulum, arm, settings, actuator, world, seed, None, target)
    shown = progress or TargetProgress()
    wanted = {"target": str(target), "--all": str(population)}
    with _Checkpoints(partial, task, wanted, population) as checkpoints:

        def is_needed(learner: int) -> bool:
            return not (checkpoints.is_decided(learner) or checkpoints.is_finished(learner))

        def run(learner: int, workers: Workers = 1) -> TabularPolicy | None:
            def report(point: LearningPoint) -> None:
                if checkpoints.is_decided(learner):
                    raise _DecidedError
                shown.report(learner, point)

            def selecting(done: int, of: int) -> None:
                shown.selecting(learner, done, of)

            def testing(done: int, of: int) -> None:
                shown.testing(learner, done, of)

            if not is_needed(learner):
                return None
            try:
                policy = _train(task, learner, workers, checkpoints, report, selecting)
            except _DecidedError:
                return None
            return _tested(policy, target, workers, testing)

        def finish(policy: TabularPolicy | None) -> None:
            if policy is not None:
                checkpoints.finish(policy)
                shown.finished(_result(policy))

        if not population:
            finish(run(0, workers))
        executor = executor_of(workers)
        if world != MODEL:
            executor = ThreadExecutor(1)  # there is one CoppeliaSim, and Python steps a twin
        function = functools.partial(_run_elsewhere, task, target) if executor.is_remote else run
        needed = [learner for learner in range(learners) if is_needed(learner)]
        with closing(executor.completed(function, needed)) as completed:
            for _, policy in completed:
                finish(policy)
                if not population and not any(map(is_needed, needed)):
                    break
        shown.ended()
        policy = cast(TabularPolicy, checkpoints.best)
        decided = not population and policy.test and policy.test.met
        last = policy.learner if decided else learners
        results = sorted(checkpoints.finished, key=lambda result: result.learner)
    return TrainedLearners(policy, tuple(each for each in results if each.learner <= last))


def _run_elsewhere(task: "_Task", target: float, learner: int) -> TabularPolicy:
    """Train, select and test one learner in another process."""
    with _Checkpoints(None, task, {}) as checkpoints:
        policy = _train(task, learner, 1, checkpoints, lambda _: None, lambda _, __: None)
    return _tested(policy, target, 1)


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


def measure_policy(
    policy: TabularPolicy,
    *,
    target: float = TARGET,
    error: float = ERROR,
    workers: Workers = 1,
    running: Running = lambda _, __: None,
) -> tuple[TargetTest, ...]:
    """Test a policy behind each of its actuators; see `equipoise.learning.selection.measure_share`.

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


def _plants(policy: TabularPolicy, seed: int) -> list[TrialPlant]:
    """Return the inputs of trials on the plants of a policy's training."""
    return trial_plants(policy.pendulum, policy.arm, policy.settings, policy.actuators, seed)


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


def _error(learner: int) -> float:
    """Return the error of the test of a learner; the sum over all learners is `ERROR`."""
    return ERROR / ((learner + 1) * (learner + 2))


class _DecidedError(Exception):
    """A learner of a lower number meets the target."""


def check_task(
    pendulum: Pendulum,
    arm: Arm,
    settings: Settings,
    actuator: Actuator | Sequence[Actuator] | None = None,
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
        A warning with the share of releases that no controller saves, or None; of several
        actuators, for the first one that gives a warning.

    Raises:
        SettingsError: No controller saves any of the releases, or the share that the target needs.
    """
    parameters = pendulum.parameters(linearised=settings.plant.linearised)
    warnings = [
        check_releases(parameters, arm, settings, each, least=target)
        for each in _actuators(settings, actuator)
    ]
    return next(filter(None, warnings), None)


def actuators_in(
    world: str, settings: Settings, given: Actuator | Sequence[Actuator] | None
) -> Actuator | Sequence[Actuator] | None:
    """Return the actuators of a training in a world: the ideal one for an arm without delay.

    Args:
        world: World of the episodes.
        settings: Settings of the training.
        given: Actuators; None for the default.

    Raises:
        InputError: The world takes no such actuators.
        SettingsError: The world is unknown.
    """
    if world == MODEL:
        return given
    find_world(world)
    if world == IDEAL:
        raise InputError(
            "the world ideal is a setting of the compiled training; leave out the world, and take "
            "the recipe paper or --set plant.ideal=true"
        )
    if not has_ideal_arm(world):
        if len(_actuators(settings, given)) > 1:
            raise InputError(f"the world {world} is trained behind one actuator; give one")
        return given
    if given is not None and _actuators(settings, given) != (IDEAL_ACTUATOR,):
        raise InputError(f"the arm of the world {world} has no delay; leave out the actuator")
    return IDEAL_ACTUATOR


def _actuators(
    settings: Settings, given: Actuator | Sequence[Actuator] | None
) -> tuple[Actuator, ...]:
    """Return the actuators of a training.

    Raises:
        InputError: None, too many, or equal ones are given.
    """
    if given is None:
        return (IDEAL_ACTUATOR if settings.plant.ideal else shipped_actuator(),)
    actuators = (given,) if isinstance(given, Actuator) else tuple(given)
    if not 1 <= len(actuators) <= MAX_ACTUATORS:
        raise InputError(f"{len(actuators)} actuators are given, expected 1 to {MAX_ACTUATORS}")
    if len({each.digest for each in actuators}) < len(actuators):
        raise InputError("an actuator is given twice; give each of them once")
    return actuators


class _Task(NamedTuple):
    """Inputs that determine the result of a training, except the index of the learner."""

    pendulum: Pendulum
    arm: Arm
    settings: Settings
    actuators: tuple[Actuator, ...]
    world: str
    seed: int
    init_policy: TabularPolicy | None


def _task(
    pendulum: Pendulum,
    arm: Arm,
    settings: Settings,
    actuator: Actuator | Sequence[Actuator] | None,
    world: str,
    seed: int,
    init_policy: TabularPolicy | None,
    target: float = 0.0,
) -> _Task:
    actuator = actuators_in(world, settings, actuator)
    check_task(pendulum, arm, settings, actuator, target)
    actuators = _actuators(settings, actuator)
    if init_policy is not None and init_policy.settings.boxes != settings.boxes:
        raise InputError(
            "the policy to go on from has other boxes than the settings; train with its boxes"
        )
    settings = settings.model_copy(update={"learning": with_digests(settings.learning)})
    return _Task(pendulum, arm, settings, actuators, world, seed, init_policy)


def _train(
    task: _Task,
    learner: int,
    workers: Workers,
    checkpoints: "_Checkpoints",
    report: Report,
    selecting: Running,
) -> TabularPolicy:
    """Train one learner and select its policy; resume from its checkpoint if one exists."""
    pendulum, arm, settings, actuators, world, seed, _ = task
    plants = trial_plants(pendulum, arm, settings, actuators, seed)
    config = training_config(settings, pendulum.parameters().k)
    kernel, boxes = compile_learner(settings.learning), settings.boxes.count
    training = new_training_state(boxes, load_learner(settings.learning).tables)
    tables = training.tables
    others = (new_training_state(0)._replace(tables=tables) for _ in plants[1:])
    trainings = [training, *others]
    if task.init_policy is not None:
        tables.Q[:], tables.visits[:] = task.init_policy.table, task.init_policy.visits
    candidates = _Candidates(settings.selection, config.episodes, np.zeros((boxes, ACTIONS)))
    every = settings.selection.every or max(1, config.episodes // MAX_REPORTS)
    curve: list[LearningPoint] = []
    if (before := checkpoints.states.get(str(learner))) is not None:
        for data, each in zip(before.trainings, trainings, strict=True):
            unpack(data, each)
        candidates.restore(before)
        curve += before.curve
        report(curve[-1])
    key = np.array((seed, learner))
    loops: list[Any] = []
    for i, plant in enumerate(plants):
        # The boxes do not resolve speeds below the limit; selection finds tables that respect it.
        params = plant.simulation(TRAINING_NOISE).params._replace(speed_limit=inf)
        share = config._replace(episodes=(config.episodes + len(plants) - 1 - i) // len(plants))
        given = params, plant.pendulum, share, kernel, trainings[i], key
        loops.append(new_training_loop(*given))
    elsewhere: ClosedLoop | None = None
    if world != MODEL:
        setup = Setup(pendulum, arm, settings, actuators, paper.STEP)
        simulation = simulate(world, setup, seed=seed, stream=TRAINING_NOISE)
        elsewhere = simulation.loop()
    totals = _totals(trainings)
    while totals[ENDED] < config.episodes:
        ended, steps = totals[ENDED], totals[ENDED_STEPS]
        until = min(ended + every, config.episodes)
        if elsewhere is None:
            _train_in_turn(loops, trainings, until)
        else:
            train_in_world(loops[0], training, elsewhere, until)
        raise_guest_error(settings.learning)
        totals = _totals(trainings)
        if not np.isfinite(tables.Q).all():
            raise InputError(
                f"the table holds a value that is not finite after {totals[ENDED]} episodes with "
                f"the learner {settings.learning.learner} and the reward "
                f"{settings.learning.reward}; bound the reward, or lower the learning rate"
            )
        point = LearningPoint(
            episodes=totals[ENDED],
            steps=totals[STEPS],
            duration=paper.STEP * (totals[ENDED_STEPS] - steps) / (totals[ENDED] - ended),
        )
        if settings.selection.every > 0:
            candidates.add(tables.Q, totals[ENDED])
        curve.append(point)
        checkpoints.keep(learner, candidates.state(trainings, curve))
        report(point)
    chosen, results = tables.Q, tuple[Checkpoint, ...]()
    if candidates.found:
        order = race(plants, candidates.greedy, workers=workers, running=selecting)
        chosen = candidates.averages[order[0][0]]
        results = tuple(result for _, result in order)
    return TabularPolicy(
        actions=paper.ACTIONS,
        Q=tuple(tuple(row) for row in chosen.tolist()),
        visits=tuple(tuple(row) for row in tables.visits.tolist()),
        h=paper.STEP,
        pendulum=pendulum,
        arm=arm,
        actuators=actuators,
        settings=settings,
        seed=seed,
        learner=learner,
        episodes=totals[ENDED],
        steps=totals[STEPS],
        learning_curve=tuple(curve),
        checkpoints=results,
    )


def _totals(trainings: Sequence[TrainingState]) -> list[int]:
    """Return the sums of the totals over all actuators."""
    return np.sum([training.totals for training in trainings], axis=0).tolist()


def _train_in_turn(loops: Sequence[Any], trainings: Sequence[TrainingState], until: int) -> None:
    """Train until a number of episodes have ended, with equal numbers behind each actuator.

    Each next episode ends behind the actuator with the fewest ones, so that none of them shapes
    the common table alone for longer than an episode.
    """
    while sum(ended := [int(each.totals[ENDED]) for each in trainings]) < until:
        least = ended.index(min(ended))
        train_episodes(loops[least], until if len(loops) == 1 else ended[least] + 1)


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

    def add(self, Q: Array, ended: int) -> None:
        """Add the table after some episodes to the average; take its greedy policy if late."""
        self.count += 1
        share = max(self.rule.averaging, 1.0 / self.count)
        self.averaged += share * (Q - self.averaged)
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

    def state(
        self, trainings: Sequence[TrainingState], curve: Sequence[LearningPoint]
    ) -> LearnerState:
        """Return the state of the training behind each actuator, and its candidates."""
        return LearnerState(
            trainings=tuple(map(pack, trainings)),
            averaged=self.averaged.tobytes(),
            averages=self.count,
            candidates=tuple(
                StoredCandidate(episodes=n, Q=Q.tobytes()) for n, Q in self.found.values()
            ),
            curve=tuple(curve),
        )


def _result(policy: TabularPolicy) -> LearnerResult:
    chosen = policy.checkpoints[0] if policy.checkpoints else None
    test = cast(TargetTest, policy.test)
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
        self.finished = list[LearnerResult]()
        self.best: TabularPolicy | None = None
        self._known = set[int]()
        self._lock = Lock()
        # Digests of the inputs that determine the bits, by name.
        self._deciding = {
            "pendulum": task.pendulum.digest,
            "arm": task.arm.digest,
            "actuator": " ".join(each.digest for each in task.actuators),
            "learner": task.settings.learning.learner,
            "reward": task.settings.learning.reward,
            "settings": value_digest(task.settings),
            "seed": str(task.seed),
            "world": task.world,
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
        self.finished, self.best = list(found.finished), found.best
        self._known |= {result.learner for result in found.finished}

    def keep(self, learner: int, state: LearnerState) -> None:
        """Store the state of a learner."""
        with self._lock:
            self.states[str(learner)] = state
        self.update()

    def finish(self, policy: TabularPolicy) -> None:
        """Store the figures of a tested learner, and its policy if it is the best."""
        with self._lock:
            self.states.pop(str(policy.learner), None)  # absent if trained in another process
            self.finished.append(_result(policy))
            self._known.add(policy.learner)
            known = self.best
            if known is None or self._key(policy) > self._key(known):
                self.best = policy
        self.update()

    def is_finished(self, learner: int) -> bool:
        """Return whether a learner has been tested."""
        return learner in self._known

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
                finished=tuple(self.finished),
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
