"""Results of a comparison of policies: cost, survival with intervals, and errors in x."""

from typing import Annotated, ClassVar, Final, Literal

from pydantic import Field

from equipoise.artefacts import Artefact, Count, Name, Number, Seed, Value
from equipoise.control.policy import MAX_ACTUATORS
from equipoise.model.worlds import TwinSettings
from equipoise.settings import EvaluationSettings
from equipoise.worlds.evaluation import TrialResults

Kind = Literal["trained", "solved", "searched", "built in", "given"]

TOLD: Final = ", told"
"""Suffix of the name of a twin on which the controllers assume the twin's own actuator."""
MAX_WORLDS: Final = 16
"""Maximum number of columns of a comparison."""
MAX_ROWS: Final = 64
"""Maximum number of policies of a comparison."""


class Column(Value):
    """Condition of the trials of all policies."""

    world: Name
    """Name of the world."""
    told: bool
    """Whether controllers with a model of the arm's response assume the twin's own actuator;
    otherwise that of their training."""
    world_settings: TwinSettings | None
    """Numbers of the twin; None on a plant."""

    @property
    def name(self) -> str:
        """Title in tables and figures."""
        return self.world + (TOLD if self.told else "")


class Cell(Value):
    """Trials of one policy under one condition."""

    actuators: Annotated[tuple[Name, ...], Field(min_length=1, max_length=MAX_ACTUATORS)]
    """Digests of the controller's models of the arm's response."""
    results: TrialResults
    """Trials; trial i has the same start and plant for every policy with the same settings."""
    rms_x: Number
    """Root mean square of x over all steps of the trials [m]."""


class PolicyRow(Value):
    """Cost and trials of one policy."""

    name: Name
    """Name of the row."""
    kind: Kind
    """`trained`, `solved` and `searched` here, `built in`, or `given` by the caller."""
    policy: Name
    """Digest of the policy."""
    recipe: Name
    """Recipe of a table with its differences; empty for other policies."""
    episodes: Count | None
    """Training episodes, or trials of a search; None where there was no training here."""
    steps: Count | None
    """Environment steps of the training, without those of the selection."""
    selection_steps: Count | None
    """Environment steps of the trials that selected the table."""
    train_s: Number | None
    """Wall time of training and selection [s], measured on this machine."""
    size: Count | None
    """Size of the numbers that determine the policy [bytes]: one for each box of a table, eight for
    each gain; of a network its file; None for a policy in Python."""
    decision_s: Number
    """Time of one decision, called from Python [s], measured on this machine."""
    cells: Annotated[tuple[Cell, ...], Field(min_length=1, max_length=MAX_WORLDS)]
    """Trials under each condition, in the order of the columns."""


class Comparison(Artefact):
    """Cost and survival of several policies under common conditions."""

    FORMAT: ClassVar[str] = "equipoise-comparison"
    VERSION: ClassVar[int] = 1

    quick: bool
    """Whether this is the short form: fewer episodes, fewer and shorter trials."""
    arm: Name
    """Name of the arm."""
    pendulum: Name
    """Digest of the pendulum that the trials vary."""
    actuator: Name
    """Digest of the actuator of the training."""
    evaluation: EvaluationSettings
    """Starts, number and length of the trials."""
    seed: Seed
    """Master seed of the trainings and of the trials."""
    columns: Annotated[tuple[Column, ...], Field(min_length=1, max_length=MAX_WORLDS)]
    """Conditions."""
    rows: Annotated[tuple[PolicyRow, ...], Field(min_length=1, max_length=MAX_ROWS)]
    """Policies."""

    @property
    def trials(self) -> int:
        """Number of trials of each policy under each condition."""
        return self.evaluation.trials

    @property
    def duration(self) -> float:
        """Length of a trial [s]."""
        return self.evaluation.duration
