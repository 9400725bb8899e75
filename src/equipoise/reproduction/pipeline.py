"""Reproduction of the paper: swing, identification, training, evaluations, and a run.

The policy of the default recipe is trained and evaluated on the training plant, with an actuator
that was identified on the digital twin; that of the literal recipe, `paper`, on the paper's own
simulation. Then both are evaluated on the twin, and one run of each is recorded there, as the paper
recorded one on the robot. An arm with unknown masses has no twin: each run is in the simulation of
its training.

Each stage takes the previous value and saves its own, so that any stage can be repeated from its
files. `equipoise.apps.report.page.build` makes the page from the folder.
"""

import os
import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

from equipoise.arguments import Workers, checked
from equipoise.artefacts import Seed, StrPath
from equipoise.control.bound_policy import BUILT_IN
from equipoise.control.policy import TabularPolicy
from equipoise.errors import ArmError
from equipoise.executors import Show, available_cores, counted
from equipoise.identification.recording import Trajectory, read_swing, write_swing
from equipoise.identification.swing import identify
from equipoise.learning.train import ATTEMPTS, TARGET, train, train_to_target
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.resolve import read_arm
from equipoise.model.worlds import IDEAL, MODEL
from equipoise.reproduction.results import (
    EVALUATION,
    LITERAL,
    PENDULUM,
    POLICY,
    RECORD,
    RUN,
    SWING,
    TWIN_EVALUATION,
    RecipeResults,
    ReproductionRecord,
    Results,
    digests,
)
from equipoise.reproduction.synthetic_swing import synthetic_swing
from equipoise.reproduction.warm_up import TWIN, is_warm, warm_up
from equipoise.rig.simulate import simulate_run
from equipoise.settings import Settings, changed, resolve
from equipoise.worlds.evaluation import Evaluation, evaluate

COMMAND: Final = "reproduce"
"""Command in the provenance of the files."""
QUICK: Final = {
    "learning.episodes": 5000,
    "selection.trials": 16,
    "selection.test_trials": 200,
    "selection.duration": 20.0,
    "evaluation.trials": 50,
    "evaluation.duration": 20.0,
}
"""Maximum settings of a quick reproduction, which takes less than a minute."""
TWIN_TRIALS: Final = 40
"""Maximum number of trials on the twin: a trial there takes thirty times as long."""


