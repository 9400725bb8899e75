"""Training of a policy for a pendulum and an arm.

A training runs its episodes in one compiled loop (`equipoise.learning.episodes`) and periodically
takes the greedy policy as a candidate. Candidates are screened on selection trials, the best enter
a final round of longer trials, and the winner is kept with its table. Equal seeds give equal bits,
for any number of workers, and also after a resumed interruption.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.artefacts import PartialFile, Provenance, StrPath, value_digest
from equipoise.checks.recoverable import check_releases
from equipoise.compiled import kernel_sources_digest
from equipoise.control import boxes
from equipoise.control.boxes import TRUNCATED
from equipoise.control.policy import (
    Checkpoint,
    LearningPoint,
    TabularPolicy,
    greedy_accelerations,
    table_kernel,
)
from equipoise.errors import ArtefactError, InputError
from equipoise.learning.checkpoint import Finalist, LearnerState, ResumePoint, pack, table, unpack
from equipoise.learning.choice import compile_learner, load_learner, with_digests
from equipoise.learning.closed_loop import LoopParams, make_loop_params
from equipoise.learning.episodes import (
    ENDED,
    ENDED_STEPS,
    STEPS,
    TrainingConfig,
    TrainingState,
    new_training_state,
    train_episodes,
)
from equipoise.learning.learner import UpdateParams
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator, shipped_actuator
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import Pendulum, PendulumParameters
from equipoise.model.random import FINAL_ROUND, SCREENING
from equipoise.settings import Settings
from equipoise.simulation.plant import PlantSimulation

Array = npt.NDArray[np.float64]

MAX_REPORTS = 200
"""Number of progress reports of a training without candidates."""
LEARNERS = 3
"""Default number of learners, of which the best is kept: one in three finds no table that balances
the worst plants of its selection."""

Report = Callable[[LearningPoint], None]
"""Callback for each new point of the learning curve."""
Selecting = Callable[[int, int], None]
"""Callback for the progress of the final round: finished trials, all trials."""


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
    selecting: Selecting = lambda _, __: None,
) -> TabularPolicy:
    """Train one policy.

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
        selecting: Called as the trials of the final round finish, also from other threads.

    Returns:
        The policy, with its learning curve and the finalists of its selection.

    Raises:
        ArtefactError: `partial` is the checkpoint of another training, or damaged.
        OutsideError: The disk rejects a checkpoint.
        SettingsError: No controller saves any of the releases.
    """
    task = _task(pendulum, arm, settings, actuator, seed, init_policy)
    with _Checkpoints(partial, task, (learner,)) as checkpoints:
        return _train(task, learner, workers, checkpoints, report, selecting)


def train_several(
    pendulum: Pendulum,
    arm: Arm,
    settings: Settings,
    *,
    learners: int = LEARNERS,
    actuator: Actuator | None = None,
    seed: int = 0,
    workers: int = 1,
    partial: StrPath | None = None,
    report: Callable[[int, LearningPoint], None] = lambda _, __: None,
    selecting: Callable[[int, int, int], None] = lambda _, __, ___: None,
) -> list[TabularPolicy]:
    """Train several learners of one seed in parallel; return them with the best score first.

    All are compared on the same selection trials. Without a selection the order is that of the
    learners.

    Args:
        pendulum: The identified pendulum.
        arm: The arm with its home posture.
        settings: Resolved settings.
        learners: Number of learners.
        actuator: Actuator of the arm; as in `train`.
        seed: Master seed.
        workers: Threads; the results do not depend on it.
        partial: File for the checkpoints of all learners; as in `train`.
        report: Called with the learner and each new point of its learning curve.
        selecting: Called with the learner, its finished trials of the final round, and all of them.

    Raises:
        ArtefactError: `partial` is the checkpoint of another training, or damaged.
        OutsideError: The disk rejects a checkpoint.
        SettingsError: No controller saves any of the releases.
    """
    task = _task(pendulum, arm, settings, actuator, seed, None)

    def one(learner: int) -> TabularPolicy:
        return _train(
            task,
            learner,
            1 if learners > 1 else workers,
            checkpoints,
            lambda point: report(learner, point),
            lambda done, of: selecting(learner, done, of),
        )

    checkpoints = _Checkpoints(partial, task, range(learners))
    with checkpoints, ThreadPoolExecutor(workers) as pool:
        policies = list(pool.map(one, range(learners)))
    return sorted(policies, key=lambda p: -p.checkpoints[0].score if p.checkpoints else 0.0)


def score_policy(
    policy: TabularPolicy,
    *,
    seed: int = 0,
    workers: int = 1,
    done: Callable[[int], None] = lambda _: None,
) -> Checkpoint:
    """Score a policy in the final round of a selection, on its own model.

    Args:
        policy: The policy, with pendulum, arm and actuator.
        seed: Master seed of the trials; compare policies of one model with equal seeds.
        workers: Threads; the result does not depend on it.
        done: Called with the number of newly finished trials, also from other threads.
    """
    parameters = policy.pendulum.parameters(linearised=policy.settings.plant.linearised)
    plant = make_loop_params(policy.arm, policy.settings, policy.h, parameters, policy.actuator)
    selection = _Selection(plant, policy.arm, parameters, policy.settings, seed, workers)
    return selection.run(policy.u_of_box, policy.episodes, done, final=True)


def check_task(
    pendulum: Pendulum, arm: Arm, settings: Settings, actuator: Actuator | None = None
) -> str | None:
    """Compare the releases of a task with the recoverable set, before a training.

    Args:
        pendulum: The identified pendulum.
        arm: The arm with its home posture.
        settings: Resolved settings.
        actuator: Actuator of the arm; as in `train`.

    Returns:
        A warning with the share of releases that no controller saves, or None.

    Raises:
        SettingsError: No controller saves any of the releases.
    """
    parameters = pendulum.parameters(linearised=settings.plant.linearised)
    return check_releases(parameters, arm, settings, actuator or default_actuator(settings))


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
) -> _Task:
    check_task(pendulum, arm, settings, actuator)
    actuator = actuator or default_actuator(settings)
    settings = settings.model_copy(update={"learning": with_digests(settings.learning)})
    return _Task(pendulum, arm, settings, actuator, seed, init_policy)


def _train(
    task: _Task,
    learner: int,
    workers: int,
    checkpoints: "_Checkpoints",
    report: Report,
    selecting: Selecting,
) -> TabularPolicy:
    """Train one learner; resume from its checkpoint if one exists."""
    settings, pendulum, seed = task.settings, task.pendulum, task.seed
    parameters = pendulum.parameters(linearised=settings.plant.linearised)
    plant = make_loop_params(task.arm, settings, paper.STEP, parameters, task.actuator)
    # The boxes do not resolve speeds below the limit; selection finds the tables that respect it.
    of_episodes = plant._replace(speed_limit=inf)
    config, kernel = training_config(settings), compile_learner(settings.learning)
    training = new_training_state(load_learner(settings.learning).tables)
    tables, totals = training.tables, training.totals
    if task.init_policy is not None:
        tables.Q[:], tables.visits[:] = task.init_policy.table, task.init_policy.visits
    selection = _Selection(plant, task.arm, parameters, settings, seed, workers)
    every = settings.selection.every or max(1, config.episodes // MAX_REPORTS)
    curve: list[LearningPoint] = []
    if (before := checkpoints.states.get(str(learner))) is not None:
        unpack(before.training, training)
        selection.restore(before)
        curve += before.curve
        report(curve[-1])

    def keep() -> None:
        checkpoints.keep(learner, selection.state(training, curve))

    while totals[ENDED] < config.episodes:
        ended, steps = int(totals[ENDED]), int(totals[ENDED_STEPS])
        until = min(ended + every, config.episodes)
        train_episodes(of_episodes, parameters, config, kernel, training, until, seed, learner)
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
            screened = selection.screen(training)
            point = point.model_copy(update={"survival": screened.survived / screened.trials})
        curve.append(point)
        keep()
        report(point)
    finalists = selection.final_round(keep, selecting)
    Q, visits = _tables(finalists[0]) if finalists else (tables.Q, tables.visits)
    return TabularPolicy(
        boxes=boxes.describe(),
        actions=paper.ACTIONS,
        Q=tuple(tuple(row) for row in Q.tolist()),
        visits=tuple(tuple(row) for row in visits.tolist()),
        h=paper.STEP,
        pendulum=pendulum,
        arm=task.arm,
        actuator=task.actuator,
        settings=settings,
        seed=seed,
        learner=learner,
        episodes=int(totals[ENDED]),
        steps=int(totals[STEPS]),
        learning_curve=tuple(curve),
        checkpoints=tuple(finalist.candidate for finalist in finalists),
    )


class _Checkpoints(PartialFile):
    """File with the states of all learners of a training."""

    def __init__(self, path: StrPath | None, task: _Task, learners: Sequence[int]) -> None:
        super().__init__(path, "train", self._checkpoint)
        self.states: dict[str, LearnerState] = {}
        # Digests of the inputs that determine the bits, by name.
        self._deciding = {
            "pendulum": task.pendulum.digest,
            "arm": task.arm.digest,
            "actuator": task.actuator.digest,
            "learner": task.settings.learning.learner,
            "reward": task.settings.learning.reward,
            "settings": value_digest(task.settings),
            "seed": str(task.seed),
            "number of learners": ", ".join(map(str, learners)),
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

    def keep(self, learner: int, state: LearnerState) -> None:
        """Store the state of a learner."""
        self.states[str(learner)] = state
        self.update()

    def _checkpoint(self) -> ResumePoint | None:
        states = dict(self.states)
        return ResumePoint(deciding=self._deciding, learners=states) if states else None


def software() -> str:
    """Return the versions and the digest of kernels, which identify software with equal bits."""
    return json.dumps(Provenance.now("", None).software) + kernel_sources_digest()


def training_config(settings: Settings) -> TrainingConfig:
    """Return the configuration of the episode loop."""
    s = settings.learning
    values: dict[str, Any] = {**dict(settings.plant), **dict(s)}
    return TrainingConfig(
        **{name: values[name] for name in TrainingConfig._fields if name in values},
        max_steps=round(s.episode_duration / paper.STEP),
        update=UpdateParams(*(values[name] for name in UpdateParams._fields)),
        start=(s.start_x, s.start_x_dot, s.start_phi, s.start_phi_dot),
        boxes=boxes.boxes(),
        actions=paper.ACTIONS,
    )


@dataclass
class _Selection:
    """Selection of the best greedy policy of one training."""

    plant: LoopParams
    arm: Arm
    pendulum: PendulumParameters
    settings: Settings
    seed: int
    workers: int
    screened: int = 0
    averaged: Array = field(default_factory=lambda: np.zeros((boxes.COUNT, boxes.ACTIONS)))
    known: dict[str, Checkpoint] = field(default_factory=dict[str, Checkpoint])
    best: list[Finalist] = field(default_factory=list[Finalist])
    final: list[Checkpoint] = field(default_factory=list[Checkpoint])

    def screen(self, training: TrainingState) -> Checkpoint:
        """Run the screening trials of the averaged table's greedy policy, once per policy."""
        self.screened += 1
        share = max(self.settings.selection.averaging, 1.0 / self.screened)
        self.averaged += share * (training.tables.Q - self.averaged)
        u_of_box = greedy_accelerations(self.averaged)
        policy = hashlib.sha256(u_of_box.tobytes()).hexdigest()
        if policy not in self.known:
            candidate = self.known[policy] = self.run(u_of_box, int(training.totals[ENDED]))
            Q, visits = self.averaged.tobytes(), training.tables.visits.tobytes()
            newest = Finalist(Q=Q, visits=visits, candidate=candidate)
            self.best = _sorted([*self.best, newest])[: self.settings.selection.finalists]
        return self.known[policy]

    def final_round(self, keep: Callable[[], None], selecting: Selecting) -> list[Finalist]:
        """Run the longer trials of the finalists; return them with the best first.

        Args:
            keep: Called after each finalist.
            selecting: Called as trials finish.
        """
        trials = self.settings.selection.final_trials
        finished, of = len(self.final) * trials, len(self.best) * trials
        lock = Lock()

        def done(count: int) -> None:
            nonlocal finished
            with lock:
                finished += count
                selecting(finished, of)

        if of:
            done(0)
        for finalist in self.best[len(self.final) :]:
            u_of_box = greedy_accelerations(_tables(finalist)[0])
            self.final.append(self.run(u_of_box, finalist.candidate.episodes, done, final=True))
            keep()
        pairs = zip(self.best, self.final, strict=True)
        return _sorted([best.model_copy(update={"candidate": final}) for best, final in pairs])

    def restore(self, state: LearnerState) -> None:
        """Restore the state of a selection."""
        self.averaged, self.screened = table(state.averaged, np.float64), state.screened
        self.known, self.best = dict(state.known), list(state.best)
        self.final = list(state.final[: len(state.best)])
        for finalist in self.best:
            _tables(finalist)  # rejects a damaged checkpoint before the training goes on

    def state(self, training: TrainingState, curve: Sequence[LearningPoint]) -> LearnerState:
        """Return the state of the training and its selection."""
        return LearnerState(
            training=pack(training),
            averaged=self.averaged.tobytes(),
            screened=self.screened,
            known=dict(self.known),
            best=tuple(self.best),
            final=tuple(self.final),
            curve=tuple(curve),
        )

    def run(
        self,
        u_of_box: Array,
        episodes: int,
        done: Callable[[int], None] = lambda _: None,
        final: bool = False,
    ) -> Checkpoint:
        """Score a greedy policy in the screening trials, or in the longer ones of the final round.

        Args:
            u_of_box: Acceleration of each box [m/s^2].
            episodes: Number of training episodes of the policy.
            done: Called with the number of newly finished trials, also from other threads.
            final: Run the final round.
        """
        s, model = self.settings.selection, (self.plant, self.arm, self.pendulum, self.settings)
        stream, count, duration = SCREENING, s.screening_trials, s.duration
        if final:
            stream, count, duration = FINAL_ROUND, s.final_trials, s.final_duration
        simulation = PlantSimulation(*model, seed=self.seed, stream=stream, spread=s.spread)
        trials, kernel = simulation.draw(count), table_kernel(u_of_box)

        def rows_done(rows: Sequence[int]) -> None:
            done(len(rows))

        rows, cores = range(count), self.workers
        simulation.run(kernel, trials, rows, duration=duration, workers=cores, done=rows_done)
        mean_duration = float(np.mean(trials.steps)) * self.plant.controller.h
        rms_x = float(np.sqrt(np.sum(trials.sum_x2) / np.sum(trials.steps)))
        return Checkpoint(
            episodes=episodes,
            trials=count,
            survived=int(np.sum(trials.cause == TRUNCATED)),
            mean_duration=mean_duration,
            rms_x=rms_x,
            score=mean_duration / duration - s.rms_x_weight * rms_x / paper.X_LIMIT,
        )


def _sorted(finalists: list[Finalist]) -> list[Finalist]:
    return sorted(finalists, key=lambda finalist: -finalist.candidate.score)


def _tables(finalist: Finalist) -> tuple[Array, npt.NDArray[np.int64]]:
    return table(finalist.Q, np.float64), table(finalist.visits, np.int64)
