"""Results of a reproduction in its folder, and their verdict.

The report uses these files only::

    swing.csv  pendulum.json  policy.json  evaluation.json  run.mcap  gap.json  reproduction.json

`gap.json` is missing for an arm without a digital twin, and for a policy without cures.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Final, NamedTuple

import numpy as np
from pydantic import Field

from equipoise import paper
from equipoise.artefacts import Artefact, Count, Name, Number, Seed, Value, read_document
from equipoise.control.policy import TabularPolicy
from equipoise.errors import ArtefactError
from equipoise.logs.run_log import RunLog, TruthColumns
from equipoise.model.pendulum import Pendulum
from equipoise.model.worlds import MODEL
from equipoise.outcomes import Outcome
from equipoise.studies.gap_results import (
    CURED,
    NO_BIAS,
    NO_PREDICTION,
    PAPER,
    Controller,
    Gap,
    at_world,
    mean,
)
from equipoise.studies.synthetic_swing import SyntheticSwing
from equipoise.trajectory import Trajectory, read_swing
from equipoise.worlds.evaluation import Evaluation
from equipoise.worlds.formatting import format_end, format_failures, percent, plus_minus

SWING: Final = "swing.csv"
PENDULUM: Final = "pendulum.json"
POLICY: Final = "policy.json"
EVALUATION: Final = "evaluation.json"
RUN: Final = "run.mcap"
GAP: Final = "gap.json"
RECORD: Final = "reproduction.json"


class PipelineStage(Value):
    """A stage of the reproduction."""

    name: Name
    """Name of the stage."""
    wall: Number
    """Duration [s], including the compilation in a first run."""


class StageRecord(Artefact):
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

    record: StageRecord
    """Record of the reproduction."""
    swing: Trajectory
    """The free swing."""
    pendulum: Pendulum
    """The identified pendulum."""
    policy: TabularPolicy
    """The trained policy."""
    evaluation: Evaluation
    """Trials of the policy and of the baselines."""
    run: RunLog
    """One run of the policy, on the digital twin if the arm has one."""
    gap: Gap | None
    """Study of the gap for the policy and the paper's; None without one."""


def load(out: Path) -> Results:
    """Read the results of a reproduction.

    Raises:
        ArtefactError: A file is missing, corrupt, or belongs to another reproduction.
        RecordingError: The swing cannot be read.
    """
    record = StageRecord.load(out / RECORD)
    results = Results(
        record=record,
        swing=read_swing(out / SWING),
        pendulum=Pendulum.load(out / PENDULUM),
        policy=TabularPolicy.load(out / POLICY),
        evaluation=Evaluation.load(out / EVALUATION),
        run=RunLog.load(out / RUN),
        gap=Gap.load(out / GAP) if GAP in record.files else None,
    )
    for name, recorded in record.files.items():
        if _stated_digest(out / name, results) != recorded:
            raise ArtefactError(
                f"{out / name} is not the file that {out / RECORD} records; "
                "reproduce again, into an empty folder"
            )
    return results


def _stated_digest(path: Path, results: Results) -> str:
    """Return the digest that a file states."""
    if path.suffix == ".json":
        return read_document(path)["digest"]
    return results.run.digest if path.suffix == ".mcap" else results.swing.sha256


def digests(results: Results) -> Mapping[str, str]:
    """Return the digest of each value, by the name of its file."""
    _, swing, *values = results
    named = zip((PENDULUM, POLICY, EVALUATION, RUN, GAP), values, strict=True)
    return {SWING: swing.sha256} | {
        name: value.digest for name, value in named if value is not None
    }


def verdict(results: Results) -> tuple[str, str, str, str, str]:
    """Return the results in five sentences."""
    evaluation, run = _survival(results.evaluation), _run(results.run)
    return evaluation, run, _gap(results), _swing(results), _caveat(results)


def no_gap(results: Results) -> str:
    """Return the reason for a missing study of the gap."""
    if results.run.conditions.world == MODEL:
        return (
            f"There is no digital twin of the {results.policy.arm.name}, whose masses are not "
            "known: the run is on the training plant, and the gap to a robot was not studied."
        )
    return (
        "The gap to the twin was not studied: the study leaves the cures out one by one, and this "
        "policy, trained without sensor and delay, has none."
    )


