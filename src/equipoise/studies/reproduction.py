"""Reproduction of the paper: swing, identification, training, evaluation, run, and gap study.

The policy is trained and evaluated on the training plant, with an actuator that was identified on
the digital twin. Then it runs on the twin, as the paper's policy did on the robot, and a short
study of the gap compares it there with a table like the paper's. An arm with unknown masses has no
twin: its run is on the model.

Each stage takes the previous value and saves its own, so that any stage can be repeated from its
files. `equipoise.apps.report.page.build` makes the page from the folder.
"""

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Final, NamedTuple, TypeVar

from equipoise.artefacts import Artefact, Provenance, StrPath, Value, partial_path, value_digest
from equipoise.control.policy import TabularPolicy
from equipoise.errors import ArmError, ArtefactError
from equipoise.executors import available_cores
from equipoise.identification import identify
from equipoise.jit import kernel_sources_digest
from equipoise.learning.target import LEARNERS, TARGET, train_to_target
from equipoise.logs.run_log import RunLog
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.arms.inertials import link_inertials
from equipoise.model.pendulum import Pendulum
from equipoise.model.worlds import MODEL
from equipoise.rig.simulate import simulate_run
from equipoise.settings import Settings
from equipoise.studies.compilation import (
    FUNCTIONS,
    TWIN_FUNCTIONS,
    compile_training,
    compile_trials,
    compiling,
    compiling_in_parallel,
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
from equipoise.trajectory import Trajectory, read_swing, write_swing
from equipoise.worlds.evaluation import Evaluation, evaluate

T = TypeVar("T")
S = TypeVar("S", Pendulum, TabularPolicy, Evaluation, RunLog, Gap)

PAPER_POLICY: Final = "paper-policy.json"
"""File name of the gap study's table; only its checkpoints are written."""

COMMAND: Final = "reproduce"
"""Command in the files' provenance."""

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

TWIN: Final = "twin:nominal"
"""World of the run."""
QUICK_GAP: Final = (4, 10.0)
"""Trials of each point and their length [s] in the gap study of a quick reproduction."""


SWING_TIME: Final = 1.0
IDENTIFY_TIME: Final = 2.0
DEPLOY_TIME: Final = 2.0
"""Expected duration of stages without intermediate progress, on two cores [s]."""


class Finished(Value):
    """Finished file of an unfinished reproduction."""

    digest: str
    """Digest of its value."""
    inputs: dict[str, str]
    """Digest of each input, by name."""
    wall: float
    """Duration of its stage [s]."""


class UnfinishedReproduction(Artefact):
    """Finished stages of an unfinished reproduction."""

    FORMAT: ClassVar[str] = "equipoise-unfinished-reproduction"
    VERSION: ClassVar[int] = 1

    deciding: dict[str, str]
    """Parameters of the results, by name."""
    finished: dict[str, Finished]
    """Finished files, by name."""


class ReproductionRequest(NamedTuple):
    """Parameters of a reproduction's results."""

    swing: Trajectory | None
    """A recorded free swing; None for a simulated one."""
    arm: Arm
    """The arm with its home posture."""
    settings: Settings
    """Resolved settings."""
    seed: int
    """Master seed."""
    quick: bool
    """Whether the reproduction runs with fewer episodes and trials."""

    @property
    def deciding(self) -> dict[str, str]:
        """All parameters by name, values as digests."""
        return {
            "swing": "" if self.swing is None else self.swing.sha256,
            "arm": self.arm.digest,
            "settings": value_digest(self.settings),
            "seed": str(self.seed),
            "--quick": str(self.quick),
            "version of Equipoise or its libraries": software(),
        }


def software() -> str:
    """Return the versions and the digest of kernels, which identify software with equal bits."""
    return json.dumps(Provenance.now("", None).software) + kernel_sources_digest()


def unfinished_path(out: Path) -> Path:
    """Return the path of the record of an unfinished reproduction."""
    return partial_path(out / RECORD)


def differences(out: Path, request: ReproductionRequest) -> list[str] | None:
    """Compare a request with the interrupted reproduction in a folder.

    Returns:
        Names of the parameters that differ; None without an interrupted reproduction.

    Raises:
        ArtefactError: The record of the interrupted reproduction is damaged.
    """
    path = unfinished_path(out)
    if not path.exists():
        return None
    found = UnfinishedReproduction.load(path).deciding
    return [name for name, value in request.deciding.items() if found.get(name) != value]


def discard(out: Path) -> None:
    """Remove the record of an interrupted reproduction."""
    unfinished_path(out).unlink(missing_ok=True)


class Reproduction(NamedTuple):
    """Return value of `reproduce`; the folder holds the same."""

    out: Path
    """The folder."""
    results: Results
    """The results."""
    verdict: tuple[str, str, str, str, str]
    """The results in five sentences."""


@compiling_in_parallel()
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
    """Reproduce the paper from the swing to a run on the digital twin, and save every value.

    An interrupted reproduction continues in its folder: finished stages are read.

    Args:
        out: Folder of the files, created if missing.
        swing: A recorded free swing, e.g. from `read_swing` (default: a simulated one).
        arm: The arm with its home posture (default: an iiwa 7).
        settings: Resolved settings (default: `Settings()`).
        seed: Master seed.
        quick: Whether it runs with fewer episodes and trials (`QUICK`).
        workers: Number of threads (default: all cores); the results do not depend on it.
        report: Called with the progress, also from other threads.
        finish: Called with the folder of all values before the reproduction counts as finished.

    Raises:
        ArtefactError: The folder holds an interrupted reproduction with other parameters.
        RecordingError: The swing identifies no pendulum.
        OutsideError: A file cannot be written.
    """
    out = Path(out)
    request = make_request(swing, arm, settings, seed, quick)
    _, arm, settings, *_ = request
    workers = available_cores() if workers is None else workers
    if other := differences(out, request):
        raise ArtefactError(
            f"{out} holds an interrupted reproduction with another {' and '.join(other)}; continue "
            "with its parameters, or give another folder"
        )
    common: Any = {"seed": seed, "workers": workers}
    finished: dict[str, Finished] = {}
    if unfinished_path(out).exists():
        finished |= UnfinishedReproduction.load(unfinished_path(out)).finished
    stages: list[PipelineStage] = []

    def stage(name: str, work: Callable[[], T], expected: float = 0.0) -> T:
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
        expected: float = 0.0,
        **inputs: str,
    ) -> S:
        """Run a stage and save its value, or read the value of an interrupted reproduction."""
        if (value := _read_finished(out / file, kind, finished.get(file), inputs)) is not None:
            stages.append(PipelineStage(name=name, wall=finished[file].wall))
            report(ProgressReporter(name, 1.0, text="done before the interruption"))
            return value
        value = stage(name, work, expected)
        value.save(out / file, command=COMMAND, inputs=inputs)
        finished[file] = Finished(digest=value.digest, inputs=inputs, wall=stages[-1].wall)
        unfinished = UnfinishedReproduction(deciding=request.deciding, finished=finished)
        unfinished.save(unfinished_path(out), command=COMMAND)
        return value

    synthetic = SyntheticSwing()
    given = stage("swing", lambda: swing or synthetic_swing(synthetic, seed), SWING_TIME)
    write_swing(out / SWING, given)
    # The identification reads the file in the folder, so that a figure shows the same data.
    recorded = replace(read_swing(out / SWING), source=given.source, released=given.released)
    work = partial(identify, recorded, settings.identification)
    pendulum = saved("identify", PENDULUM, Pendulum, work, IDENTIFY_TIME, swing=recorded.sha256)

    def learn() -> TabularPolicy:
        # Without a selection, or with few episodes, the first learner is taken as it is.
        wanted: Any = {"target": 0.0, "learners": 1}
        if not quick and settings.selection.every > 0:
            wanted = {"target": TARGET, "learners": LEARNERS}
        progress = TrainingProgress(settings, report, wanted["learners"])
        policy = train_to_target(
            pendulum, arm, settings, **wanted, observer=progress, **common
        ).policy
        progress.ended()
        return policy

    if POLICY not in finished:
        with compiling(report, FUNCTIONS):
            compile_training(arm, settings)
    policy = saved("train", POLICY, TabularPolicy, learn, pendulum=pendulum.digest)
    # The policy and four baselines run the same trials.
    tested = counted("evaluate", 5 * settings.evaluation.trials, report)
    work = partial(evaluate, policy, done=tested, **common)
    evaluation = saved("evaluate", EVALUATION, Evaluation, work, policy=policy.digest)
    world = TWIN if _has_twin(arm) else MODEL
    if world == TWIN and not {RUN, GAP} <= finished.keys():
        with compiling(report, TWIN_FUNCTIONS, "compile twin"):
            compile_trials(policy, world)
    work = partial(simulate_run, policy, world=world, seed=seed)
    run = saved("deploy", RUN, RunLog, work, DEPLOY_TIME, policy=policy.digest)
    study = None

    def short_gap() -> Gap:
        trials, duration = QUICK_GAP if quick else (None, None)
        form: Any = {"world": TWIN, "quick": True, "trials": trials}
        observer = TrainingProgress(paper_settings(quick=True), report, of="paper")
        table = train_paper(policy, quick=True, observer=observer, **common)
        done = counted("gap", trials_of(**form), report)
        return gap(policy, paper_policy=table, duration=duration, done=done, **form, **common)

    if world == TWIN and policy.actuator.kind != "ideal":
        study = saved("gap", GAP, Gap, short_gap, policy=policy.digest)

    record = StageRecord(
        quick=quick,
        seed=seed,
        workers=workers,
        swing=given.source,
        swing_sha256=given.sha256,
        simulated=synthetic if swing is None else None,
        files={},
        stages=tuple(stages),
    )
    results = Results(record, recorded, pendulum, policy, evaluation, run, study)
    record = record.model_copy(update={"files": dict(digests(results))})
    record.save(out / RECORD, command=COMMAND, inputs=record.files)
    results = results._replace(record=record)
    finish(out)
    discard(out)
    return Reproduction(out, results, verdict(results))


def make_request(
    swing: Trajectory | None, arm: Arm | None, settings: Settings | None, seed: int, quick: bool
) -> ReproductionRequest:
    """Return the parameters of a reproduction with its defaults; see `reproduce`."""
    settings = settings or Settings()
    settings = shortened(settings) if quick else settings
    return ReproductionRequest(swing, arm or iiwa(7), settings, seed, quick)


def _read_finished(
    path: Path, kind: type[S], finished: Finished | None, inputs: Mapping[str, str]
) -> S | None:
    """Return the value of a finished file; None if its stage has to run."""
    if finished is None or finished.inputs != inputs:
        return None
    try:
        value = kind.load(path)
    except ArtefactError:  # deleted or damaged
        return None
    return value if value.digest == finished.digest else None


def shortened(settings: Settings) -> Settings:
    """Return the settings of a quick reproduction, limited by `QUICK`."""
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
