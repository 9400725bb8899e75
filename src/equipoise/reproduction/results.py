"""Results of a reproduction, and their files.

The folder of a reproduction holds, beside the report::

    swing.csv  pendulum.json
    policy.json  evaluation.json  twin-evaluation.json  run.mcap
    literal-policy.json  literal-evaluation.json  literal-twin-evaluation.json  literal-run.mcap
    swing-up.mcap

Both evaluations on the twin are missing for an arm without a digital twin.
"""

from typing import Final, NamedTuple

from equipoise.control.policy import TabularPolicy
from equipoise.identification.recording import Trajectory
from equipoise.log.run_log import RunLog
from equipoise.model.pendulum import Pendulum
from equipoise.simulation.evaluation import Evaluation

SWING: Final = "swing.csv"
POLICY: Final = "policy.json"


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

    seed: int
    """Master seed."""
    simulated: bool
    """Whether the swing was simulated."""
    training_s: float
    """Duration of the default recipe's training [s]."""
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

    def files(self) -> dict[str, Pendulum | TabularPolicy | Evaluation | RunLog]:
        """Return all values but the swing, by the names of their files."""
        values: dict[str, Pendulum | TabularPolicy | Evaluation | RunLog | None] = {
            "pendulum.json": self.pendulum,
            "swing-up.mcap": self.swing_up,
        }
        for prefix, recipe in (("", self.default), ("literal-", self.literal)):
            values[f"{prefix}{POLICY}"] = recipe.policy
            values[f"{prefix}evaluation.json"] = recipe.evaluation
            values[f"{prefix}twin-evaluation.json"] = recipe.twin_evaluation
            values[f"{prefix}run.mcap"] = recipe.run
        return {name: value for name, value in values.items() if value is not None}
