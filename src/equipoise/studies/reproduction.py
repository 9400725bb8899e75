"""Reproduce the paper: a swing, its identification, training, evaluation, one deployment run.

Each stage takes the value of the one before and saves its own, so that any of them can be repeated
from its files; nothing is drawn here. The page is made from the folder, by
`equipoise.report.page.build`.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Final, NamedTuple, TypeVar

from equipoise.artefacts import Artefact
from equipoise.control.policy import LearningPoint
from equipoise.deployment import deploy
from equipoise.evaluation import evaluate
from equipoise.identification import identify
from equipoise.learning.trials import available_cores
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.iiwa import iiwa
from equipoise.runlog import RunLog
from equipoise.settings import Settings, resolve
from equipoise.studies.results import (
    EVALUATION,
    PENDULUM,
    POLICY,
    RECORD,
    RUN,
    SWING,
    Record,
    Results,
    Stage,
    digests,
    verdict,
)
from equipoise.studies.stand_in import SimulatedSwing, simulated_swing
from equipoise.training import train
from equipoise.trajectory import Trajectory, read_swing, write_swing

T = TypeVar("T")

COMMAND: Final = "reproduce"
"""What the files say about who made them."""

QUICK: Final = {
    "learning.episodes": 4000,
    "selection.finalists": 4,
    "selection.final_trials": 100,
    "evaluation.trials": 50,
    "evaluation.duration": 20.0,
}
"""What a quick look cuts down, so that it takes less than a minute."""


class Progress(NamedTuple):
    """Where a reproduction stands."""

    stage: str
    """What is being done."""
    share: float
    """How much of it is done, 0 to 1."""
    text: str = ""
    """What can be told about it."""


class Reproduction(NamedTuple):
    """What `reproduce` hands back; all of it is also in its folder."""

    out: Path
    """The folder."""
    results: Results
    """The values."""
    verdict: tuple[str, str, str, str, str]
    """What came out, in five lines."""
    next_command: str
    """What to try next."""


def reproduce(
    out: Path,
    *,
    swing: Trajectory | None = None,
    arm: Arm | None = None,
    settings: Settings | None = None,
    recipe: str = "robust",
    seed: int = 0,
    quick: bool = False,
    workers: int | None = None,
    report: Callable[[Progress], None] = lambda _: None,
) -> Reproduction:
    """Run the paper from the swing to the deployment run, and save every value.

    Args:
        out: Folder for the files; it is made if it is missing.
        swing: A recorded free swing, e.g. from `read_swing`; one is simulated if not given.
        arm: The arm with its home posture; an iiwa 7 if not given.
        settings: Resolved settings; those of the recipe if not given.
        recipe: Name of the settings.
        seed: Master seed.
        quick: Fewer episodes and trials (`QUICK`).
        workers: Threads; all cores if not given. The results do not depend on it.
        report: Called as the work goes on, also from other threads.

    Returns:
        The values, five lines of verdict, and the next command.

    Raises:
        RecordingError: The swing identifies nothing.
        OutsideError: The disk refuses.
    """
    settings = resolve(recipe) if settings is None else settings
    settings = shortened(settings) if quick else settings
    workers = available_cores() if workers is None else workers
    stages: list[Stage] = []

    def stage(name: str, work: Callable[[], T]) -> T:
        report(Progress(name, 0.0))
        begin = time.perf_counter()
        value = work()
        stages.append(Stage(name=name, wall=round(time.perf_counter() - begin, 2)))
        report(Progress(name, 1.0))
        return value

    def save(value: Artefact | RunLog, name: str, **inputs: str) -> None:
        value.save(out / name, command=COMMAND, inputs=inputs)

    simulated = SimulatedSwing() if swing is None else None
    given = stage("swing", lambda: swing or simulated_swing(simulated or SimulatedSwing(), seed))
    write_swing(out / SWING, given)
    # The file in the folder is what is identified, so that the fit can be drawn over it.
    saved = replace(read_swing(out / SWING), source=given.source, released=given.released)
    pendulum = stage("identify", lambda: identify(saved, settings.identification))
    save(pendulum, PENDULUM, swing=saved.sha256)

    policy = stage(
        "train",
        lambda: train(
            pendulum,
            iiwa(7) if arm is None else arm,
            settings,
            seed=seed,
            recipe=recipe,
            workers=workers,
            report=_learning(settings, report),
        ),
    )
    save(policy, POLICY, pendulum=pendulum.digest)
    evaluation = stage(
        "evaluate",
        lambda: evaluate(policy, seed=seed, workers=workers, done=_trials(settings, report)),
    )
    save(evaluation, EVALUATION, policy=policy.digest)
    run = stage("deploy", lambda: deploy(policy, seed=seed))
    save(run, RUN, policy=policy.digest)

    record = Record(
        quick=quick,
        recipe=recipe,
        seed=seed,
        workers=workers,
        swing=given.source,
        swing_sha256=given.sha256,
        simulated=simulated,
        files={},
        stages=tuple(stages),
    )
    results = Results(record, saved, pendulum, policy, evaluation, run)
    record = record.model_copy(update={"files": dict(digests(results))})
    save(record, RECORD, **record.files)
    results = results._replace(record=record)
    return Reproduction(
        out=out,
        results=results,
        verdict=verdict(results),
        next_command=_next_command(out, quick=quick),
    )


def shortened(settings: Settings) -> Settings:
    """Return settings for a quick look: `QUICK`, where that is less."""
    tree = settings.model_dump()
    for name, value in QUICK.items():
        section, _, key = name.partition(".")
        tree[section][key] = min(tree[section][key], value)
    return Settings.model_validate(tree)


def _learning(
    settings: Settings, report: Callable[[Progress], None]
) -> Callable[[LearningPoint], None]:
    begin = time.perf_counter()

    def tell(point: LearningPoint) -> None:
        speed = point.steps / max(time.perf_counter() - begin, 1e-6)
        text = f"{point.episodes:,} episodes, {speed:,.0f} steps/s"
        if point.survival is not None:
            text += f", {100.0 * point.survival:.0f} % of the trials last"
        report(Progress("train", point.episodes / settings.learning.episodes, text))

    return tell


def _trials(settings: Settings, report: Callable[[Progress], None]) -> Callable[[int], None]:
    # The policy and four yardsticks run the same trials; they report from their own threads.
    total, lock, so_far = 5 * settings.evaluation.trials, Lock(), [0]

    def tell(finished: int) -> None:
        with lock:
            so_far[0] += finished
            report(Progress("evaluate", min(so_far[0] / total, 1.0), f"{so_far[0]} trials"))

    return tell


def _next_command(out: Path, *, quick: bool) -> str:
    if quick:
        return "equipoise reproduce"
    return f"equipoise evaluate {out / POLICY} --trials 1000"
