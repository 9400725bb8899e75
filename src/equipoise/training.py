"""Train: a pendulum and an arm become a policy.

A training runs its episodes in one compiled loop (`equipoise.learning.q_learning`) and stops now
and then to take the greedy policy as a candidate. Candidates are screened on selection trials, the
best go through a round of longer trials, and the winner is kept, with the table as it was then.
Equal seed gives equal bits, whatever the number of workers.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.control import boxes
from equipoise.control.policy import (
    TABLE,
    Candidate,
    LearningPoint,
    TabularPolicy,
    greedy_accelerations,
    policy_kernel,
)
from equipoise.learning.closed_loop import LASTED, Plant, make_plant
from equipoise.learning.q_learning import (
    ENDED,
    ENDED_STEPS,
    STEPS,
    Learner,
    Progress,
    new_progress,
    train_episodes,
)
from equipoise.learning.trials import draw_trials, run_over_cores
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import Pendulum, PendulumParameters
from equipoise.model.random import FINAL_ROUND, SCREENING
from equipoise.settings import Settings

Array = npt.NDArray[np.float64]

REPORTS = 200
"""How often a training without candidates reports its progress."""

Report = Callable[[LearningPoint], None]
"""Called with each point of the learning curve as it is made."""


class _Snapshot(NamedTuple):
    """A table of some moment."""

    Q: Array
    visits: npt.NDArray[np.int64]
    u_of_box: Array
    candidate: Candidate


def train(
    pendulum: Pendulum,
    arm: Arm,
    settings: Settings,
    *,
    seed: int = 0,
    learner: int = 0,
    recipe: str = "robust",
    workers: int = 1,
    report: Report = lambda _: None,
) -> TabularPolicy:
    """Train one policy.

    Args:
        pendulum: The pendulum, as identified.
        arm: The arm with its home posture.
        settings: Resolved settings; the sections clik, plant, learning and selection are used.
        seed: Master seed.
        learner: Which learner of that seed; each has random numbers of its own.
        recipe: Name of the settings, for the record.
        workers: Threads for the selection trials; the result does not depend on it.
        report: Called with each new point of the learning curve.

    Returns:
        The policy, with its learning curve and the finalists of its selection.
    """
    plant = make_plant(arm, settings, paper.STEP)
    parameters = pendulum.parameters(linearised=settings.plant.linearised)
    constants = _learner(settings)
    progress = new_progress()
    selection = _Selection(plant, parameters, settings, seed, workers)
    every = settings.selection.every or max(1, constants.episodes // REPORTS)
    curve: list[LearningPoint] = []
    while progress.totals[ENDED] < constants.episodes:
        ended, steps = int(progress.totals[ENDED]), int(progress.totals[ENDED_STEPS])
        until = min(ended + every, constants.episodes)
        train_episodes(plant, parameters, constants, progress, until, seed, learner)
        point = LearningPoint(
            episodes=int(progress.totals[ENDED]),
            steps=int(progress.totals[STEPS]),
            duration=plant.h
            * (int(progress.totals[ENDED_STEPS]) - steps)
            / (int(progress.totals[ENDED]) - ended),
        )
        if settings.selection.every > 0:
            screened = selection.screen(progress)
            share = screened.survived / screened.trials
            point = point.model_copy(update={"survival": share})
        curve.append(point)
        report(point)
    finalists = selection.final_round()
    Q, visits = (
        (finalists[0].Q, finalists[0].visits) if finalists else (progress.Q, progress.visits)
    )
    return TabularPolicy(
        boxes=boxes.describe(),
        actions=paper.ACTIONS,
        Q=tuple(tuple(row) for row in Q.tolist()),
        visits=tuple(tuple(row) for row in visits.tolist()),
        h=plant.h,
        pendulum=pendulum,
        arm=arm,
        recipe=recipe,
        settings=settings,
        seed=seed,
        learner=learner,
        episodes=int(progress.totals[ENDED]),
        steps=int(progress.totals[STEPS]),
        learning_curve=tuple(curve),
        candidates=tuple(snapshot.candidate for snapshot in finalists),
    )


def train_several(
    pendulum: Pendulum,
    arm: Arm,
    settings: Settings,
    *,
    learners: int,
    seed: int = 0,
    recipe: str = "robust",
    workers: int = 1,
    report: Callable[[int, LearningPoint], None] = lambda _, __: None,
) -> list[TabularPolicy]:
    """Train several learners of one seed over the cores; the best of the selection comes first.

    All are compared on the same selection trials. With recipes that select nothing the order is
    that of the learners.

    Args:
        pendulum: The pendulum, as identified.
        arm: The arm with its home posture.
        settings: Resolved settings.
        learners: How many.
        seed: Master seed.
        recipe: Name of the settings, for the record.
        workers: Threads; the results do not depend on it.
        report: Called with the learner and each new point of its learning curve.
    """

    def one(learner: int) -> TabularPolicy:
        return train(
            pendulum,
            arm,
            settings,
            seed=seed,
            learner=learner,
            recipe=recipe,
            workers=1 if learners > 1 else workers,
            report=lambda point: report(learner, point),
        )

    with ThreadPoolExecutor(workers) as pool:
        policies = list(pool.map(one, range(learners)))
    return sorted(policies, key=lambda p: -p.candidates[0].score if p.candidates else 0.0)


def _learner(settings: Settings) -> Learner:
    s = settings.learning
    return Learner(
        episodes=s.episodes,
        longest=round(s.episode_duration / paper.STEP),
        gamma=s.gamma,
        alpha_initial=s.alpha_initial,
        alpha_decay=s.alpha_decay,
        alpha_minimum=s.alpha_minimum,
        epsilon_initial=s.epsilon_initial,
        epsilon_until=s.epsilon_until,
        reward_failure=s.reward_failure,
        mirrored=s.mirrored,
        start=(s.start_x, s.start_x_dot, s.start_phi, s.start_phi_dot),
        inertia_sigma=settings.plant.inertia_sigma,
        friction_sigma=settings.plant.friction_sigma,
        boxes=boxes.boxes(),
        actions=paper.ACTIONS,
    )


class _Selection:
    """The search for the best greedy policy of one training."""

    def __init__(
        self,
        plant: Plant,
        pendulum: PendulumParameters,
        settings: Settings,
        seed: int,
        workers: int,
    ) -> None:
        self._plant, self._pendulum, self._settings = plant, pendulum, settings
        self._seed, self._workers = seed, workers
        self._known: dict[bytes, Candidate] = {}
        self._best: list[_Snapshot] = []

    def screen(self, progress: Progress) -> Candidate:
        """Run the screening trials of a table's greedy policy, once for each policy."""
        u_of_box = greedy_accelerations(progress.Q)
        policy = u_of_box.tobytes()
        if policy not in self._known:
            selection = self._settings.selection
            candidate = self._run(
                u_of_box,
                int(progress.totals[ENDED]),
                SCREENING,
                selection.screening_trials,
                selection.duration,
            )
            self._known[policy] = candidate
            snapshot = _Snapshot(progress.Q.copy(), progress.visits.copy(), u_of_box, candidate)
            self._best = _sorted([*self._best, snapshot])[: selection.finalists]
        return self._known[policy]

    def final_round(self) -> list[_Snapshot]:
        """Run the longer trials of the finalists, and return them, the best first."""
        selection = self._settings.selection
        return _sorted(
            [
                snapshot._replace(
                    candidate=self._run(
                        snapshot.u_of_box,
                        snapshot.candidate.episodes,
                        FINAL_ROUND,
                        selection.final_trials,
                        selection.final_duration,
                    )
                )
                for snapshot in self._best
            ]
        )

    def _run(
        self, u_of_box: Array, episodes: int, stream: int, count: int, duration: float
    ) -> Candidate:
        selection = self._settings.selection
        trials = draw_trials(count, self._settings, self._seed, stream, selection.spread)
        run_over_cores(
            self._plant,
            policy_kernel(TABLE, u_of_box=u_of_box),
            self._pendulum,
            trials,
            duration=duration,
            seed=self._seed,
            stream=stream,
            workers=self._workers,
        )
        mean_duration = float(np.mean(trials.steps)) * self._plant.h
        rms_x = float(np.sqrt(np.sum(trials.sum_x2) / np.sum(trials.steps)))
        return Candidate(
            episodes=episodes,
            trials=count,
            survived=int(np.sum(trials.cause == LASTED)),
            mean_duration=mean_duration,
            rms_x=rms_x,
            score=mean_duration / duration - selection.rms_x_weight * rms_x / paper.X_LIMIT,
        )


def _sorted(snapshots: list[_Snapshot]) -> list[_Snapshot]:
    return sorted(snapshots, key=lambda snapshot: -snapshot.candidate.score)
