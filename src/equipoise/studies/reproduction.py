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
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, Final, NamedTuple, TypeVar

from equipoise.artefacts import Artefact, StrPath, Value, partial_path, value_digest
from equipoise.control.policy import TabularPolicy
from equipoise.deployment import deploy
from equipoise.errors import ArmError, ArtefactError
from equipoise.evaluation import Evaluation, evaluate
from equipoise.identification import identify
from equipoise.logs.run_log import RunLog
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.arms.inertials import link_inertials
from equipoise.model.pendulum import Pendulum
from equipoise.model.sim_configs import MODEL
from equipoise.settings import Settings
from equipoise.simulation import available_cores
from equipoise.studies.compilation import (
    FUNCTIONS,
    TWIN_FUNCTIONS,
    compile_training,
    compile_trials,
    compiling,
    compiling_beside,
)
from equipoise.studies.gap import gap, paper_settings, train_paper, trials_of
from equipoise.studies.gap_results import Gap
from equipoise.studies.progress import ProgressReporter, Show, TrainingProgress, counted
from equipoise.studies.results import (
    EVALUATION,
    GAP,
    PENDULUM,
    POLICY,
    RECORD,
    RUN,
    SWING,
    PipelineStage,
    Results,
    StageRecord,
    digests,
    verdict,
)
from equipoise.studies.synthetic_swing import SyntheticSwing, synthetic_swing
from equipoise.training import LEARNERS, software, train_several
from equipoise.trajectory import Trajectory, read_swing, write_swing

T = TypeVar("T")
S = TypeVar("S", Pendulum, TabularPolicy, Evaluation, RunLog, Gap)

PAPER_POLICY: Final = "paper-policy.json"
"""Name of the table that the study of the gap trains; only its checkpoints are written."""

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


SWING_TAKES: Final = 1.0
IDENTIFY_TAKES: Final = 2.0
DEPLOY_TAKES: Final = 2.0
"""Expected duration of stages that do not tell how far they are, on two cores [s]."""


class Finished(Value):
    """A file of a reproduction that is not finished."""

    digest: str
    """Digest of its value."""
    inputs: dict[str, str]
    """Digest of each value it was made from, by name."""
    wall: float
    """How long it took [s]."""


class UnfinishedReproduction(Artefact):
    """The stages of a reproduction that are done, while others are not."""

    FORMAT: ClassVar[str] = "equipoise-unfinished-reproduction"
    VERSION: ClassVar[int] = 1

    deciding: dict[str, str]
    """What decides about the results, by its name."""
    finished: dict[str, Finished]
    """Files that are done, by name."""


class ReproductionRequest(NamedTuple):
    """What decides about the results of a reproduction."""

    swing: Trajectory | None
    """A recorded free swing; one is simulated where none is given."""
    arm: Arm
    """The arm with its home posture."""
    settings: Settings
    """Resolved settings."""
    seed: int
    """Master seed."""
    quick: bool
    """Whether a quick look is enough."""

    @property
    def deciding(self) -> dict[str, str]:
        """All of it by name, values as digests."""
        return {
            "swing": "" if self.swing is None else self.swing.sha256,
            "arm": self.arm.digest,
            "settings": value_digest(self.settings),
            "seed": str(self.seed),
            "--quick": str(self.quick),
            "version of Equipoise or its libraries": software(),
        }


def unfinished_path(out: Path) -> Path:
    """Return the path of the file that says what of a reproduction is done."""
    return partial_path(out / RECORD)


def differences(out: Path, request: ReproductionRequest) -> list[str] | None:
    """Compare a request with the interrupted reproduction in a folder.

    Returns:
        What differs, by name; none if there is no interrupted reproduction.

    Raises:
        ArtefactError: The file that says what is done is damaged.
    """
    path = unfinished_path(out)
    if not path.exists():
        return None
    found = UnfinishedReproduction.load(path).deciding
    return [name for name, value in request.deciding.items() if found.get(name) != value]


