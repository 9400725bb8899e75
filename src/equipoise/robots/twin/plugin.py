"""The plugin of the digital twin: robot and encoder in process, `twin:nominal` or `twin:FILE`."""

from typing import Final

from equipoise.errors import InputError
from equipoise.model.arms.arm import Arm
from equipoise.model.worlds import PREFIX, read_world
from equipoise.rig import plugins
from equipoise.rig.interfaces import Clock
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.robots.twin.robot import TwinEncoder, TwinRobot

FORM: Final = f"{PREFIX}nominal"


def check_sensor(address: str) -> None:
    """Reject an address: the twin's encoder comes with its robot.

    Raises:
        InputError: Always.
    """
    raise InputError(f"{address!r} has no encoder for another robot; give the robot {FORM}")


def emulate_robot(
    rig: SimulatedRig, arm: Arm, session: plugins.Session, delay: float, seed: int
) -> plugins.EmulatedRobot:
    """Return the arm of a simulated rig as a robot without a link."""
    return plugins.EmulatedRobot(TwinRobot(rig, session.clock))


def emulate_sensor(
    rig: SimulatedRig, clock: Clock, counts_per_rev: int, sign: int, seed: int
) -> plugins.EmulatedSensor:
    """Return the spindle of a simulated rig as a sensor without a link."""
    return plugins.EmulatedSensor(TwinEncoder(rig, clock))


def flange_speed(arm: Arm, period: float) -> float:
    """Return the speed limit [m/s] of the cabinet that the twin models, KUKA's with KST."""
    rule = plugins.robot_plugin("kst").flange_speed
    return float("inf") if rule is None else rule(arm, period)


ROBOT: Final = plugins.RobotPlugin(
    form=FORM, check=read_world, emulate=emulate_robot, link_share=0.0, flange_speed=flange_speed
)
"""Registered as `twin`."""
SENSOR: Final = plugins.SensorPlugin(form=FORM, check=check_sensor, emulate=emulate_sensor)
"""Registered as `twin`."""
