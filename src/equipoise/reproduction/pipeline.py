"""Reproduction of the paper: swing, identification, training, evaluations, and a run.

The policy of the default recipe is trained and evaluated on the training plant, with an actuator
that was identified on the digital twin; that of the literal recipe, `paper`, on the paper's own
simulation. Then both are evaluated on the twin, and one run of each is recorded there, as the paper
recorded one on the robot. An arm with unknown masses has no twin: each run is in the simulation of
its training.

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
from equipoise.learning.train import train
from equipoise.logs.run_log import RunLog
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.resolve import read_arm
from equipoise.model.pendulum import Pendulum
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
    swing = swing if swing is None or isinstance(swing, Trajectory) else read_swing(swing)
    settings = shortened(settings or Settings()) if quick else settings or Settings()
    workers = workers or available_cores()
    has_twin = _has_twin(arm)
    literal = resolve("paper").model_copy(update={"evaluation": settings.evaluation})
    literal = shortened(literal) if quick else literal
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

    def of_recipe(
        prefix: str, simulation: str, trained: Callable[[Show], TabularPolicy]
    ) -> RecipeResults:
        title = prefix.replace("-", " ")
        policy = saved(
            f"{title}train",
            prefix + POLICY,
            lambda: trained(lambda name, *shown: report(title + name, *shown)),
            pendulum=pendulum.digest,
        )

        def evaluated(name: str, file: str, world: str) -> Evaluation:
            trials = settings.evaluation.trials
            trials = min(TWIN_TRIALS, trials) if world == TWIN else trials
            baselines = world == MODEL
            total = trials * (1 + len(BUILT_IN) * baselines)
            return saved(
                name,
                file,
                lambda: evaluate(
                    policy,
                    changed(policy.settings, {"evaluation.trials": trials}),
                    world=world,
                    seed=seed,
                    with_baselines=baselines,
                    workers=workers,
                    done=counted(name, total, report),
                ),
                policy=policy.digest,
            )

        evaluation = evaluated(f"{title}evaluate", prefix + EVALUATION, simulation)
        on_twin = None
        if has_twin:
            on_twin = evaluated(f"{title}twin", prefix + TWIN_EVALUATION, TWIN)
        run = saved(
            f"{title}deploy",
            prefix + RUN,
            lambda: simulate_run(policy, world=TWIN if has_twin else simulation, seed=seed),
            policy=policy.digest,
        )
        return RecipeResults(policy, evaluation, on_twin, run)

    def train_default(show: Show) -> TabularPolicy:
        # Without a selection, or with few episodes, the first learner is taken as it is.
        selected = not quick and settings.selection.every > 0
        return train_to_target(
            pendulum,
            arm,
            settings,
            target=TARGET if selected else 0.0,
            learners=LEARNERS if selected else 1,
            seed=seed,
            workers=workers,
            show=show,
        )

    def train_literal(show: Show) -> TabularPolicy:
        return train(pendulum, arm, literal, seed=seed, workers=workers, show=show)

    by_recipe = of_recipe("", MODEL, train_default), of_recipe(LITERAL, IDEAL, train_literal)
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
    results = Results(record, recorded, pendulum, *by_recipe)
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
