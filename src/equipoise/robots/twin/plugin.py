"""The plugin of the digital twin: robot and encoder in process, `twin:nominal` or `twin:FILE`."""

from typing import Any, Final

from equipoise.model.arms.arm import Arm
from equipoise.rig.interfaces import AngleSensor, Clock
from equipoise.rig.plugins import Emulated, RobotPlugin, SensorPlugin, Session, robot_plugin
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.robots.twin.robot import TwinEncoder, TwinRobot


def emulate_robot(
    rig: SimulatedRig, arm: Arm, session: Session, delay: float, seed: int
) -> Emulated[Any]:
    """Return the arm of a simulated rig as a robot without a link."""
    return Emulated(TwinRobot(rig, session.clock))


def emulate_sensor(
    rig: SimulatedRig, clock: Clock, counts_per_rev: int, sign: int, seed: int
) -> Emulated[AngleSensor]:
    """Return the spindle of a simulated rig as a sensor without a link."""
    return Emulated(TwinEncoder(rig, clock))


def flange_speed(arm: Arm, period: float) -> float:
    """Return the speed limit [m/s] of the cabinet that the twin models, KUKA's with KST."""
    rule = robot_plugin("kst").flange_speed
    return float("inf") if rule is None else rule(arm, period)


ROBOT: Final = RobotPlugin(emulate=emulate_robot, link_share=0.0, flange_speed=flange_speed)
"""Registered as `twin`."""
SENSOR: Final = SensorPlugin(emulate=emulate_sensor)
"""Registered as `twin`."""
