"""Reproduction of the paper: swing, identification, training, evaluations, and a run.

The policy is trained and evaluated on the training plant, with an actuator that was identified on
the digital twin. Then it is evaluated on the twin, and one run there is recorded, as the paper
recorded one on the robot. An arm with unknown masses has no twin: its run is on the model.

Each stage takes the previous value and saves its own, so that any stage can be repeated from its
files. `equipoise.apps.report.page.build` makes the page from the folder.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Final, TypeVar

from equipoise.arguments import Workers, checked
from equipoise.artefacts import Seed, StrPath
from equipoise.control.bound_policy import BUILT_IN
from equipoise.control.policy import TabularPolicy
from equipoise.errors import ArmError
from equipoise.executors import Show, available_cores, counted
from equipoise.identification.recording import Trajectory, read_swing, write_swing
from equipoise.identification.swing import identify
from equipoise.learning.target import LEARNERS, TARGET, train_to_target
from equipoise.logs.run_log import RunLog
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.resolve import read_arm
from equipoise.model.pendulum import Pendulum
from equipoise.model.worlds import MODEL
from equipoise.reproduction.results import (
    EVALUATION,
    PENDULUM,
    POLICY,
    RECORD,
    RUN,
    SWING,
    TWIN_EVALUATION,
    WITHOUT_PREDICTION,
    ReproductionRecord,
    Results,
    digests,
)
from equipoise.reproduction.synthetic_swing import synthetic_swing
from equipoise.reproduction.warm_up import TWIN, is_warm, warm_up
from equipoise.rig.simulate import simulate_run
from equipoise.settings import Settings, changed
from equipoise.worlds.evaluation import Evaluation, evaluate

T = TypeVar("T")
S = TypeVar("S", Pendulum, TabularPolicy, Evaluation, RunLog)

QUICK: Final = {
    "learning.episodes": 5000,
    "selection.candidates": 16,
    "selection.round_trials": 64,
    "selection.rounds": 5,
    "selection.duration": 20.0,
    "evaluation.trials": 50,
    "evaluation.duration": 20.0,
}
"""Maximum settings of a quick reproduction, which takes less than a minute."""
TWIN_TRIALS: Final = 40
"""Maximum number of trials of the second evaluation: a trial there takes thirty times as long."""


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
    """Reproduce the paper from the swing to a run on the digital twin, and save every value.

    Args:
        out: Folder of the files, created if missing.
        swing: A recorded free swing, or its file (default: a simulated one).
        arm: The arm, its name or its URDF (default: the iiwa7).
        settings: Resolved settings (default: `Settings()`).
        seed: Master seed.
        quick: Whether it runs with fewer episodes and trials (`QUICK`).
        workers: Number of threads (default: all cores); the results do not depend on it.
        report: Called with the progress, also from other threads.

    Raises:
        RecordingError: The swing identifies no pendulum.
        OutsideError: A file cannot be written.
    """
    out, arm = Path(out), read_arm(arm)
    swing = swing if swing is None or isinstance(swing, Trajectory) else read_swing(swing)
    settings = shortened(settings or Settings()) if quick else settings or Settings()
    workers = workers or available_cores()
    world = TWIN if _has_twin(arm) else MODEL
    stages: dict[str, float] = {}

    def stage(name: str, work: Callable[[], T]) -> T:
        report(name, None, "")
        begin = time.perf_counter()
        value = work()
        stages[name] = round(time.perf_counter() - begin, 2)
        report(name, 1.0, "")
        return value

    def saved(name: str, file: str, work: Callable[[], S], **inputs: str) -> S:
        value = stage(name, work)
        value.save(out / file, command="reproduce", inputs=inputs)
        return value

    if not is_warm():
        warm_up(workers, report)
    given = stage("swing", lambda: swing or synthetic_swing(seed))
    write_swing(out / SWING, given)
    # The identification reads the file in the folder, so that a figure shows the same data.
    recorded = replace(read_swing(out / SWING), source=given.source, released=given.released)
    pendulum = saved(
        "identify",
        PENDULUM,
        lambda: identify(recorded, settings.identification),
        swing=recorded.sha256,
    )
    # Without a selection, or with few episodes, the first learner is taken as it is.
    selected = not quick and settings.selection.every > 0
    policy = saved(
        "train",
        POLICY,
        lambda: train_to_target(
            pendulum,
            arm,
            settings,
            target=TARGET if selected else 0.0,
            learners=LEARNERS if selected else 1,
            seed=seed,
            workers=workers,
            show=report,
        ),
        pendulum=pendulum.digest,
    )

    of_policy = {"policy": policy.digest}

    def evaluated(name: str, file: str, world: str, predict: bool = True) -> Evaluation:
        model, most = world == MODEL, settings.evaluation.trials
        trials = most if model else min(TWIN_TRIALS, most)
        changes = {"evaluation.trials": trials}
        if not predict:
            changes["controller.predict"] = False
        return saved(
            name,
            file,
            lambda: evaluate(
                policy,
                changed(policy.settings, changes),
                world=world,
                seed=seed,
                with_baselines=model,
                workers=workers,
                done=counted(name, trials * (1 + len(BUILT_IN) * model), report),
            ),
            **of_policy,
        )

    evaluation = evaluated("evaluate", EVALUATION, MODEL)
    twin_evaluation = without_prediction = None
    if world == TWIN:
        twin_evaluation = evaluated("evaluate twin", TWIN_EVALUATION, TWIN)
        without_prediction = evaluated("no prediction", WITHOUT_PREDICTION, TWIN, predict=False)
    run = saved("deploy", RUN, lambda: simulate_run(policy, world=world, seed=seed), **of_policy)

    record = ReproductionRecord(
        quick=quick,
        seed=seed,
        workers=workers,
        swing=given.source,
        swing_sha256=given.sha256,
        simulated=swing is None,
        files={},
        stages=stages,
    )
    results = Results(
        record,
        recorded,
        pendulum,
        policy,
        evaluation,
        twin_evaluation,
        without_prediction,
        run,
    )
    record = record.model_copy(update={"files": digests(results)})
    record.save(out / RECORD, command="reproduce", inputs=record.files)
    return results._replace(record=record)


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
