"""Results of a reproduction in its folder, and their verdict.

The report uses these files only::

    swing.csv  pendulum.json  policy.json  evaluation.json  twin-evaluation.json  run.mcap
    reproduction.json

`twin-evaluation.json` is missing for an arm without a digital twin.
"""

from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, NamedTuple

import numpy as np
from pydantic import Field

from equipoise import paper
from equipoise.artefacts import Artefact, Count, Name, Number, Seed, Value
from equipoise.control.policy import TabularPolicy
from equipoise.errors import ArtefactError
from equipoise.identification.recording import Trajectory, read_swing
from equipoise.logs.run_log import RunLog
from equipoise.model.pendulum import Pendulum
from equipoise.model.worlds import MODEL
from equipoise.outcomes import Outcome
from equipoise.reproduction.synthetic_swing import SyntheticSwing
from equipoise.worlds.evaluation import Evaluation
from equipoise.worlds.formatting import format_end, format_failures, percent, plus_minus

SWING: Final = "swing.csv"
PENDULUM: Final = "pendulum.json"
POLICY: Final = "policy.json"
EVALUATION: Final = "evaluation.json"
TWIN_EVALUATION: Final = "twin-evaluation.json"
RUN: Final = "run.mcap"
RECORD: Final = "reproduction.json"


class PipelineStage(Value):
    """A stage of the reproduction."""

    name: Name
    """Name of the stage."""
    wall: Number
    """Duration [s], including the compilation in a first run."""


class ReproductionRecord(Artefact):
    """Record of a reproduction: everything that its other files do not state."""

    FORMAT: ClassVar[str] = "equipoise-reproduction"
    VERSION: ClassVar[int] = 1

    quick: bool
    """Whether it ran with fewer episodes and trials."""
    seed: Seed
    """Master seed."""
    workers: Count
    """Number of threads; the results do not depend on it."""
    swing: Name
    """Name of the recording."""
    swing_sha256: Name
    """Digest of the given recording."""
    simulated: SyntheticSwing | None
    """Parameters of a simulated swing; None for a recording."""
    files: dict[Name, Name]
    """Digest of each value, by the name of its file."""
    stages: Annotated[tuple[PipelineStage, ...], Field(max_length=100)]
    """The stages with their durations."""


class Results(NamedTuple):
    """All results of a reproduction."""

    record: ReproductionRecord
    """Record of the reproduction."""
    swing: Trajectory
    """The free swing."""
    pendulum: Pendulum
    """The identified pendulum."""
    policy: TabularPolicy
    """The trained policy."""
    evaluation: Evaluation
    """Trials of the policy and of the baselines on the training plant."""
    twin_evaluation: Evaluation | None
    """Trials of the policy on the digital twin; None for an arm without a twin."""
    run: RunLog
    """One run of the policy, on the digital twin if the arm has one."""


def load(out: Path) -> Results:
    """Read the results of a reproduction.

    Raises:
        ArtefactError: A file is missing, corrupt, or belongs to another reproduction.
        RecordingError: The swing cannot be read.
    """
    record = ReproductionRecord.load(out / RECORD)
    has_twin = TWIN_EVALUATION in record.files
    results = Results(
        record=record,
        swing=read_swing(out / SWING),
        pendulum=Pendulum.load(out / PENDULUM),
        policy=TabularPolicy.load(out / POLICY),
        evaluation=Evaluation.load(out / EVALUATION),
        twin_evaluation=Evaluation.load(out / TWIN_EVALUATION) if has_twin else None,
        run=RunLog.load(out / RUN),
    )
    found = digests(results)
    for name, recorded in record.files.items():
        if found.get(name) != recorded:
            raise ArtefactError(
                f"{out / name} is not the file that {out / RECORD} records; "
                "reproduce again, into an empty folder"
            )
    return results


def digests(results: Results) -> dict[str, str]:
    """Return the digest of each value, by the name of its file."""
    found = {
        SWING: results.swing.sha256,
        PENDULUM: results.pendulum.digest,
        POLICY: results.policy.digest,
        EVALUATION: results.evaluation.digest,
        RUN: results.run.digest,
    }
    if results.twin_evaluation is not None:
        found[TWIN_EVALUATION] = results.twin_evaluation.digest
    return found


def truth(run: RunLog) -> Any:
    """Return the true state if the log has it, else the observations and commands."""
    return run.truth if len(run.truth.phi) else run


def verdict(results: Results) -> tuple[str, ...]:
    """Return the results in a few sentences."""
    on_twin = () if results.twin_evaluation is None else (_survival(results.twin_evaluation),)
    swing = _swing(results)
    return _survival(results.evaluation), *on_twin, _run(results.run), swing, _caveat(results)


def _survival(evaluation: Evaluation) -> str:
    summary = evaluation.results.summary()
    low, high = map(percent, summary.interval)
    where = "the plant of its training" if evaluation.world == MODEL else evaluation.world
    others = [f"{each.name} {percent(each.summary().rate)}" for each in evaluation.baselines]
    text = (
        f"On {where} the table stood {evaluation.duration:g} s in {summary.survived} of "
        f"{summary.trials} trials (95 % interval {low} to {high}), "
        f"{format_failures(summary.outcomes)}"
    )
    return f"{text}; baselines on the same trials: {', '.join(others)}." if others else f"{text}."


def _run(run: RunLog) -> str:
    shown, conditions = truth(run), run.conditions
    phi, x = np.rad2deg(np.max(np.abs(shown.phi))), np.max(np.abs(shown.x))
    end = f"stood all {run.lasted:g} s"
    if run.outcome != Outcome.LASTED:
        end = f"{format_end(run.outcome)} after {run.lasted:.3g} s of {conditions.duration:g} s"
    where = "plant of its training" if conditions.world == MODEL else f"twin {conditions.world}"
    return (
        f"The recorded run on the {where} {end}, with |x| up to {x:.2f} of {paper.X_LIMIT:g} m and "
        f"|phi| up to {phi:.1f} of {paper.PHI_LIMIT_DEG:g} deg; the paper's run on the real arm "
        f"stood {paper.SECONDS_BALANCED:g} s."
    )


def _swing(results: Results) -> str:
    pendulum, fit = results.pendulum, results.pendulum.fit
    w2, c = (plus_minus(part.value, part.interval) for part in (pendulum.w2, pendulum.c))
    origin = "simulated" if results.record.simulated else "recorded"
    text = f"The {origin} free swing has a period of {pendulum.period:.4g} s"
    text += f" (w2 = {w2} 1/s^2, c = {c} 1/s)"
    if fit is not None and fit.warnings:
        text += f", with {len(fit.warnings)} warning{'s' * (len(fit.warnings) > 1)}"
    return f"{text}."


def _caveat(results: Results) -> str:
    quick = "Quick reproduction, with fewer episodes and trials. " if results.record.quick else ""
    twin = " There is no twin of this arm, whose masses are not known."
    if results.twin_evaluation is not None:
        twin = " The twin has assumptions where the robot's numbers are unknown."
    return f"{quick}All results are from simulation, none is from a robot.{twin}"