def truth(run: RunLog) -> TruthColumns | RunLog:
    """Return the true state if the log has it, else the observations and commands."""
    return run.truth if len(run.truth.phi) else run


def observation_differs(run: RunLog) -> bool:
    """Return whether the observation differs from the true state in a simulated run."""
    return not np.array_equal(truth(run).phi, run.phi)


def estimates_zero(run: RunLog) -> bool:
    """Return whether the observer estimated the encoder's zero during the run."""
    conditions = run.conditions
    encoder = conditions.counts_per_rev is not None or conditions.zero_error is not None
    return encoder and conditions.settings.controller.estimate_bias


def _survival(evaluation: Evaluation) -> str:
    summary = evaluation.results.summary()
    low, high = summary.interval
    median = "" if summary.rate > 0.5 else f"; median {summary.median:.3g} s"
    others = (f"{each.name} {percent(each.summary().rate)}" for each in evaluation.baselines)
    return (
        f"On the plant of its training the table stood {evaluation.duration:g} s in "
        f"{summary.survived} of {summary.trials} trials ({percent(summary.rate)}; 95 % interval "
        f"{percent(low)} to {percent(high)}{median}), {format_failures(summary.outcomes)}; "
        f"baselines on the same trials: {'; '.join(others)}."
    )


def _run(run: RunLog) -> str:
    shown, conditions = truth(run), run.conditions
    phi, x = np.rad2deg(np.max(np.abs(shown.phi))), np.max(np.abs(shown.x))
    where, end = f"On the digital twin {conditions.world}", f"stood all {run.lasted:g} s"
    if conditions.world == MODEL:
        where = "On the plant of its training once more"
    if run.outcome != Outcome.LASTED:
        end = f"{format_end(run.outcome)} after {run.lasted:.3g} s of {conditions.duration:g} s"
    return (
        f"{where}, with a pendulum and a start that it did not know, it {end}, with |x| up to "
        f"{x:.2f} of {paper.X_LIMIT:g} m and |phi| up to {phi:.1f} of {paper.PHI_LIMIT_DEG:g} deg; "
        f"the paper's run on the real arm stood {paper.SECONDS_BALANCED:g} s."
    )


def _gap(results: Results) -> str:
    gap = results.gap
    if gap is None:
        return no_gap(results)

    def stands(controller: Controller) -> str:
        return f"{mean(at_world(gap, controller), gap.duration).mean:.1f} s"

    return (
        f"In {gap.trials} trials of {gap.duration:g} s on that twin it stood {stands(CURED)} on "
        f"average, {stands(NO_PREDICTION)} without its prediction, {stands(NO_BIAS)} without its "
        "estimate of the encoder's zero; a table that was trained as the paper describes stood "
        f"{stands(PAPER)}."
    )


def _swing(results: Results) -> str:
    pendulum, fit = results.pendulum, results.pendulum.fit
    w2, c = (plus_minus(part.value, part.interval) for part in (pendulum.w2, pendulum.c))
    origin = "simulated" if results.record.simulated else "recorded"
    text = f"The {origin} free swing has a period of {pendulum.period:.4g} s"
    text += f" (w2 = {w2} 1/s^2, c = {c} 1/s)"
    if fit is not None:
        unit = "deg" if fit.quantity == "angle" else "deg/s"
        text += f", the fit leaves {fit.rms_deg:.2g} {unit} RMS"
        if fit.warnings:
            text += f", with {len(fit.warnings)} warning{'s' * (len(fit.warnings) > 1)}"
    return f"{text}."


def _caveat(results: Results) -> str:
    text = "Quick reproduction, with fewer episodes and trials. " if results.record.quick else ""
    if results.run.conditions.world == MODEL:
        return (
            f"{text}All results are from simulation, on our model of an arm; none is from a robot."
        )
    return (
        f"{text}All results are from simulation. The twin models the known delay, servo, weight "
        "and sensor, with assumptions for the rest; it is not the authors' robot."
    )
