"""What a reproduction leaves in its folder, read back as one value, and its verdict.

The report is drawn from these files alone::

    swing.csv  pendulum.json  policy.json  evaluation.json  run.mcap  reproduction.json
"""

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Final, NamedTuple

import numpy as np

from equipoise import paper
from equipoise.artefacts import Artefact, Value, read_document
from equipoise.control.policy import TabularPolicy
from equipoise.errors import ArtefactError
from equipoise.evaluation import Evaluation
from equipoise.learning.closed_loop import CAUSES
from equipoise.model.pendulum import Pendulum
from equipoise.runlog import RunLog
from equipoise.studies.stand_in import SimulatedSwing
from equipoise.trajectory import Trajectory, read_swing

SWING: Final = "swing.csv"
PENDULUM: Final = "pendulum.json"
POLICY: Final = "policy.json"
EVALUATION: Final = "evaluation.json"
RUN: Final = "run.mcap"
RECORD: Final = "reproduction.json"

LASTED: Final = CAUSES[0]
"""Cause of the end of a trial that did not fail."""


class Stage(Value):
    """A stage of the reproduction."""

    name: str
    """What was done."""
    wall: float
    """How long it took [s], compilation on its first run included."""


class Record(Artefact):
    """How a reproduction was made: all that its other files do not say."""

    FORMAT: ClassVar[str] = "equipoise-reproduction"
    VERSION: ClassVar[int] = 1

    quick: bool
    """Fewer episodes and trials than the paper's and ours."""
    recipe: str
    """Name of the settings."""
    seed: int
    """Master seed of everything."""
    workers: int
    """Threads; the results do not depend on it."""
    swing: str
    """Name of the recording."""
    swing_sha256: str
    """Digest of the recording as it was given."""
    simulated: SimulatedSwing | None
    """The pendulum that was simulated; none where a recording was given."""
    files: dict[str, str]
    """Digest of each value, by the name of its file."""
    stages: tuple[Stage, ...]
    """Where the time went."""


class Results(NamedTuple):
    """All that a reproduction found."""

    record: Record
    """How it was made."""
    swing: Trajectory
    """The free swing."""
    pendulum: Pendulum
    """What it identified."""
    policy: TabularPolicy
    """What was trained for that."""
    evaluation: Evaluation
    """How long the policy stands, beside the yardsticks."""
    run: RunLog
    """One run of it."""


def load(out: Path) -> Results:
    """Read the results of a reproduction.

    Raises:
        ArtefactError: A file is missing, corrupt, or belongs to another reproduction.
        RecordingError: The swing cannot be read.
    """
    results = Results(
        record=Record.load(out / RECORD),
        swing=read_swing(out / SWING),
        pendulum=Pendulum.load(out / PENDULUM),
        policy=TabularPolicy.load(out / POLICY),
        evaluation=Evaluation.load(out / EVALUATION),
        run=RunLog.load(out / RUN),
    )
    for name, recorded in results.record.files.items():
        # The digest that a file states is that of what was written, whatever was upgraded since.
        path = out / name
        stated = read_document(path)["digest"] if path.suffix == ".json" else digests(results)[name]
        if stated != recorded:
            raise ArtefactError(
                f"{out / name} is not the one that {out / RECORD} was written for; "
                "reproduce again, into an empty folder"
            )
    return results


def digests(results: Results) -> Mapping[str, str]:
    """Return the digest of each value, by the name of its file."""
    return {
        SWING: results.swing.sha256,
        PENDULUM: results.pendulum.digest,
        POLICY: results.policy.digest,
        EVALUATION: results.evaluation.digest,
        RUN: results.run.digest,
    }


def verdict(results: Results) -> tuple[str, str, str, str, str]:
    """Return what came out, in five lines that need no figure."""
    return (
        _standing(results),
        _yardsticks(results.evaluation),
        _run(results.run),
        _swing(results),
        _caveat(results),
    )


