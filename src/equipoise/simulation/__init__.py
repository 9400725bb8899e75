"""Trials of any policy in a simulated world: conditions, closed loops, and results.

A package registers a world under the entry point group `equipoise.worlds`: the name, or the part of
it before a colon, and a subclass of `Simulation`. The worlds of this package are registered in the
same way. Any other world is `MODULE:CLASS`.
"""

from typing import Final

from equipoise.control.policy import TaskPolicy
from equipoise.entry_points import registered
from equipoise.errors import SettingsError
from equipoise.files import StrPath, quoted
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator, read_actuator
from equipoise.model.worlds import PREFIX, World, read_world, suggest_world
from equipoise.settings import Settings
from equipoise.simulation.external import ExternalLoop
from equipoise.simulation.interface import (
    ClosedLoop,
    Measurement,
    Setup,
    Simulation,
    TrialRecord,
    TrialRecorder,
    predicted,
    run_trial,
)
from equipoise.simulation.plant import Trial
from equipoise.simulation.trials import Trials
from equipoise.user_code import load_object, user_code

__all__ = [
    "ClosedLoop",
    "ExternalLoop",
    "Measurement",
    "Setup",
    "Simulation",
    "Trial",
    "TrialRecord",
    "TrialRecorder",
    "Trials",
    "predicted",
    "run_trial",
    "setup_of",
    "simulate",
    "world_class",
]

GROUP: Final = "equipoise.worlds"
"""Entry point group of worlds."""


def world_class(world: str | World) -> type[Simulation]:
    """Return the class of a world.

    Raises:
        InputError: The class cannot be imported.
        SettingsError: The world or its twin does not exist, or its class is no `Simulation`.
    """
    name = PREFIX if isinstance(world, World) else world
    if isinstance(world, str) and name.startswith(PREFIX):
        read_world(name)
    worlds = registered(GROUP)
    if (point := worlds.get(name.partition(":")[0])) is not None:
        with user_code(f"the world {point.value}"):
            found = point.load()
    elif ":" in name:
        found = load_object(name, "--world")
    else:
        known = ", ".join(sorted(worlds))
        remedy = suggest_world(name) or f"choose {known} or MODULE:CLASS"
        raise SettingsError(f"there is no world {quoted(name)}; {remedy}")
    if not (isinstance(found, type) and issubclass(found, Simulation)):
        raise SettingsError(
            f"the world {quoted(name)} is no subclass of equipoise.simulation.Simulation"
        )
    return found


def setup_of(
    policy: TaskPolicy,
    world: str | World,
    settings: Settings | None = None,
    actuator: Actuator | StrPath | None = None,
) -> Setup:
    """Return the setup of a policy in a world; settings and actuator replace those of its task.

    In a world with an ideal arm, such as `ideal`, the arm has no delay, also with a given actuator.
    """
    identified = policy.actuator if actuator is None else read_actuator(actuator)
    response = IDEAL_ACTUATOR if world_class(world).ideal_arm else identified
    return Setup(policy.pendulum, policy.arm, settings or policy.settings, response, policy.h)


def simulate(world: str | World, setup: Setup, *, seed: int, stream: int) -> Simulation:
    """Return the simulation of a world.

    Args:
        world: `ideal`, the paper's plant; `model`, the plant behind the actuator; a digital twin,
            by name or with its parameters; another registered world; or `MODULE:CLASS`.
        setup: Pendulum, arm and controller.
        seed: Master seed.
        stream: Purpose of the trials.

    Raises:
        ArmError: The masses of a twin's arm are unknown, or home is a singular posture.
        InputError: The class of the world cannot be imported.
        SettingsError: The world does not exist, or the delay exceeds the controller's history.
    """
    return world_class(world)(world, setup, seed=seed, stream=stream)
