"""Results of a reproduction in its folder.

The report uses these files only::

    swing.csv  pendulum.json  policy.json  evaluation.json  run.mcap  reproduction.json
    twin-evaluation.json  without-prediction.json

The files of the last line are missing for an arm without a digital twin.
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
WITHOUT_PREDICTION: Final = "without-prediction.json"
RUN: Final = "run.mcap"
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
    without_prediction: Evaluation | None
    """The same without the prediction of the state, which delay and lag then leave behind; None for
    an arm without a twin."""
    run: RunLog
    """One run of the policy, on the digital twin if the arm has one."""


def load(out: Path) -> Results:
    """Read the results of a reproduction.

    Raises:
        ArtefactError: A file is missing, corrupt, or belongs to another reproduction.
        RecordingError: The swing cannot be read.
    """
    record = ReproductionRecord.load(out / RECORD)

    def on_twin(name: str) -> Evaluation | None:
        return Evaluation.load(out / name) if name in record.files else None

    results = Results(
        record=record,
        swing=read_swing(out / SWING),
        pendulum=Pendulum.load(out / PENDULUM),
        policy=TabularPolicy.load(out / POLICY),
        evaluation=Evaluation.load(out / EVALUATION),
        twin_evaluation=on_twin(TWIN_EVALUATION),
        without_prediction=on_twin(WITHOUT_PREDICTION),
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
    values = {
        PENDULUM: results.pendulum,
        POLICY: results.policy,
        EVALUATION: results.evaluation,
        TWIN_EVALUATION: results.twin_evaluation,
        WITHOUT_PREDICTION: results.without_prediction,
        RUN: results.run,
    }
    found = {name: value.digest for name, value in values.items() if value is not None}
    return {SWING: results.swing.sha256, **found}
