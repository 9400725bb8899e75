"""Reproduction of the paper: identify, train, evaluate, deploy on the digital twin.

The policy of the default recipe is trained and evaluated on the training plant, with an actuator
that was identified on the digital twin; that of the literal recipe, `paper`, on the paper's own
simulation. Then both are evaluated on the twin, and one run of each is recorded there, as the paper
recorded one on the robot; the default recipe also swings a hanging pendulum up. An arm with unknown
masses has no twin: each run is in the simulation of its training. `equipoise.report.page.build`
makes the page from the results.
"""

import os
import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from equipoise import paper
from equipoise.arguments import Workers, checked
from equipoise.arm.arm import Arm
from equipoise.arm.urdf import read_arm
from equipoise.control.bound_policy import BUILT_IN
from equipoise.control.policy import TabularPolicy
from equipoise.errors import ArmError
from equipoise.executors import Show, available_cores, counted
from equipoise.files import Seed, StrPath
from equipoise.identification.recording import Trajectory, read_swing, write_swing
from equipoise.identification.swing import identify
from equipoise.learning.train import TARGET, train, train_to_target
from equipoise.model.worlds import IDEAL, MODEL
from equipoise.reproduction.results import SWING, RecipeResults, Results
from equipoise.reproduction.synthetic_swing import synthetic_swing
from equipoise.reproduction.warm_up import TWIN, is_warm, warm_up
from equipoise.rig.simulate import simulate_run
from equipoise.settings import HANGING, Settings, changed, resolve
from equipoise.simulation.evaluation import Evaluation, evaluate


@checked
def reproduce(
    out: StrPath,
    *,
    swing: Trajectory | StrPath | None = None,
    arm: Arm | StrPath | None = None,
    settings: Settings | None = None,
    seed: Seed = 0,
    workers: Workers | None = None,
    report: Show = lambda *_: None,
) -> Results:
    """Reproduce the paper from the swing to runs on the digital twin, and save every value.

    Args:
        out: Folder of the files, created if missing.
        swing: A recorded free swing, or its file (default: a simulated one).
        arm: The arm, its name or its URDF (default: the iiwa7).
        settings: Resolved settings (default: `Settings()`); the literal recipe takes its trials.
        seed: Master seed.
        workers: Number of threads (default: all cores), or an executor; the results do not depend
            on it.
        report: Called with the progress, also from other threads.

    Raises:
        RecordingError: The swing identifies no pendulum.
        OutsideError: A file cannot be written.
    """
    out, arm, workers = Path(out), read_arm(arm), workers or available_cores()
    settings = settings or Settings()
    literal = resolve("paper").model_copy(update={"evaluation": settings.evaluation})
    recording = read_swing(swing) if isinstance(swing, str | os.PathLike) else swing
    if not is_warm():
        warm_up(report)

    with stage("identify", report):
        source = recording or synthetic_swing(seed)
        write_swing(out / SWING, source)
        # The fit is of the file in the folder, so that a figure shows the same data.
        fitted = replace(read_swing(out / SWING), source=source.source, released=source.released)
        pendulum = identify(fitted, settings.identification)

    begin = time.perf_counter()
    with stage("train", report):
        # A training without a selection is taken as it is.
        target = TARGET if settings.selection.every > 0 else 0.0
        policy = train_to_target(
            pendulum, arm, settings, target=target, seed=seed, workers=workers, show=report
        )
    training_s = round(time.perf_counter() - begin, 2)
    with stage("literal train", report):
        literal_policy = train(pendulum, arm, literal, seed=seed, workers=workers)

    default_results = measure(policy, MODEL, "", seed, workers, report)
    literal_results = measure(literal_policy, IDEAL, "literal ", seed, workers, report)
    with stage("swing-up", report):
        swing_up = simulate_run(
            policy,
            world=default_results.run.conditions.world,
            seed=seed,
            duration=paper.SECONDS_BALANCED,
            settings=changed(
                policy.settings, {"evaluation.start": HANGING, "plant.linearised": False}
            ),
        )

    results = Results(
        seed=seed,
        simulated=recording is None,
        training_s=training_s,
        swing=fitted,
        pendulum=pendulum,
        default=default_results,
        literal=literal_results,
        swing_up=swing_up,
    )
    for name, value in results.files().items():
        value.save(out / name, command="reproduce", inputs={"swing": fitted.sha256})
    return results


def measure(
    policy: TabularPolicy, world: str, title: str, seed: int, workers: Workers, report: Show
) -> RecipeResults:
    """Evaluate a policy in the world of its training and on the twin, and record a run.

    Args:
        policy: The trained policy.
        world: World of its training; the baselines run on the plant, `model`, alone.
        title: Prefix of the names of the stages.
        seed: Master seed of trials and run.
        workers: Number of threads, or an executor.
        report: Called with the progress.
    """

    def run_trials(name: str, world: str, trials: int, *, with_baselines: bool) -> Evaluation:
        total = trials * (1 + len(BUILT_IN)) if with_baselines else trials
        with stage(name, report):
            return evaluate(
                policy,
                changed(policy.settings, {"evaluation.trials": trials}),
                world=world,
                seed=seed,
                with_baselines=with_baselines,
                workers=workers,
                done=counted(name, total, report),
            )

    trials = policy.settings.evaluation.trials
    evaluation = run_trials(f"{title}evaluate", world, trials, with_baselines=world == MODEL)
    try:
        policy.arm.link_inertials()
    except ArmError:  # an arm with unknown masses has no twin
        twin_evaluation = None
    else:
        world, trials = TWIN, min(40, trials)  # a trial there takes thirty times as long
        twin_evaluation = run_trials(f"{title}twin", TWIN, trials, with_baselines=False)
    with stage(f"{title}deploy", report):
        run = simulate_run(policy, world=world, seed=seed)
    return RecipeResults(policy, evaluation, twin_evaluation, run)


@contextmanager
def stage(name: str, report: Show) -> Generator[None]:
    """Report begin and end of a stage."""
    report(name, None, "")
    yield
    report(name, 1.0, "")
