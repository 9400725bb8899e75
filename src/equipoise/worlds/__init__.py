"""Trials of any policy in a simulated world: conditions, closed loops, and results."""

from equipoise.apps.coppeliasim.address import is_address, read_address
from equipoise.control.policy import TaskPolicy
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator
from equipoise.model.worlds import IDEAL, MODEL, TwinSettings, World, read_world
from equipoise.settings import Settings
from equipoise.worlds.ideal import PlantSimulation
from equipoise.worlds.interface import (
    ClosedLoop,
    Measurement,
    Recorder,
    Setup,
    Simulation,
    TrialRecord,
    estimated,
    predicted,
    run_trial,
)
from equipoise.worlds.trials import Trial, Trials

__all__ = [
    "ClosedLoop",
    "Measurement",
    "Recorder",
    "Setup",
    "Simulation",
    "Trial",
    "TrialRecord",
    "Trials",
    "estimated",
    "find_world",
    "has_ideal_arm",
    "predicted",
    "run_trial",
    "setup_of",
    "simulate",
]


def find_world(world: str | World) -> tuple[str, TwinSettings | None]:
    """Return the name of a world, and the numbers of its digital twin; `None` without one.

    Raises:
        SettingsError: The world does not exist.
    """
    if isinstance(world, str) and world in (IDEAL, MODEL):
        return world, None
    if isinstance(world, str) and is_address(world):
        return world, read_address(world).numbers
    return world if isinstance(world, World) else read_world(world)


def has_ideal_arm(world: str | World) -> bool:
    """Return whether the arm of a world has no delay, and its state is measured exactly.

    Raises:
        SettingsError: The world is an address of CoppeliaSim with an error.
    """
    if isinstance(world, str) and is_address(world):
        return read_address(world).engine is None
    return world == IDEAL


def setup_of(
    policy: TaskPolicy,
    world: str | World,
    settings: Settings | None = None,
    actuator: Actuator | None = None,
) -> Setup:
    """Return the setup of a policy in a world; settings and actuator replace those of its task.

    In the world `ideal`, and with the kinematic arm of CoppeliaSim, the arm has no delay, also with
    a given actuator.
    """
    carried = policy.actuators if actuator is None else (actuator,)
    responses = (IDEAL_ACTUATOR,) if has_ideal_arm(world) else carried
    return Setup(policy.pendulum, policy.arm, settings or policy.settings, responses, policy.h)


def simulate(world: str | World, setup: Setup, *, seed: int, stream: int) -> Simulation:
    """Return the simulation of a world.

    Args:
        world: `ideal`, the paper's plant; `model`, the plant behind the actuator; a digital twin,
            by name or with its parameters; or `coppeliasim://HOST:PORT`, a running CoppeliaSim.
        setup: Pendulum, arm and controller.
        seed: Master seed.
        stream: Purpose of the trials.

    Raises:
        ArmError: The masses of a twin's arm are unknown, or home is a singular posture.
        LinkError: No CoppeliaSim answers at the address.
        MissingExtraError: The client of CoppeliaSim is not installed.
        SettingsError: The world does not exist, or the delay exceeds the controller's history.
    """
    if isinstance(world, str) and is_address(world):
        from equipoise.apps.coppeliasim.world import CoppeliaSimulation

        return CoppeliaSimulation(read_address(world), setup, seed=seed, stream=stream)
    _, numbers = find_world(world)
    if numbers is not None:
        from equipoise.worlds.twin.world import TwinSimulation

        return TwinSimulation(numbers, setup, seed=seed, stream=stream)
    return PlantSimulation.of(setup, seed=seed, stream=stream)
