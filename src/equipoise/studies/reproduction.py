"""Reproduce the paper: swing, identification, training, evaluation, a run, and what the twin costs.

The policy learns on the plant of the training, whose arm follows as an identification on the
digital twin says; there it is evaluated. Then it runs on the twin, as the paper's did on the robot,
and a short study of the gap says what the twin does to it, and to a table like the paper's. An arm
whose masses are not known has no twin: there the run is one on the model.

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

from equipoise.artefacts import Artefact, StrPath
from equipoise.control.policy import LearningPoint, TabularPolicy
from equipoise.deployment import deploy
from equipoise.errors import ArmError
from equipoise.evaluation import evaluate
from equipoise.identification import identify
from equipoise.learning.trials import available_cores
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.arms.inertials import link_inertials
from equipoise.model.worlds import MODEL
from equipoise.runlog import RunLog
from equipoise.settings import Settings, resolve
from equipoise.studies.compilation import compiling_beside
from equipoise.studies.gap import gap, train_paper, trials_of
from equipoise.studies.gap_results import Gap
from equipoise.studies.results import (
    EVALUATION,
    GAP,
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
from equipoise.training import LEARNERS, train_several
from equipoise.trajectory import Trajectory, read_swing, write_swing

T = TypeVar("T")

COMMAND: Final = "reproduce"
"""What the files say about who made them."""

QUICK: Final = {
    "learning.episodes": 5000,
    "selection.screening_trials": 8,
    "selection.duration": 20.0,
    "selection.finalists": 3,
    "selection.final_trials": 64,
    "selection.final_duration": 30.0,
    "evaluation.trials": 50,
    "evaluation.duration": 20.0,
}
"""What a quick look cuts down, so that it takes less than a minute."""

TWIN: Final = "twin:nominal"
"""The world of the run."""
QUICK_GAP: Final = (4, 10.0)
"""Trials of each point and their length [s], to which a quick look cuts the short study of the gap
down."""


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


@compiling_beside()
def reproduce(
    out: StrPath,
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
    """Run the paper from the swing to a run on the digital twin, and save every value.

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
    out = Path(out)
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

    # Where nothing is selected, there is nothing to select the best of several by.
    learners = 1 if quick or settings.selection.every == 0 else LEARNERS
    policy = stage(
        "train",
        lambda: train_several(
            pendulum,
            iiwa(7) if arm is None else arm,
            settings,
            learners=learners,
            seed=seed,
            recipe=recipe,
            workers=workers,
            report=_learning(settings, learners, report),
        )[0],
    )
    save(policy, POLICY, pendulum=pendulum.digest)
    # The policy and four yardsticks run the same trials.
    tested = _counted("evaluate", 5 * settings.evaluation.trials, report)
    evaluation = stage(
        "evaluate",
        lambda: evaluate(policy, seed=seed, workers=workers, done=tested),
    )
    save(evaluation, EVALUATION, policy=policy.digest)
    world = TWIN if _has_twin(policy.arm) else MODEL
    run = stage("deploy", lambda: deploy(policy, world=world, seed=seed))
    save(run, RUN, policy=policy.digest)
    study = None
    if world == TWIN and policy.actuator.kind != "ideal":
        study = stage("gap", lambda: _short_gap(policy, seed, workers, quick, report))
        save(study, GAP, policy=policy.digest)

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
    results = Results(record, saved, pendulum, policy, evaluation, run, study)
    record = record.model_copy(update={"files": dict(digests(results))})
    save(record, RECORD, **record.files)
    results = results._replace(record=record)
    return Reproduction(
        out=out,
        results=results,
        verdict=verdict(results),
        next_command=_next_command(out / POLICY, results),
    )


def shortened(settings: Settings) -> Settings:
    """Return settings for a quick look: `QUICK`, where that is less."""
    tree = settings.model_dump()
    for name, value in QUICK.items():
        section, _, key = name.partition(".")
        tree[section][key] = min(tree[section][key], value)
    return Settings.model_validate(tree)


def _learning(
    settings: Settings, learners: int, report: Callable[[Progress], None]
) -> Callable[[int, LearningPoint], None]:
    begin, total = time.perf_counter(), learners * settings.learning.episodes
    points: dict[int, LearningPoint] = {}

    def tell(learner: int, point: LearningPoint) -> None:
        points[learner] = point
        newest = tuple(points.values())
        episodes = sum(p.episodes for p in newest)
        speed = sum(p.steps for p in newest) / max(time.perf_counter() - begin, 1e-6)
        text = f"{episodes:,} episodes, {speed:,.0f} steps/s"
        screened = [p.survival for p in newest if p.survival is not None]
        if screened:
            text += f", {100.0 * sum(screened) / len(screened):.0f} % of the trials last"
        report(Progress("train", episodes / total, text))

    return tell


def _has_twin(arm: Arm) -> bool:
    try:
        link_inertials(arm)
    except ArmError:
        return False
    return True


def _short_gap(
    policy: TabularPolicy,
    seed: int,
    workers: int,
    quick: bool,
    report: Callable[[Progress], None],
) -> Gap:
    trials, duration = QUICK_GAP if quick else (None, None)
    total = trials_of(TWIN, quick=True, trials=trials)
    return gap(
        policy,
        world=TWIN,
        paper_policy=train_paper(policy, quick=True, seed=seed, workers=workers),
        trials=trials,
        duration=duration,
        quick=True,
        seed=seed,
        workers=workers,
        done=_counted("gap", total, report),
    )


def _counted(stage: str, total: int, report: Callable[[Progress], None]) -> Callable[[int], None]:
    # Trials report from their own threads.
    lock, so_far = Lock(), [0]

    def tell(finished: int) -> None:
        with lock:
            so_far[0] += finished
            report(Progress(stage, min(so_far[0] / total, 1.0), f"{so_far[0]} trials"))

    return tell


def _next_command(policy: Path, results: Results) -> str:
    if results.record.quick:
        return "equipoise reproduce"
    if results.gap is None:
        return f"equipoise evaluate {policy} --trials 1000"
    return f"equipoise gap {policy}"
