"""Results of a reproduction in its folder.

The report uses these files only::

    swing.csv  pendulum.json  reproduction.json
    policy.json  evaluation.json  twin-evaluation.json  run.mcap
    literal-policy.json  literal-evaluation.json  literal-twin-evaluation.json  literal-run.mcap
    swing-up.mcap

Both evaluations on the twin are missing for an arm without a digital twin.
"""

from pathlib import Path
from typing import ClassVar, Final, NamedTuple

from equipoise.control.policy import TabularPolicy
from equipoise.errors import ArtefactError
from equipoise.files import Artefact, Name, Number, Seed
from equipoise.identification.recording import Trajectory, read_swing
from equipoise.log.run_log import RunLog
from equipoise.model.pendulum import Pendulum
from equipoise.simulation.evaluation import Evaluation

SWING: Final = "swing.csv"
PENDULUM: Final = "pendulum.json"
POLICY: Final = "policy.json"
RECORD: Final = "reproduction.json"
SWING_UP: Final = "swing-up.mcap"
LITERAL: Final = "literal-"
"""Prefix of the files of the literal recipe."""


class ReproductionRecord(Artefact):
    """Record of a reproduction: everything that its other files do not state."""

    FORMAT: ClassVar[str] = "equipoise-reproduction"

    quick: bool
    """Whether it ran with fewer episodes and trials."""
    seed: Seed
    """Master seed."""
    swing: Name
    """Name of the recording."""
    simulated: bool
    """Whether the swing was simulated."""
    training_s: Number
    """Duration of the default recipe's training [s]."""
    files: dict[Name, Name]
    """Digest of each value, by the name of its file."""


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
    swing_up: RunLog
    """One run of the default recipe in the same world, from a hanging pendulum."""


def save(results: Results, out: Path) -> Results:
    """Write all results but the swing to a folder.

    Returns:
        The results, with the digests of the files in the record.

    Raises:
        OutsideError: The disk rejects a file.
    """
    record = results.record.model_copy(update={"files": digests(results)})
    sources = {"swing": results.swing.sha256}
    results.pendulum.save(out / PENDULUM, command="reproduce", inputs=sources)
    for prefix, recipe in (("", results.default), (LITERAL, results.literal)):
        for name, value in _files(recipe, prefix).items():
            inputs = {"policy": recipe.policy.digest}
            if value is recipe.policy:
                inputs = {"pendulum": results.pendulum.digest}
            value.save(out / name, command="reproduce", inputs=inputs)
    inputs = {"policy": results.default.policy.digest}
    results.swing_up.save(out / SWING_UP, command="reproduce", inputs=inputs)
    record.save(out / RECORD, command="reproduce", inputs=record.files)
    return results._replace(record=record)


def load(out: Path) -> Results:
    """Read the results of a reproduction.

    Raises:
        ArtefactError: A file is missing, corrupt, or belongs to another reproduction.
        RecordingError: The swing cannot be read.
    """
    record = ReproductionRecord.load(out / RECORD)
    recipes: list[RecipeResults] = []
    for prefix in ("", LITERAL):
        on_twin = f"{prefix}twin-evaluation.json"
        recipe = RecipeResults(
            policy=TabularPolicy.load(out / f"{prefix}{POLICY}"),
            evaluation=Evaluation.load(out / f"{prefix}evaluation.json"),
            twin_evaluation=Evaluation.load(out / on_twin) if on_twin in record.files else None,
            run=RunLog.load(out / f"{prefix}run.mcap"),
        )
        recipes.append(recipe)
    swing, pendulum = read_swing(out / SWING), Pendulum.load(out / PENDULUM)
    swing_up = RunLog.load(out / SWING_UP)
    results = Results(record, swing, pendulum, recipes[0], recipes[1], swing_up)
    actual = digests(results)
    for name, recorded in record.files.items():
        if actual.get(name) != recorded:
            raise ArtefactError(
                f"{out / name} is not the file that {out / RECORD} records; "
                "reproduce again, into an empty folder"
            )
    return results


def digests(results: Results) -> dict[str, str]:
    """Return the digest of each value, by the name of its file."""
    files = {SWING: results.swing.sha256, PENDULUM: results.pendulum.digest}
    files[SWING_UP] = results.swing_up.digest
    for prefix, recipe in (("", results.default), (LITERAL, results.literal)):
        files |= {name: value.digest for name, value in _files(recipe, prefix).items()}
    return files


def _files(recipe: RecipeResults, prefix: str) -> dict[str, TabularPolicy | Evaluation | RunLog]:
    """Return the values of a recipe by the names of their files."""
    files = {
        POLICY: recipe.policy,
        "evaluation.json": recipe.evaluation,
        "twin-evaluation.json": recipe.twin_evaluation,
        "run.mcap": recipe.run,
    }
    return {f"{prefix}{name}": value for name, value in files.items() if value is not None}
