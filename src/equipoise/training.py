"""Train: a pendulum and an arm become a policy.

A training runs its episodes in one compiled loop (`equipoise.learning.q_learning`) and stops now
and then to take the greedy policy as a candidate. Candidates are screened on selection trials, the
best go through a longer round, and the winner is kept, with the table as it was then. Equal seed
gives equal bits, whatever the number of workers.
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
    PolicyKernel,
    TabularPolicy,
    policy_kernel,
)
from equipoise.learning.closed_loop import LASTED, Plant, make_plant
from equipoise.learning.q_learning import (
    ENDED,
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

REPORTS = 200
"""How often a training without candidates reports its progress."""

Report = Callable[[LearningPoint], None]
"""Called with each point of the learning curve as it is made."""


class _Snapshot(NamedTuple):
    """A table of some moment."""

    Q: npt.NDArray[np.float64]
    visits: npt.NDArray[np.int64]
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
    parameters = pendulum.parameters()._replace(linearised=settings.plant.linearised)
    constants = _learner(settings)
    progress = new_progress()
    selecting = settings.selection.every > 0
    every = settings.selection.every or max(1, constants.episodes // REPORTS)
    curve: list[LearningPoint] = []
    snapshots: list[_Snapshot] = []
    while progress.totals[ENDED] < constants.episodes:
        ended, steps = int(progress.totals[ENDED]), int(progress.totals[STEPS])
        until = min(ended + every, constants.episodes)
        train_episodes(plant, parameters, constants, progress, until, seed, learner)
        point = LearningPoint(
            episodes=int(progress.totals[ENDED]),
            steps=int(progress.totals[STEPS]),
            duration=(int(progress.totals[STEPS]) - steps)
            * plant.h
            / (int(progress.totals[ENDED]) - ended),
        )
        if selecting:
            trials = settings.selection.screening_trials
            snapshot = _snapshot(plant, parameters, progress, settings, seed, trials, workers)
            snapshots = _best([*snapshots, snapshot], settings.selection.finalists)
            survival = snapshot.candidate.survived / trials
            point = point.model_copy(update={"survival": survival})
        curve.append(point)
        report(point)
    finalists = [
        _retried(plant, parameters, snapshot, settings, seed, workers) for snapshot in snapshots
    ]
    finalists = _best(finalists, len(finalists))
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


def _snapshot(
    plant: Plant,
    pendulum: PendulumParameters,
    progress: Progress,
    settings: Settings,
    seed: int,
    trials: int,
    workers: int,
) -> _Snapshot:
    Q, visits = progress.Q.copy(), progress.visits.copy()
    episodes = int(progress.totals[ENDED])
    candidate = _tried(plant, pendulum, Q, episodes, settings, seed, SCREENING, trials, workers)
    return _Snapshot(Q, visits, candidate)


def _retried(
    plant: Plant,
    pendulum: PendulumParameters,
    snapshot: _Snapshot,
    settings: Settings,
    seed: int,
    workers: int,
) -> _Snapshot:
    """Run the final round of one finalist."""
    Q, episodes = snapshot.Q, snapshot.candidate.episodes
    trials = settings.selection.final_trials
    candidate = _tried(plant, pendulum, Q, episodes, settings, seed, FINAL_ROUND, trials, workers)
    return snapshot._replace(candidate=candidate)


def _tried(
    plant: Plant,
    pendulum: PendulumParameters,
    Q: npt.NDArray[np.float64],
    episodes: int,
    settings: Settings,
    seed: int,
    stream: int,
    count: int,
    workers: int,
) -> Candidate:
    """Run the greedy policy of a table on selection trials."""
    selection = settings.selection
    trials = draw_trials(count, settings, seed, stream, selection.spread)
    run_over_cores(
        plant,
        _greedy(Q),
        pendulum,
        trials,
        duration=selection.duration,
        seed=seed,
        stream=stream,
        workers=workers,
    )
    mean_duration = float(np.mean(trials.steps)) * plant.h
    rms_x = float(np.sqrt(np.sum(trials.sum_x2) / np.sum(trials.steps)))
    penalty = selection.rms_x_weight * rms_x / paper.X_LIMIT
    return Candidate(
        episodes=episodes,
        trials=count,
        survived=int(np.sum(trials.cause == LASTED)),
        mean_duration=mean_duration,
        rms_x=rms_x,
        score=mean_duration / selection.duration - penalty,
    )


def _greedy(Q: npt.NDArray[np.float64]) -> PolicyKernel:
    u_of_box = np.array(paper.ACTIONS)[boxes.greedy_actions(Q)]
    return policy_kernel(TABLE, u_of_box=u_of_box)


def _best(snapshots: list[_Snapshot], count: int) -> list[_Snapshot]:
    return sorted(snapshots, key=lambda snapshot: -snapshot.candidate.score)[:count]
