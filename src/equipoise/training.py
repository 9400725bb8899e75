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
from math import inf
from pathlib import Path
from threading import Lock
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.artefacts import PartialFile, Provenance, StrPath, value_digest
from equipoise.compiled import kernel_sources_digest
from equipoise.control import boxes
from equipoise.control.boxes import TRUNCATED
from equipoise.control.policy import (
    TABLE,
    Checkpoint,
    LearningPoint,
    TabularPolicy,
    greedy_accelerations,
    policy_kernel,
)
from equipoise.errors import ArtefactError, InputError
from equipoise.learning.checkpoint import (
    Finalist,
    LearnerState,
    ResumePoint,
    pack,
    table,
    unpack,
)
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
from equipoise.settings import LearningSettings, Settings
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


class _Snapshot(NamedTuple):
    """Table of a candidate."""

    Q: Array
    visits: npt.NDArray[np.int64]
    candidate: Checkpoint


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
    return selection.final(policy.u_of_box, policy.episodes, done)


class _Task(NamedTuple):
    """Inputs of a training that determine its result, without the index of the learner."""

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
    if actuator is None:
        actuator = IDEAL_ACTUATOR if settings.plant.ideal else shipped_actuator()
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
    h = plant.controller.h
    if (before := checkpoints.of(learner)) is not None:
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
        _check_finite(training, settings.learning)
        point = LearningPoint(
            episodes=int(totals[ENDED]),
            steps=int(totals[STEPS]),
            duration=h * (int(totals[ENDED_STEPS]) - steps) / (int(totals[ENDED]) - ended),
        )
        if settings.selection.every > 0:
            screened = selection.screen(training)
            point = point.model_copy(update={"survival": screened.survived / screened.trials})
        curve.append(point)
        keep()
        report(point)
    finalists = selection.final_round(keep, selecting)
    Q, visits = (finalists[0].Q, finalists[0].visits) if finalists else (tables.Q, tables.visits)
    return TabularPolicy(
        boxes=boxes.describe(),
        actions=paper.ACTIONS,
        Q=tuple(tuple(row) for row in Q.tolist()),
        visits=tuple(tuple(row) for row in visits.tolist()),
        h=h,
        pendulum=pendulum,
        arm=task.arm,
        actuator=task.actuator,
        settings=settings,
        seed=seed,
        learner=learner,
        episodes=int(totals[ENDED]),
        steps=int(totals[STEPS]),
        learning_curve=tuple(curve),
        checkpoints=tuple(snapshot.candidate for snapshot in finalists),
    )


def _check_finite(training: TrainingState, settings: LearningSettings) -> None:
    """Raise an `InputError` if a value of the table is not finite."""
    if not np.isfinite(training.tables.Q).all():
        raise InputError(
            f"the table holds a value that is not finite after {training.totals[ENDED]} episodes "
            f"with the learner {settings.learner} and the reward {settings.reward}; bound the "
            "reward, or lower the learning rate"
        )


class _Checkpoints(PartialFile):
    """The states of all learners of a training, in one file."""

    def __init__(self, path: StrPath | None, task: _Task, learners: Sequence[int]) -> None:
        super().__init__(path, "train", self._checkpoint)
        self._deciding = _input_digests(task, learners)
        self._states: dict[str, LearnerState] = {}
        if path is None or not Path(path).exists():
            return
        found = ResumePoint.load(path)
        if other := [name for name, v in self._deciding.items() if found.deciding.get(name) != v]:
            raise ArtefactError(
                f"{path} holds an interrupted training with another {' and '.join(other)}; go on "
                "with what it began with, or delete it to begin anew"
            )
        self._states = dict(found.learners)

    def of(self, learner: int) -> LearnerState | None:
        """Return the state of a learner; None if it has not begun."""
        return self._states.get(str(learner))

    def keep(self, learner: int, state: LearnerState) -> None:
        """Store the state of a learner."""
        self._states[str(learner)] = state
        self.update()

    def _checkpoint(self) -> ResumePoint | None:
        states = dict(self._states)
        return ResumePoint(deciding=self._deciding, learners=states) if states else None