def discard(out: Path) -> None:
    """Remove what an interrupted reproduction left in order to go on."""
    for name in (POLICY, PAPER_POLICY, RECORD):
        partial_path(out / name).unlink(missing_ok=True)


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
    seed: int = 0,
    quick: bool = False,
    workers: int | None = None,
    report: Show = lambda _: None,
    finish: Callable[[Path], None] = lambda _: None,
) -> Reproduction:
    """Run the paper from the swing to a run on the digital twin, and save every value.

    An interrupted reproduction goes on in its folder: stages that are done are read, and a training
    continues from its checkpoint.

    Args:
        out: Folder for the files; it is made if it is missing.
        swing: A recorded free swing, e.g. from `read_swing`; one is simulated if not given.
        arm: The arm with its home posture; an iiwa 7 if not given.
        settings: Resolved settings; the defaults if not given.
        seed: Master seed.
        quick: Fewer episodes and trials (`QUICK`).
        workers: Threads; all cores if not given. The results do not depend on it.
        report: Called as the work goes on, also from other threads.
        finish: Called with the folder when its values are complete; only after it the
            reproduction counts as finished.

    Returns:
        The values, five lines of verdict, and the next command.

    Raises:
        ArtefactError: An interrupted reproduction with another request lies in the folder.
        RecordingError: The swing identifies nothing.
        OutsideError: The disk refuses.
    """
    out = Path(out)
    request = make_request(swing=swing, arm=arm, settings=settings, seed=seed, quick=quick)
    arm, settings = request.arm, request.settings
    workers = available_cores() if workers is None else workers
    if other := differences(out, request):
        raise ArtefactError(
            f"{out} holds an interrupted reproduction with another {' and '.join(other)}; go on "
            "with what it began with, or give another folder"
        )
    finished: dict[str, Finished] = {}
    if unfinished_path(out).exists():
        finished |= UnfinishedReproduction.load(unfinished_path(out)).finished
    stages: list[PipelineStage] = []

    def stage(name: str, work: Callable[[], T], expected: float | None = None) -> T:
        report(ProgressReporter(name, expected=expected))
        begin = time.perf_counter()
        value = work()
        stages.append(PipelineStage(name=name, wall=round(time.perf_counter() - begin, 2)))
        report(ProgressReporter(name, 1.0))
        return value

    def saved(
        name: str,
        file: str,
        kind: type[S],
        work: Callable[[], S],
        expected: float | None = None,
        **inputs: str,
    ) -> S:
        """Run a stage and save its value, or read it if it was done before an interruption."""
        if (value := _done_before(out / file, kind, finished.get(file), inputs)) is not None:
            stages.append(PipelineStage(name=name, wall=finished[file].wall))
            report(ProgressReporter(name, 1.0, text="done before the interruption"))
            return value
        value = stage(name, work, expected)
        value.save(out / file, command=COMMAND, inputs=inputs)
        finished[file] = Finished(digest=value.digest, inputs=inputs, wall=stages[-1].wall)
        so_far = UnfinishedReproduction(deciding=request.deciding, finished=finished)
        so_far.save(unfinished_path(out), command=COMMAND)
        return value

    simulated = SyntheticSwing() if swing is None else None
    given = stage(
        "swing",
        lambda: swing or synthetic_swing(simulated or SyntheticSwing(), seed),
        SWING_TAKES,
    )
    write_swing(out / SWING, given)
    # The file in the folder is what is identified, so that the fit can be drawn over it.
    recorded = replace(read_swing(out / SWING), source=given.source, released=given.released)
    pendulum = saved(
        "identify",
        PENDULUM,
        Pendulum,
        lambda: identify(recorded, settings.identification),
        IDENTIFY_TAKES,
        swing=recorded.sha256,
    )
    # Where nothing is selected, there is nothing to select the best of several by.
    learners = 1 if quick or settings.selection.every == 0 else LEARNERS

    def learn() -> TabularPolicy:
        progress = TrainingProgress(settings, learners, report)
        return train_several(
            pendulum,
            arm,
            settings,
            learners=learners,
            seed=seed,
            workers=workers,
            partial=partial_path(out / POLICY),
            report=progress.report,
            selecting=progress.selecting,
        )[0]

    if POLICY not in finished:
        with compiling(report, FUNCTIONS):
            compile_training(arm, settings)
    policy = saved("train", POLICY, TabularPolicy, learn, pendulum=pendulum.digest)
    # The policy and four yardsticks run the same trials.
    tested = counted("evaluate", 5 * settings.evaluation.trials, report)
    evaluation = saved(
        "evaluate",
        EVALUATION,
        Evaluation,
        lambda: evaluate(policy, seed=seed, workers=workers, done=tested),
        policy=policy.digest,
    )
    world = TWIN if _has_twin(arm) else MODEL
    if world == TWIN and not {RUN, GAP} <= finished.keys():
        with compiling(report, TWIN_FUNCTIONS, "compile twin"):
            compile_trials(policy, world)
    run = saved(
        "deploy",
        RUN,
        RunLog,
        lambda: deploy(policy, world=world, seed=seed),
        DEPLOY_TAKES,
        policy=policy.digest,
    )
    study = None
    if world == TWIN and policy.actuator.kind != "ideal":
        study = saved(
            "gap",
            GAP,
            Gap,
            lambda: _short_gap(out, policy, seed, workers, quick, report),
            policy=policy.digest,
        )

    record = StageRecord(
        quick=quick,
        seed=seed,
        workers=workers,
        swing=given.source,
        swing_sha256=given.sha256,
        simulated=simulated,
        files={},
        stages=tuple(stages),
    )
    results = Results(record, recorded, pendulum, policy, evaluation, run, study)
    record = record.model_copy(update={"files": dict(digests(results))})
    record.save(out / RECORD, command=COMMAND, inputs=record.files)
    results = results._replace(record=record)
    finish(out)
    discard(out)
    return Reproduction(
        out=out,
        results=results,
        verdict=verdict(results),
        next_command=_next_command(out / POLICY, results),
    )


