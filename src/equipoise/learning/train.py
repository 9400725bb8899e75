"""Training of a table for a pendulum and an arm, and the selection of its policy.

The episodes run in one compiled loop (`equipoise.learning.episodes`). Candidates are the greedy
policies of the running average of the later tables; the best one becomes the policy. All candidates
run the same trials: common random numbers make differences between them larger than those between
trials. Equal seeds give equal bits, for any number of workers.

`train_to_target` trains one seed after the other until a policy meets a target. The best of many
results is biased, so the test runs trials that selected nothing, as `evaluate` does. Their number
is fixed, so that the lower bound of the probability to survive is exact (Clopper & Pearson 1934).
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, Final

import numpy as np
from pydantic import Field

from equipoise import paper
from equipoise.arguments import Workers, checked
from equipoise.arm.arm import Arm
from equipoise.arm.urdf import read_arm
from equipoise.arrays import Array
from equipoise.control.policy import (
    TABLE,
    Checkpoint,
    KernelPolicy,
    LearningPoint,
    PolicyKernel,
    TabularPolicy,
    TargetTest,
)
from equipoise.errors import InputError
from equipoise.executors import Show, completed, counted
from equipoise.files import Fraction, Seed, StrPath
from equipoise.learning.choice import with_digests
from equipoise.learning.episodes import learn
from equipoise.learning.q_learning import new_tables
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator, read_actuator, shipped_actuator
from equipoise.model.grid import TRUNCATED, greedy_accelerations, make_grid
from equipoise.model.pendulum import Pendulum, read_pendulum
from equipoise.model.random import SELECTION, TARGET_TEST
from equipoise.model.worlds import IDEAL, MODEL
from equipoise.settings import Settings
from equipoise.simulation import Setup, setup_of, world_class
from equipoise.simulation.evaluation import lower_bound, trial_results
from equipoise.simulation.ideal import PlantSimulation
from equipoise.simulation.reachability import check_releases

ATTEMPTS: Final = 6
"""Maximum number of trainings of `train_to_target` by default."""
TARGET: Final = 0.99
"""Required probability to survive a trial, by default [-]."""
ERROR: Final = 0.05
"""Probability that a command accepts any policy below its target [-]."""
RMS_X_WEIGHT: Final = 0.2
"""Weight of rms(x) in the score = mean duration / duration - weight * rms(x) / 0.22 m. Trials end
at the track. Over 40 policies the rank correlation of rms(x) in 24 trials with the failures in 96
trials of five minutes was 0.85; that of the fraction survived was 0.81."""


@checked
def train(
    pendulum: Pendulum | StrPath | None = None,
    arm: Arm | StrPath | None = None,
    settings: Settings | None = None,
    *,
    actuator: Actuator | StrPath | None = None,
    world: str = MODEL,
    seed: Seed = 0,
    workers: Workers = 1,
    show: Show = lambda *_: None,
) -> TabularPolicy:
    """Train a table, and select the best policy of its training; `train_to_target` tests it, too.

    Args:
        pendulum: The identified pendulum, or its file; by default the one that ships.
        arm: The arm, its name or its URDF; by default the iiwa7.
        settings: Resolved settings; the sections clik, controller, plant, learning and selection
            are used.
        actuator: Actuator of the arm, its file, or `ideal`; by default ideal with `plant.ideal`,
            else the shipped one, identified from the twin.
        world: World of the episodes: `model`, the compiled plant; or a twin, or an address of
            CoppeliaSim, one episode after the other. Selection and test run on the plant.
        seed: Master seed.
        workers: Number of threads of the trials, or an executor; the result does not depend on
            it.
        show: Called with the progress of the stages `train` and `select`.

    Returns:
        The policy, with its learning curve and the results of its candidates.

    Raises:
        InputError: The world takes no such actuator.
        OutsideError: CoppeliaSim fails.
        SettingsError: No controller saves any of the releases, or the world is unknown.
    """
    pendulum, arm, settings = read_pendulum(pendulum), read_arm(arm), settings or Settings()
    check_task(pendulum, settings, actuator, world=world)
    response = actuator_in(world, settings, actuator)
    settings = settings.model_copy(update={"learning": with_digests(settings.learning)})
    selection, episodes = settings.selection, settings.learning.episodes
    setup = Setup(pendulum, arm, settings, response, paper.STEP)
    tables, candidates = new_tables(settings.boxes.count, 0), list[tuple[int, Array]]()
    average = tables.Q
    every = selection.every or max(1, episodes // 50)  # points of a curve without candidates
    curve: list[LearningPoint] = []
    for point, tables in learn(setup, world, seed, every):
        curve.append(point)
        average = average + max(selection.averaging, 1.0 / len(curve)) * (tables.Q - average)
        if selection.every and point.episodes > (1.0 - selection.late) * episodes:
            candidates.append((point.episodes, average))
        show("train", point.episodes / episodes, f"mean episode: {point.duration:.1f} s")
    policies = [(n, greedy_accelerations(table)) for n, table in candidates]
    done = counted("select", selection.trials * len(policies), show)
    results = score_tables(setup, policies, seed=seed, workers=workers, done=done)
    order = sorted(range(len(results)), key=lambda i: -results[i].score)
    chosen = candidates[order[0]][1] if order else tables.Q
    return TabularPolicy(
        actions=paper.ACTIONS,
        Q=tuple(tuple(row) for row in chosen.tolist()),
        visits=tuple(tuple(row) for row in tables.visits.tolist()),
        h=paper.STEP,
        pendulum=pendulum,
        arm=arm,
        actuator=response,
        settings=settings,
        seed=seed,
        episodes=curve[-1].episodes,
        steps=curve[-1].steps,
        learning_curve=tuple(curve),
        checkpoints=tuple(results[i] for i in order),
    )


def score_tables(
    setup: Setup,
    candidates: Sequence[tuple[int, Array]],
    *,
    seed: int,
    workers: Workers = 1,
    done: Callable[[float], None] = lambda _: None,
) -> list[Checkpoint]:
    """Score candidates on common trials.

    Args:
        setup: Pendulum, arm, settings and actuator.
        candidates: Number of training episodes of each, and its accelerations [m/s^2], shape
            (boxes,).
        seed: Master seed of the trials.
        workers: Number of threads, or an executor; the result does not depend on it.
        done: Called with the number of trials that have just finished.
    """
    simulation = PlantSimulation(MODEL, setup, seed=seed, stream=SELECTION)
    scored: dict[int, Checkpoint] = {}
    for i, checkpoint in completed(partial(_score_table, simulation), candidates, workers):
        scored[i] = checkpoint
        done(checkpoint.trials)
    return [scored[i] for i in range(len(candidates))]


def _score_table(simulation: PlantSimulation, candidate: tuple[int, Array]) -> Checkpoint:
    """Score a candidate: its number of training episodes, and its accelerations [m/s^2]."""
    (episodes, u_of_box), setup = candidate, simulation.setup
    boxes = make_grid(setup.settings.boxes, simulation.pendulum.k)
    selection = setup.settings.selection
    kernel, trials = PolicyKernel(TABLE, u_of_box, boxes=boxes), simulation.draw(selection.trials)
    simulation.run(KernelPolicy(kernel), trials, duration=selection.duration)
    mean_duration = float(np.mean(trials.steps)) * setup.h
    rms_x = float(np.sqrt(np.sum(trials.sum_x2) / np.sum(trials.steps)))
    score = mean_duration / selection.duration - RMS_X_WEIGHT * rms_x / paper.X_LIMIT
    return Checkpoint(
        episodes=episodes,
        trials=selection.trials,
        survived=int(np.sum(trials.cause == TRUNCATED)),
        mean_duration=mean_duration,
        rms_x=rms_x,
        score=score,
    )


def measure_survival(
    policy: TabularPolicy,
    *,
    target: float,
    confidence: float = 0.95,
    workers: Workers = 1,
    done: Callable[[float], None] = lambda _: None,
) -> TargetTest:
    """Test a policy in held-out trials on the plant of its training.

    Args:
        policy: The policy; its settings give number and length of the trials.
        target: Required probability to survive a trial.
        confidence: Confidence of the lower bound.
        workers: Number of threads, or an executor; the result does not depend on it.
        done: Called with the number of trials that have just finished.
    """
    selection = policy.settings.selection
    simulation = PlantSimulation(
        MODEL, setup_of(policy, MODEL), seed=policy.seed, stream=TARGET_TEST
    )
    trials = simulation.draw(selection.test_trials)
    simulation.run(policy, trials, duration=selection.duration, workers=workers, done=done)
    found = trial_results(policy.name, trials, policy.h).summary()
    return TargetTest(
        target=target,
        duration=selection.duration,
        trials=selection.test_trials,
        survived=found.survived,
        at_least=lower_bound(found.survived, selection.test_trials, confidence),
        causes=found.outcomes,
    )


@checked
def train_to_target(
    pendulum: Pendulum | StrPath | None = None,
    arm: Arm | StrPath | None = None,
    settings: Settings | None = None,
    *,
    target: Fraction = TARGET,
    attempts: Annotated[int, Field(ge=1)] = ATTEMPTS,
    actuator: Actuator | StrPath | None = None,
    world: str = MODEL,
    seed: Seed = 0,
    workers: Workers = 1,
    show: Show = lambda *_: None,
) -> TabularPolicy:
    """Train with one seed after the other, until a policy meets a target in held-out trials.

    A policy below the target is accepted with a probability of at most 5 %, over all attempts.

    Args:
        pendulum: The identified pendulum; as in `train`.
        arm: The arm; as in `train`.
        settings: Resolved settings; as in `train`.
        target: Required probability to survive a trial: the lower bound of the test reaches it.
        attempts: Maximum number of trainings; the seed increases by one each time.
        actuator: Actuator of the arm; as in `train`.
        world: World of the episodes; as in `train`.
        seed: Master seed of the first attempt.
        workers: Number of threads of the trials, or an executor; the result does not depend on
            it.
        show: Called with the progress of the stages `train`, `select` and `test`.

    Returns:
        The first tested policy that meets the target; if none does, the one with the highest lower
        bound.

    Raises:
        InputError: The test has too few trials for the target, even without a failure.
        SettingsError: No controller saves as many of the releases as the target needs.
    """
    pendulum, arm, settings = read_pendulum(pendulum), read_arm(arm), settings or Settings()
    confidence = 1.0 - ERROR / attempts
    trials = settings.selection.test_trials
    if lower_bound(trials, trials, confidence) < target:
        raise InputError(
            f"{trials:,} trials cannot show a survival of {target:g}, even without a failure; "
            "lower --target, or raise selection.test_trials"
        )
    check_task(pendulum, settings, actuator, world=world, target=target)
    train_task = partial(train, pendulum, arm, settings, actuator=actuator, world=world)
    tested: list[TabularPolicy] = []
    for attempt in range(attempts):
        show_attempt = _number_stages(show, attempt)
        policy = train_task(seed=seed + attempt, workers=workers, show=show_attempt)
        done = counted("test", trials, show_attempt)
        test = measure_survival(
            policy, target=target, confidence=confidence, workers=workers, done=done
        )
        tested.append(policy.model_copy(update={"test": test}))
        if test.met:
            return tested[-1]
    return max(tested, key=lambda policy: policy.test.at_least if policy.test else 0.0)


def _number_stages(show: Show, attempt: int) -> Show:
    """Return a callback that numbers the stages of the attempts after the first."""
    suffix = f" {attempt + 1}" if attempt else ""
    return lambda stage, *state: show(stage + suffix, *state)


def check_task(
    pendulum: Pendulum,
    settings: Settings,
    actuator: Actuator | StrPath | None = None,
    *,
    world: str = MODEL,
    target: float = 0.0,
) -> str | None:
    """Compare the releases of a task with the recoverable set, before a training.

    Args:
        pendulum: The identified pendulum.
        settings: Resolved settings.
        actuator: Actuator of the arm; as in `train`.
        world: World of the episodes; as in `train`.
        target: Fraction of the releases that a policy shall balance.

    Returns:
        A warning with the fraction of releases that no controller saves, or None.

    Raises:
        InputError: The world takes no such actuator, or a user's algorithm or reward is invalid.
        SettingsError: The algorithm or the reward is unknown, or no controller saves any of the
            releases, or the fraction that the target needs.
    """
    with_digests(settings.learning)
    parameters = pendulum.parameters(linearised=settings.plant.linearised)
    response = actuator_in(world, settings, actuator)
    return check_releases(parameters, settings, response, least=target)


def actuator_in(world: str, settings: Settings, actuator: Actuator | StrPath | None) -> Actuator:
    """Return the actuator of a training in a world: the ideal one for an arm without delay.

    Raises:
        InputError: The world takes no such actuator.
        SettingsError: The world is unknown.
    """
    if world == IDEAL:
        raise InputError(
            "the world ideal is a setting of the compiled training; leave out the world, and take "
            "the recipe paper or --set plant.ideal=true"
        )
    kinematic = world != MODEL and world_class(world).ideal_arm
    if actuator is None:
        ideal = kinematic or settings.plant.ideal
        return IDEAL_ACTUATOR if ideal else shipped_actuator()
    actuator = read_actuator(actuator)
    if kinematic and actuator != IDEAL_ACTUATOR:
        raise InputError(f"the arm of the world {world} has no delay; leave out the actuator")
    return actuator