def _input_digests(task: _Task, learners: Sequence[int]) -> dict[str, str]:
    """Return the digests of the inputs that determine the bits, by name."""
    return {
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


def software() -> str:
    """Return the versions and the digest of kernels, which identify software with equal bits."""
    return json.dumps(Provenance.now("", None).software) + kernel_sources_digest()


def training_config(settings: Settings) -> TrainingConfig:
    """Return the configuration of the episode loop."""
    s, plant = settings.learning, settings.plant
    return TrainingConfig(
        episodes=s.episodes,
        max_steps=round(s.episode_duration / paper.STEP),
        gamma=s.gamma,
        epsilon_initial=s.epsilon_initial,
        epsilon_until=s.epsilon_until,
        reward_failure=s.reward_failure,
        hold_action=s.hold_action,
        update=UpdateParams(
            alpha_initial=s.alpha_initial,
            alpha_decay=s.alpha_decay,
            alpha_minimum=s.alpha_minimum,
            trace_decay=s.trace_decay,
            mirrored=s.mirrored,
        ),
        start=(s.start_x, s.start_x_dot, s.start_phi, s.start_phi_dot),
        inertia_sigma=plant.inertia_sigma,
        friction_sigma=plant.friction_sigma,
        delay_spread=plant.delay_spread,
        lag_spread=plant.lag_spread,
        zero_error=plant.zero_error,
        boxes=boxes.boxes(),
        actions=paper.ACTIONS,
    )


class _Selection:
    """Selection of the best greedy policy of one training."""

    def __init__(
        self,
        plant: LoopParams,
        arm: Arm,
        pendulum: PendulumParameters,
        settings: Settings,
        seed: int,
        workers: int,
    ) -> None:
        self._plant, self._arm = plant, arm
        self._pendulum, self._settings = pendulum, settings
        self._seed, self._workers = seed, workers
        self._averaged, self._screened = np.zeros((boxes.COUNT, boxes.ACTIONS)), 0
        self._known: dict[str, Checkpoint] = {}
        self._best: list[_Snapshot] = []
        self._final: list[Checkpoint] = []

    def screen(self, training: TrainingState) -> Checkpoint:
        """Run the screening trials of the averaged table's greedy policy, once per policy."""
        self._screened += 1
        newest = max(self._settings.selection.averaging, 1.0 / self._screened)
        self._averaged += newest * (training.tables.Q - self._averaged)
        u_of_box = greedy_accelerations(self._averaged)
        policy = hashlib.sha256(u_of_box.tobytes()).hexdigest()
        if policy not in self._known:
            selection, episodes = self._settings.selection, int(training.totals[ENDED])
            trials, duration = selection.screening_trials, selection.duration
            candidate = self._run(u_of_box, episodes, SCREENING, trials, duration)
            self._known[policy] = candidate
            snapshot = _Snapshot(self._averaged.copy(), training.tables.visits.copy(), candidate)
            self._best = _sorted([*self._best, snapshot])[: selection.finalists]
        return self._known[policy]

    def final_round(self, keep: Callable[[], None], selecting: Selecting) -> list[_Snapshot]:
        """Run the longer trials of the finalists; return them with the best first.

        Args:
            keep: Called after each finalist.
            selecting: Called as trials finish.
        """
        trials = self._settings.selection.final_trials
        finished, of = len(self._final) * trials, len(self._best) * trials
        lock = Lock()

        def done(count: int) -> None:
            nonlocal finished
            with lock:
                finished += count
                selecting(finished, of)

        if of:
            done(0)
        for snapshot in self._best[len(self._final) :]:
            u_of_box = greedy_accelerations(snapshot.Q)
            self._final.append(self.final(u_of_box, snapshot.candidate.episodes, done))
            keep()
        pairs = zip(self._best, self._final, strict=True)
        return _sorted([snapshot._replace(candidate=candidate) for snapshot, candidate in pairs])

    def final(
        self, u_of_box: Array, episodes: int, done: Callable[[int], None] = lambda _: None
    ) -> Checkpoint:
        """Run the longer trials of the greedy policy after `episodes` episodes."""
        selection = self._settings.selection
        return self._run(
            u_of_box, episodes, FINAL_ROUND, selection.final_trials, selection.final_duration, done
        )

    def restore(self, state: LearnerState) -> None:
        """Restore the state of a selection."""
        self._averaged, self._screened = table(state.averaged, np.float64), state.screened
        self._known, self._final = dict(state.known), list(state.final[: len(state.best)])
        self._best = [
            _Snapshot(table(one.Q, np.float64), table(one.visits, np.int64), one.candidate)
            for one in state.best
        ]

    def state(self, training: TrainingState, curve: Sequence[LearningPoint]) -> LearnerState:
        """Return the state of the training and its selection."""
        return LearnerState(
            training=pack(training),
            averaged=self._averaged.tobytes(),
            screened=self._screened,
            known=dict(self._known),
            best=tuple(
                Finalist(Q=one.Q.tobytes(), visits=one.visits.tobytes(), candidate=one.candidate)
                for one in self._best
            ),
            final=tuple(self._final),
            curve=tuple(curve),
        )

    def _run(
        self,
        u_of_box: Array,
        episodes: int,
        stream: int,
        count: int,
        duration: float,
        done: Callable[[int], None] = lambda _: None,
    ) -> Checkpoint:
        selection = self._settings.selection
        simulation = PlantSimulation(
            self._plant,
            self._arm,
            self._pendulum,
            self._settings,
            seed=self._seed,
            stream=stream,
            spread=selection.spread,
        )
        trials, kernel = simulation.draw(count), policy_kernel(TABLE, u_of_box=u_of_box)
        simulation.run(
            kernel,
            trials,
            range(count),
            duration=duration,
            workers=self._workers,
            done=lambda rows: done(len(rows)),
        )
        mean_duration = float(np.mean(trials.steps)) * self._plant.controller.h
        rms_x = float(np.sqrt(np.sum(trials.sum_x2) / np.sum(trials.steps)))
        return Checkpoint(
            episodes=episodes,
            trials=count,
            survived=int(np.sum(trials.cause == TRUNCATED)),
            mean_duration=mean_duration,
            rms_x=rms_x,
            score=mean_duration / duration - selection.rms_x_weight * rms_x / paper.X_LIMIT,
        )


def _sorted(snapshots: list[_Snapshot]) -> list[_Snapshot]:
    return sorted(snapshots, key=lambda snapshot: -snapshot.candidate.score)