def make_request(
    *,
    swing: Trajectory | None,
    arm: Arm | None,
    settings: Settings | None,
    seed: int,
    quick: bool,
) -> ReproductionRequest:
    """Return what decides about a reproduction, the defaults filled in; as in `reproduce`."""
    settings = Settings() if settings is None else settings
    return ReproductionRequest(
        swing=swing,
        arm=iiwa(7) if arm is None else arm,
        settings=shortened(settings) if quick else settings,
        seed=seed,
        quick=quick,
    )


def _done_before(
    path: Path, kind: type[S], finished: Finished | None, inputs: Mapping[str, str]
) -> S | None:
    """Read a file that an interrupted reproduction finished; none if it has to be made."""
    if finished is None or finished.inputs != inputs:
        return None
    try:
        value = kind.load(path)
    except ArtefactError:  # it was deleted or damaged since
        return None
    return value if value.digest == finished.digest else None


def shortened(settings: Settings) -> Settings:
    """Return settings for a quick look: `QUICK`, where that is less."""
    tree = settings.model_dump()
    for name, value in QUICK.items():
        section, _, key = name.partition(".")
        tree[section][key] = min(tree[section][key], value)
    return Settings.model_validate(tree)


def _has_twin(arm: Arm) -> bool:
    try:
        link_inertials(arm)
    except ArmError:
        return False
    return True


def _short_gap(
    out: Path,
    policy: TabularPolicy,
    seed: int,
    workers: int,
    quick: bool,
    report: Show,
) -> Gap:
    trials, duration = QUICK_GAP if quick else (None, None)
    total = trials_of(TWIN, quick=True, trials=trials)
    progress = TrainingProgress(paper_settings(quick=True), 1, report, "paper")
    paper_policy = train_paper(
        policy,
        quick=True,
        seed=seed,
        workers=workers,
        partial=partial_path(out / PAPER_POLICY),
        report=lambda point: progress.report(0, point),
        selecting=lambda done, of: progress.selecting(0, done, of),
    )
    return gap(
        policy,
        world=TWIN,
        paper_policy=paper_policy,
        trials=trials,
        duration=duration,
        quick=True,
        seed=seed,
        workers=workers,
        done=counted("gap", total, report),
    )


def _next_command(policy: Path, results: Results) -> str:
    if results.record.quick:
        return "equipoise reproduce"
    if results.gap is None:
        return f"equipoise evaluate {policy} --trials 1000"
    return f"equipoise gap {policy}"