def _standing(results: Results) -> str:
    evaluation = results.evaluation
    summary = evaluation.results.summary()
    low, high = summary.interval
    median = "" if summary.rate > 0.5 else f"; median {summary.median:.3g} s"
    return (
        f"The trained table stood {evaluation.duration:g} s in {summary.survived} of "
        f"{summary.trials} simulated trials ({percent(summary.rate)}; 95 % interval {percent(low)} "
        f"to {percent(high)}{median}), {falls(summary.causes)}; the paper's stood "
        f"{paper.SECONDS_BALANCED:g} s on the real arm, once."
    )


def _yardsticks(evaluation: Evaluation) -> str:
    summaries = {results.name: results.summary() for results in evaluation.yardsticks}
    shares = ", ".join(
        f"{name} {percent(summary.rate)} (median {summary.median:.3g} s)"
        for name, summary in summaries.items()
    )
    return f"The yardsticks lasted on the same trials: {shares}."


def _run(run: RunLog) -> str:
    phi = float(np.max(np.abs(np.rad2deg(run.phi))))
    x = float(np.max(np.abs(run.x)))
    end = (
        f"stood all {run.lasted:g} s"
        if run.conditions.cause == LASTED
        else f"{how_it_ended(run.conditions.cause)} after {run.lasted:.3g} s of "
        f"{run.conditions.duration:g} s"
    )
    return (
        f"The deployment run, with I, b, noise and start unknown to the policy, {end}; it used "
        f"|x| up to {x:.2f} of {paper.X_LIMIT:g} m and |phi| up to {phi:.1f} of "
        f"{paper.PHI_LIMIT_DEG:g} deg."
    )


def _swing(results: Results) -> str:
    pendulum, fit = results.pendulum, results.pendulum.fit
    w2, c = (plus_minus(part.value, part.interval) for part in (pendulum.w2, pendulum.c))
    parts = [
        f"The {'simulated' if results.record.simulated else 'recorded'} free swing has a period of "
        f"{pendulum.period:.4g} s (w2 = {w2} 1/s^2, c = {c} 1/s)"
    ]
    if fit is not None:
        unit = "deg" if fit.quantity == "angle" else "deg/s"
        parts.append(f"the fit leaves {fit.rms_deg:.2g} {unit} RMS")
        if fit.warnings:
            parts.append(f"with {len(fit.warnings)} warning{'s' * (len(fit.warnings) > 1)}")
    return ", ".join(parts) + "."


def _caveat(results: Results) -> str:
    quick = "A quick look, with fewer episodes and trials. " if results.record.quick else ""
    return (
        f"{quick}All of this is simulation: the training plant, with parameters, noise and start "
        "that the policy does not know, but no delay, no play and no sensor; neither a robot nor a "
        "digital twin of one, which does not exist yet."
    )


def how_it_ended(cause: str) -> str:
    """Return how a trial or a run ended, in words."""
    return {
        LASTED: "stood to the end",
        "angle": "fell over",
        "track": "left the track",
        "joint limit": "met a joint limit",
    }.get(cause, cause)


def falls(causes: Mapping[str, int]) -> str:
    """Return how many trials failed in which way, in words."""
    failed = [f"{n} {how_it_ended(cause)}" for cause, n in causes.items() if cause != LASTED]
    return ", ".join(sorted(failed)) or "none failed"


def percent(share: float) -> str:
    """Return a share as a percentage that never rounds up to certainty."""
    text = f"{100.0 * share:.1f}"
    if text == "100.0" and share < 1.0:
        text = ">99.9"
    return f"{text.removesuffix('.0')} %"


def plus_minus(value: float, interval: tuple[float, float]) -> str:
    """Return a value with half the width of its interval, to two digits of that."""
    half = max(interval[1] - value, value - interval[0])
    if half <= 0.0:
        return f"{value:.4g}"
    digits = max(0, 1 - int(np.floor(np.log10(half))))
    return f"{value:.{digits}f} ± {half:.{digits}f}"
