"""Train: a pendulum and an arm become a policy.

A training runs its episodes in one compiled loop (`equipoise.learning.q_learning`) and stops now
and then to take the greedy policy as a candidate. Candidates are screened on selection trials, the
best go through a round of longer trials, and the winner is kept, with the table as it was then.
Equal seed gives equal bits, whatever the number of workers.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from math import inf
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.control import boxes
from equipoise.control.boxes import LASTED
from equipoise.control.policy import (
    TABLE,
    Candidate,
    LearningPoint,
    TabularPolicy,
    greedy_accelerations,
    policy_kernel,
)
from equipoise.learning.closed_loop import Plant, make_plant
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
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator, shipped_actuator
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import Pendulum, PendulumParameters
from equipoise.model.random import FINAL_ROUND, SCREENING
from equipoise.settings import Settings

Array = npt.NDArray[np.float64]

REPORTS = 200
"""How often a training without candidates reports its progress."""

LEARNERS = 3
"""How many learners a command trains to keep the best: one in three finds no table that stands on
the worst plants of its selection."""

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
    actuator: Actuator | None = None,
    seed: int = 0,
    learner: int = 0,
    recipe: str = "robust",
    warm: TabularPolicy | None = None,
    workers: int = 1,
    report: Report = lambda _: None,
) -> TabularPolicy:
    """Train one policy.

    Args:
        pendulum: The pendulum, as identified.
        arm: The arm with its home posture.
        settings: Resolved settings; the sections clik, controller, plant, learning and selection
            are used.
        actuator: How the arm follows its setpoints; if not given, at once where `plant.ideal`
            says so, else as the shipped one, identified from the twin.
        seed: Master seed.
        learner: Which learner of that seed; each has random numbers of its own.
        recipe: Name of the settings, for the record.
        warm: A policy to go on from, of which table and visits are the start; zeros if not given.
        workers: Threads for the selection trials; the result does not depend on it.
        report: Called with each new point of the learning curve.

    Returns:
        The policy, with its learning curve and the finalists of its selection.
    """
    if actuator is None:
        actuator = IDEAL_ACTUATOR if settings.plant.ideal else shipped_actuator()
    parameters = pendulum.parameters(linearised=settings.plant.linearised)
    plant = make_plant(arm, settings, paper.STEP, parameters, actuator)
    # A table cannot see such a failure coming: it is the selection that finds those that avoid it.
    of_episodes = plant._replace(speed_limit=inf)
    constants = _learner(settings)
    progress = new_progress()
    if warm is not None:
        progress.Q[:], progress.visits[:] = warm.table, warm.visits
    selection = _Selection(plant, parameters, settings, seed, workers)
    every = settings.selection.every or max(1, constants.episodes // REPORTS)
    curve: list[LearningPoint] = []
    h = plant.controller.h
    while progress.totals[ENDED] < constants.episodes:
        ended, steps = int(progress.totals[ENDED]), int(progress.totals[ENDED_STEPS])
        until = min(ended + every, constants.episodes)
        train_episodes(of_episodes, parameters, constants, progress, until, seed, learner)
        point = LearningPoint(
            episodes=int(progress.totals[ENDED]),
            steps=int(progress.totals[STEPS]),
            duration=h
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
        h=h,
        pendulum=pendulum,
        arm=arm,
        actuator=actuator,
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
    learners: int = LEARNERS,
    actuator: Actuator | None = None,
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
        actuator: How the arm follows its setpoints; as in `train`.
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
            actuator=actuator,
            seed=seed,
            learner=learner,
            recipe=recipe,
            workers=1 if learners > 1 else workers,
            report=lambda point: report(learner, point),
        )

    with ThreadPoolExecutor(workers) as pool:
        policies = list(pool.map(one, range(learners)))
    return sorted(policies, key=lambda p: -p.candidates[0].score if p.candidates else 0.0)


def judge(policy: TabularPolicy, *, seed: int = 0, workers: int = 1) -> Candidate:
    """Return how a policy does in the final round of a selection, on the model that it carries.

    Args:
        policy: The policy, with pendulum, arm and actuator.
        seed: Master seed of the trials; policies of one model are compared on those of one seed.
        workers: Threads; the result does not depend on it.
    """
    parameters = policy.pendulum.parameters(linearised=policy.settings.plant.linearised)
    plant = make_plant(policy.arm, policy.settings, policy.h, parameters, policy.actuator)
    selection = _Selection(plant, parameters, policy.settings, seed, workers)
    return selection.final(policy.u_of_box, policy.episodes)


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
        held=s.held,
        start=(s.start_x, s.start_x_dot, s.start_phi, s.start_phi_dot),
        inertia_sigma=settings.plant.inertia_sigma,
        friction_sigma=settings.plant.friction_sigma,
        delay_spread=settings.plant.delay_spread,
        lag_spread=settings.plant.lag_spread,
        zero_error=settings.plant.zero_error,
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
        self._averaged, self._screened = new_progress().Q, 0
        self._known: dict[bytes, Candidate] = {}
        self._best: list[_Snapshot] = []

    def screen(self, progress: Progress) -> Candidate:
        """Run the screening trials of the averaged table's greedy policy, once for each policy."""
        self._screened += 1
        newest = max(self._settings.selection.averaging, 1.0 / self._screened)
        self._averaged += newest * (progress.Q - self._averaged)
        u_of_box = greedy_accelerations(self._averaged)
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
            snapshot = _Snapshot(self._averaged.copy(), progress.visits.copy(), u_of_box, candidate)
            self._best = _sorted([*self._best, snapshot])[: selection.finalists]
        return self._known[policy]

    def final_round(self) -> list[_Snapshot]:
        """Run the longer trials of the finalists, and return them, the best first."""
        return _sorted(
            [
                snapshot._replace(
                    candidate=self.final(snapshot.u_of_box, snapshot.candidate.episodes)
                )
                for snapshot in self._best
            ]
        )

    def final(self, u_of_box: Array, episodes: int) -> Candidate:
        """Run the longer trials of one greedy policy, taken after so many episodes."""
        selection = self._settings.selection
        return self._run(
            u_of_box, episodes, FINAL_ROUND, selection.final_trials, selection.final_duration
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
        mean_duration = float(np.mean(trials.steps)) * self._plant.controller.h
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
