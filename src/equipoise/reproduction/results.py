"""Results of a reproduction in its folder.

The report uses these files only::

    swing.csv  pendulum.json  reproduction.json
    policy.json  evaluation.json  twin-evaluation.json  run.mcap
    literal-policy.json  literal-evaluation.json  literal-twin-evaluation.json  literal-run.mcap

Both evaluations on the twin are missing for an arm without a digital twin.
"""

from pathlib import Path
from typing import ClassVar, Final, NamedTuple

from equipoise.artefacts import Artefact, Count, Name, Number, Seed
from equipoise.control.policy import TabularPolicy
from equipoise.errors import ArtefactError
from equipoise.identification.recording import Trajectory, read_swing
from equipoise.logs.run_log import RunLog
from equipoise.model.pendulum import Pendulum
from equipoise.worlds.evaluation import Evaluation

SWING: Final = "swing.csv"
PENDULUM: Final = "pendulum.json"
POLICY: Final = "policy.json"
EVALUATION: Final = "evaluation.json"
TWIN_EVALUATION: Final = "twin-evaluation.json"
RUN: Final = "run.mcap"
LITERAL: Final = "literal-"
"""Prefix of the files of the literal recipe."""
RECORD: Final = "reproduction.json"


class ReproductionRecord(Artefact):
    """Record of a reproduction: everything that its other files do not state."""

    FORMAT: ClassVar[str] = "equipoise-reproduction"

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
    simulated: bool
    """Whether the swing was simulated."""
    files: dict[Name, Name]
    """Digest of each value, by the name of its file."""
    stages: dict[Name, Number]
    """Duration of each stage [s], including the compilation in a first run."""


class RecipeResults(NamedTuple):
    """Results of one recipe."""

    policy: TabularPolicy
    """The trained policy."""
    evaluation: Evaluation
    """Trials in the simulation of the training; of the default recipe, also those of baselines."""
    twin_evaluation: Evaluation | None
    """Trials on the digital twin; None for an arm without a twin."""
    run: RunLog
    """One run, on the digital twin if the arm has one."""


class Results(NamedTuple):
    """All results of a reproduction."""

    record: ReproductionRecord
    """Record of the reproduction."""
    swing: Trajectory
    """The free swing."""
    pendulum: Pendulum
    """The identified pendulum."""
    default: RecipeResults
    """Results of the default recipe, or of the given settings."""
    literal: RecipeResults
    """Results of the literal recipe, `paper`."""


def load(out: Path) -> Results:
    """Read the results of a reproduction.

    Raises:
        ArtefactError: A file is missing, corrupt, or belongs to another reproduction.
        RecordingError: The swing cannot be read.
    """
    record = ReproductionRecord.load(out / RECORD)

    def of_recipe(prefix: str) -> RecipeResults:
        on_twin = prefix + TWIN_EVALUATION
        return RecipeResults(
            policy=TabularPolicy.load(out / f"{prefix}{POLICY}"),
            evaluation=Evaluation.load(out / f"{prefix}{EVALUATION}"),
            twin_evaluation=Evaluation.load(out / on_twin) if on_twin in record.files else None,
            run=RunLog.load(out / f"{prefix}{RUN}"),
        )

    results = Results(
        record=record,
        swing=read_swing(out / SWING),
        pendulum=Pendulum.load(out / PENDULUM),
        default=of_recipe(""),
        literal=of_recipe(LITERAL),
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
    found = {SWING: results.swing.sha256, PENDULUM: results.pendulum.digest}
    names = POLICY, EVALUATION, TWIN_EVALUATION, RUN
    for prefix, values in (("", results.default), (LITERAL, results.literal)):
        for name, value in zip(names, values, strict=True):
            if value is not None:
                found[prefix + name] = value.digest
    return found