@checked
def reproduce(
    out: StrPath,
    *,
    swing: Trajectory | StrPath | None = None,
    arm: Arm | StrPath | None = None,
    settings: Settings | None = None,
    seed: Seed = 0,
    quick: bool = False,
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
        quick: Whether it runs with fewer episodes and trials (`QUICK`).
        workers: Number of threads (default: all cores); the results do not depend on it.
        report: Called with the progress, also from other threads.

    Raises:
        RecordingError: The swing identifies no pendulum.
        OutsideError: A file cannot be written.
    """
    out, arm = Path(out), read_arm(arm)
    settings = settings or Settings()
    literal = resolve("paper").model_copy(update={"evaluation": settings.evaluation})
    if quick:
        settings, literal = shortened(settings), shortened(literal)
    given = read_swing(swing) if isinstance(swing, str | os.PathLike) else swing
    workers = workers or available_cores()
    if not is_warm():
        warm_up(workers, report)
    stage = Stages(report)

    with stage("swing"):
        given = given or synthetic_swing(seed)
        write_swing(out / SWING, given)
        # The identification reads the file in the folder, so that a figure shows the same data.
        recorded = replace(read_swing(out / SWING), source=given.source, released=given.released)
    with stage("identify"):
        pendulum = identify(recorded, settings.identification)
        pendulum.save(out / PENDULUM, command=COMMAND, inputs={"swing": recorded.sha256})
    task: Any = {"pendulum": pendulum, "arm": arm, "seed": seed, "workers": workers}
    # Without a selection, or with few episodes, the first policy is taken as it is.
    selected = settings.selection.every > 0 and not quick
    target = (
        {"target": TARGET, "attempts": ATTEMPTS} if selected else {"target": 0.0, "attempts": 1}
    )
    with stage("train"):
        policy = train_to_target(settings=settings, **target, **task, show=report)
        policy.save(out / POLICY, command=COMMAND, inputs={"pendulum": pendulum.digest})
    default = _measure(policy, MODEL, out, "", seed, workers, stage)
    with stage("literal train"):
        show: Show = lambda name, *shown: report(f"literal {name}", *shown)  # noqa: E731
        policy = train(settings=literal, **task, show=show)
        policy.save(
            out / f"{LITERAL}{POLICY}", command=COMMAND, inputs={"pendulum": pendulum.digest}
        )
    found = _measure(policy, IDEAL, out, LITERAL, seed, workers, stage)

    record = ReproductionRecord(
        quick=quick,
        seed=seed,
        workers=workers,
        swing=given.source,
        swing_sha256=given.sha256,
        simulated=swing is None,
        files={},
        stages=stage.durations,
    )
    results = Results(record, recorded, pendulum, default, found)
    record = record.model_copy(update={"files": digests(results)})
    record.save(out / RECORD, command=COMMAND, inputs=record.files)
    return results._replace(record=record)


def _measure(
    policy: TabularPolicy,
    simulation: str,
    out: Path,
    prefix: str,
    seed: int,
    workers: int,
    stage: "Stages",
) -> RecipeResults:
    """Evaluate a policy in the simulation of its training and on the twin, and record a run.

    Args:
        policy: The trained policy.
        simulation: World of its training.
        out: Folder of the files.
        prefix: Prefix of their names.
        seed: Master seed of trials and run.
        workers: Number of threads.
        stage: Stages of the reproduction.
    """
    title, has_twin = prefix.replace("-", " "), _has_twin(policy.arm)
    trials, inputs = policy.settings.evaluation.trials, {"policy": policy.digest}
    tests = [("evaluate", EVALUATION, simulation, trials)]
    tests += [("twin", TWIN_EVALUATION, TWIN, min(TWIN_TRIALS, trials))] * has_twin
    found: list[Evaluation] = []
    for name, file, world, count in tests:
        with stage(title + name):
            with_baselines = world == MODEL
            total = count * (1 + len(BUILT_IN) * with_baselines)
            evaluation = evaluate(
                policy,
                changed(policy.settings, {"evaluation.trials": count}),
                world=world,
                seed=seed,
                with_baselines=with_baselines,
                workers=workers,
                done=counted(title + name, total, stage.report),
            )
            evaluation.save(out / f"{prefix}{file}", command=COMMAND, inputs=inputs)
            found.append(evaluation)
    with stage(f"{title}deploy"):
        run = simulate_run(policy, world=TWIN if has_twin else simulation, seed=seed)
        run.save(out / f"{prefix}{RUN}", command=COMMAND, inputs=inputs)
    return RecipeResults(policy, found[0], found[1] if has_twin else None, run)


class Stages:
    """Stages of a reproduction: context managers that report and time them."""

    def __init__(self, report: Show) -> None:
        """Begin without a stage; `report` receives begin and end of each."""
        self.report, self.durations = report, dict[str, float]()

    @contextmanager
    def __call__(self, name: str) -> Generator[None]:
        """Report and time a stage."""
        self.report(name, None, "")
        begin = time.perf_counter()
        yield
        self.durations[name] = round(time.perf_counter() - begin, 2)
        self.report(name, 1.0, "")


def shortened(settings: Settings) -> Settings:
    """Return the settings of a quick reproduction, limited by `QUICK`."""
    return changed(
        settings, {name: min(attrgetter(name)(settings), most) for name, most in QUICK.items()}
    )


def _has_twin(arm: Arm) -> bool:
    try:
        arm.link_inertials()
    except ArmError:
        return False
    return True
