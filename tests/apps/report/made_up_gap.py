"""Studies of the gap whose trials nobody ran: a rule says how long each lasts."""

from typing import NamedTuple
from unittest.mock import patch

from equipoise.control.policy import TabularPolicy
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator, shipped_actuator
from equipoise.model.worlds import TwinSettings, World
from equipoise.settings import Settings, resolve
from equipoise.studies import gap as study
from equipoise.studies.gap import gap
from equipoise.worlds.evaluation import TrialResults


class Call(NamedTuple):
    """What the study asked to be evaluated."""

    table: TabularPolicy
    settings: Settings
    world: TwinSettings | None
    actuator: Actuator | None
    seed: int


class Found(NamedTuple):
    """An evaluation, as far as the study looks."""

    results: TrialResults


def with_cures(policy):
    """The table of a policy, as if trained with an actuator."""
    return policy.model_copy(update={"actuators": (shipped_actuator(),)})


def paper_policy(policy):
    """The table of a policy, as if trained without an actuator."""
    changes = {"actuators": (IDEAL_ACTUATOR,), "settings": resolve("paper"), "recipe": "paper"}
    return policy.model_copy(update=changes)


def measured(policy, lasts, **options):
    """Return a study and its calls, where trial i of a call lasts `lasts(call, i)` seconds [s]."""
    calls = []

    def evaluate(table, settings, *, world, actuator, seed, workers, with_baselines, done):
        assert not with_baselines
        twin = world.settings if isinstance(world, World) else None
        call = Call(table, settings, twin, actuator, seed)
        calls.append(call)
        asked = settings.evaluation
        survival = tuple(min(lasts(call, i), asked.duration) for i in range(asked.trials))
        done(asked.trials)
        return Found(
            TrialResults(
                name="policy",
                survival=survival,
                causes=tuple(
                    "lasted" if s >= asked.duration else ("track", "angle")[i % 2]
                    for i, s in enumerate(survival)
                ),
            )
        )

    with patch.object(study, "evaluate", evaluate):
        options = {"paper_policy": paper_policy(policy)} | options
        return gap(policy, **options), calls


def falls_early(call, i):
    """Delay and a wrong zero shorten the trials of those who know nothing of them."""
    cures = call.settings.controller
    if call.world is None:
        return 60.0
    late = 0.0 if cures.predict and call.actuator else call.world.transport
    wrong = 0.0 if cures.estimate_bias else call.world.zero_offset + call.world.zero_error
    soft = 30.0 if call.world.inner != "velocity" else 0.0
    return (90.0 - soft) / (1.0 + 800.0 * late + 300.0 * wrong) + 0.1 * (i % 3)
