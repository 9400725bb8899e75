"""A controller and an arm of other authors, `franky-sim`, with a pendulum on the flange.

`franky-sim` serves libfranka's network protocol in front of an FR3 in MuJoCo. It accepts any
command; this module adds the controller's checks of lost packets, velocities, accelerations and
jerks, its reflex and its user stop, the external torques, and the pendulum with hand and button.
In velocity mode its servo damps alone; here it also holds the integral of the velocities, with the
stiffness of its position mode, as a controller in joint impedance does.

Not modelled: the Franka Hand stays on the flange, the position-dependent velocity limits,
self-collision, and collision thresholds.
"""

# pyright: reportMissingImports=false, reportUntypedBaseClass=false, reportArgumentType=false
# pyright: reportIncompatibleMethodOverride=false, reportAttributeAccessIssue=false
# Two packages with few types.

import copy
from collections.abc import Iterable
from typing import Any, Final
from xml.etree import ElementTree

import mujoco
import numpy as np
from franky_sim.franka_robot_protocol import MoveStatus, RobotCommand, RobotMode, UDPCommand
from franky_sim.franka_robot_server import FrankaRobotServer
from franky_sim.franka_server import BaseCommand
from franky_sim.mujoco_simulator import MujocoSimulator

from equipoise.arm.arm import Arm, Inertial
from equipoise.arm.chain import rotation_from_rpy
from equipoise.arrays import Array
from equipoise.errors import InputError, OutsideError
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import TwinSettings
from equipoise.rig.simulated_rig import Bench, Bodies
from equipoise.simulation.twin.physics import (
    DRY_TIME,
    bar_inertial,
    pivot,
    rod_inertial,
    set_friction,
)
from equipoise_franka.robot import JOINTS
from equipoise_franka.velocity import ACCELERATION, JERK, PERIOD, VELOCITY

HOST: Final = "127.0.0.1"
"""Address of the emulated hardware."""
OTHER_HOSTS: Final = [f"127.0.0.{number}" for number in range(2, 255)]
"""Further addresses of this machine; the ports of a controller are fixed."""
LINK: Final = "robot0_fr3_link7"
"""Name of the last link."""
CLOSE: Final = 1e-3
"""Maximum difference of the flange's places by both models [m]."""
DAMPING: Final = (450.0, 450.0, 350.0, 350.0, 50.0, 50.0, 50.0)
"""Damping of the joints [N m s/rad]. `franky-sim` has 200 in the last three, which at 1 kHz makes
joint 7 oscillate between its torque limits."""
LOST: Final = 20
"""Number of packets without a command that end a motion."""
ERRORS: Final = {
    "self_collision_avoidance_violation": 2,
    "joint_reflex": 6,
    "joint_motion_generator_velocity_limits_violation": 13,
    "joint_motion_generator_velocity_discontinuity": 14,
    "joint_motion_generator_acceleration_discontinuity": 15,
    "communication_constraints_violation": 25,
}
"""Numbers of the controller's errors."""


class Controller(FrankaRobotServer):
    """The server of `franky-sim` with the checks of a controller."""

    def __init__(self, robot: Any, hosts: Iterable[str]) -> None:
        """Create the controller of a robot, at the first free one of some addresses."""
        self.external = (0.0,) * 7
        """External torques [N m]."""
        self._hosts = list(hosts)
        super().__init__(robot, self._hosts)
        self.connected = True
        """Whether packets pass: not while the cable is pulled."""
        self._mode, self._error = RobotMode.kIdle, ""
        self._changed = False
        self._command: Array | None = None
        self._offset = np.zeros(7)

    def stop(self, error: str = "") -> None:
        """Abort the motion by a user stop, or by a reflex on an error; until `set_free`."""
        self._error = error
        if error:
            self._mode, status = RobotMode.kReflex, MoveStatus.kReflexAborted
        else:
            self._mode = RobotMode.kUserStopped
            status = MoveStatus.kPreemptedDueToActivatedSafetyFunctions
        if self.current_motion_id:
            move = self._tcp_socket, RobotCommand.kMove, self.current_motion_id
            self.send_state()
            BaseCommand.send_response(*move, status)
            self.reset_current_motion_id()
        self.stop_motion()

    def lock(self) -> None:
        """Lock the joints, until `set_free`."""
        self._mode = RobotMode.kOther

    def set_free(self) -> None:
        """Release the user stop, clear the error, and unlock the joints."""
        self._mode, self._error = RobotMode.kIdle, ""

    def freeze(self, *, times: bool) -> None:
        """Repeat the present state to this client, with new times or with the present one."""
        self._frozen, self._frozen_time = self._get_state_bytes(), not times

    def mismeasure(self, offset: Array) -> None:
        """Add an offset to the measured joints from now on [rad], shape (7,)."""
        self._offset = offset

    def plug(self, connected: bool) -> None:
        """Pull the cable, or put it back."""
        self.connected = connected
        if connected:
            self.init()
        elif not self.tcp_connected:
            self._hosts[:] = [str(self.hostname)]  # of the next `init`
            self.cleanup()  # refuses a client

    def start_motion(self, controller: Any, generator: Any, motion: int) -> None:
        """Begin a motion at rest, in velocity mode, unless the arm is stopped."""
        if self._mode != RobotMode.kIdle or generator.name != "kJointVelocity":
            raise ValueError("no such motion is possible")
        self._q = np.array(self.robot.state.q_d)
        self._lost, self._dq, self._ddq = 0, np.zeros(7), np.zeros(7)
        self._changed, self._command = True, None
        super().start_motion(controller, generator, motion)

    def stop_motion(self, send_preemption_signal: bool = True) -> None:
        """End a motion."""
        self._changed = True
        super().stop_motion(send_preemption_signal)

    def process_commands(self) -> None:
        """Process the commands of a cycle, and move on."""
        self._receive()
        command, self._command = self._command, None
        if self.current_motion_id and (error := self._move(command)):
            self.stop(error)
        if self.current_motion_id:
            lead = np.divide(self.robot.kv, self.robot.kp) * self._dq  # it damps the difference
            self.robot.joint_position_control(self._q + lead)
        else:
            super()._post_process_commands()

    def reply(self) -> None:
        """Reply to a client that waits for the begin or the end of a motion, between two cycles."""
        connected = self.udp_connected
        self._receive()
        if self._changed or self.udp_connected != connected:
            self.send_state()

    def send_state(self) -> None:
        """Send the state."""
        self._changed = False
        if self.connected and self.udp_connected:
            if self._frozen_time:
                self._FrankaServer__message_id = self._sent
            super().send_state()
            self._sent += 1

    def _receive(self) -> None:
        if self.connected:
            super().process_commands()

    def _reset_state(self) -> None:
        self._sent, self._frozen, self._frozen_time = -1, b"", False
        super()._reset_state()

    def _handle_udp_command(self, command_data: bytes) -> None:
        command = UDPCommand.from_bytes(command_data)
        if not self.current_motion_id or command.message_id < self._sent:
            return  # it is late, and counts as lost
        self._command = np.array(command.dq_c)
        if command.motion_generation_finished:  # the client waits, and rest follows
            if error := self._move(self._command) or self._move(np.zeros(7)):
                self.stop(error)
            else:
                super()._handle_udp_command(command_data)

    def _move(self, command: Array | None) -> str:
        """Advance the commanded motion by a cycle; return the error, empty if it keeps the limits.

        Args:
            command: Commanded velocity [rad/s]; without one the acceleration remains.
        """
        self._lost = self._lost + 1 if command is None else 0
        if self._lost == LOST:
            return "communication_constraints_violation"
        dq = self._dq + PERIOD * self._ddq if command is None else command
        ddq = (dq - self._dq) / PERIOD
        limits = {
            "joint_motion_generator_velocity_limits_violation": dq / VELOCITY,
            "joint_motion_generator_velocity_discontinuity": ddq / ACCELERATION,
            "joint_motion_generator_acceleration_discontinuity": (ddq - self._ddq)
            / (JERK * PERIOD),
        }
        self._q, self._dq, self._ddq = self._q + PERIOD * dq, dq, ddq
        broken = (name for name, x in limits.items() if np.abs(x).max() > 1.0)
        return next(broken, "")

    def _post_process_commands(self) -> None:
        """Leave the drives to `process_commands`, after the checks."""

    def _get_state_bytes(self) -> bytes:
        if self._frozen:
            return self._frozen
        measured = np.add(self.robot_state.q, self._offset)
        changes: dict[str, Any] = {"q": tuple(measured), "tau_ext_hat_filtered": self.external}
        if self.current_motion_id:
            changes |= {"q_d": tuple(self._q), "dq_d": tuple(self._dq)}
        if self._mode != RobotMode.kIdle:
            errors = tuple(number == ERRORS.get(self._error) for number in range(41))
            changes |= {"robot_mode": self._mode, "errors": errors, "reflex_reason": errors}
        return self.robot_state.replace(**changes).pack_state()


class FrankyRig(Bench):
    """An FR3 of `franky-sim` with a pendulum, hand and button, in time."""

    def __init__(
        self, bodies: Bodies, hosts: Iterable[str] = OTHER_HOSTS, *, real_time: bool = False
    ) -> None:
        """Set up the rig, the arm at rest and the pendulum hanging.

        Args:
            bodies: The FR3, the pendulum and the world.
            hosts: Addresses of which the first free one serves the robot.
            real_time: Whether a state is sent at the begin of its cycle, as by a real controller,
                and a client has the whole cycle to answer; otherwise it needs none.

        Raises:
            InputError: The arm is no FR3.
            OutsideError: No address is free.
        """
        arm, pendulum, settings, q, _, _ = bodies
        simulator: Any = MujocoSimulator()  # its model is None until it starts
        simulator.init()
        if len(arm.joints) != JOINTS:
            raise _not_an_fr3(arm)
        self.robot = simulator.add_robot(initial_q=arm.with_held(q), kv=DAMPING)
        """The robot of `franky-sim`."""
        _add_pendulum(simulator.worldbody, arm, pendulum, settings)
        self.controller = Controller(self.robot, hosts)
        """The controller."""
        simulator.start()
        model, data = simulator.model, simulator.data
        link = data.body(LINK)
        flange = link.xpos + link.xmat.reshape(3, 3) @ arm.flange_xyz
        if not np.allclose(flange, arm.kinematics(q).position, atol=CLOSE):
            raise _not_an_fr3(arm)
        try:
            self.controller.init()
        except OSError as error:
            raise OutsideError(f"{error}; stop the program that uses ports 1337 and 1338") from None
        phi = model.joint("phi").dofadr[0]
        set_friction(model, phi, pendulum, settings.pendulum_mass)
        data.qpos[phi] = np.pi
        mujoco.mj_forward(model, data)
        self._simulator: Any = simulator
        self._real_time = real_time
        # The arm as its controller knows it, without pendulum, bracket and contacts.
        self._bare = copy.copy(model)
        for name in ("bracket", "pendulum"):
            body = model.body(name).id
            self._bare.body_mass[body], self._bare.body_inertia[body] = 0.0, 0.0
        self._bracket = model.body("bracket").id
        self._rotation = rotation_from_rpy(arm.flange_rpy)
        self._bare.dof_armature[phi] = 1.0  # a joint without any mass has no solution
        self._bare.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        self._bare_data = mujoco.MjData(self._bare)
        flange, rod = (model.body(name).id for name in (LINK, "pendulum"))
        super().__init__(bodies, data, self._cycle, flange=flange, rod=rod, phi=int(phi))

    @property
    def q(self) -> Array:
        """True joints [rad], shape (7,)."""
        return np.array(self.robot.inner_state.q)

    def close(self) -> None:
        """Switch the controller off."""
        self.controller.cleanup()
        self._simulator.cleanup()

    def _cycle(self) -> None:
        self.controller.process_commands()
        if self._real_time:
            self.controller.send_state()
        self._simulator.step()
        self.controller.external = self.external_torque()
        if not self._real_time:
            self.controller.send_state()

    def external_torque(self) -> tuple[float, ...]:
        """Return the torques of pendulum, bracket and contacts on the arm [N m], shape (7,).

        Those of the load that the controller was told are subtracted.
        """
        bare, data = self._bare_data, self._simulator.data
        self._bare.body_mass[self._bracket] = self.robot.m_load
        self._bare.body_ipos[self._bracket] = self._rotation @ np.array(self.robot.F_x_Cload)
        bare.qpos[:], bare.qvel[:], bare.qacc[:] = data.qpos, data.qvel, data.qacc
        mujoco.mj_inverse(self._bare, bare)
        own = data.qfrc_applied + data.qfrc_constraint  # drive, dry friction, and ends of ranges
        return tuple((bare.qfrc_inverse - own)[:7].tolist())


def _not_an_fr3(arm: Arm) -> InputError:
    return InputError(f"{arm.name} is not the FR3 of franky-sim; give --arm fr3")


def _add_pendulum(
    world: ElementTree.Element, arm: Arm, pendulum: PendulumParameters, settings: TwinSettings
) -> None:
    """Add bracket and pendulum to the last link of the robot."""

    def add(name: str, place: Any, rotation: Any, inertial: Inertial) -> ElementTree.Element:
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, rotation.ravel())
        pose = {"pos": text(place), "quat": text(quaternion)}
        body = ElementTree.SubElement(link, "body", {"name": name, **pose})
        inertia = text(np.take(inertial.inertia, (0, 3, 5, 1, 2, 4)))
        mass, com = str(inertial.mass), text(inertial.com)
        ElementTree.SubElement(body, "inertial", pos=com, mass=mass, fullinertia=inertia)
        return body

    def text(numbers: Any) -> str:
        return " ".join(map(str, numbers))

    link = next(body for body in world.iter("body") if body.get("name") == LINK)
    flange, rotation = np.array(arm.flange_xyz), rotation_from_rpy(arm.flange_rpy)
    end = rotation @ pivot(arm, settings.pivot_outward)
    upright = rotation @ arm.kinematics(arm.home_free).rotation.T
    add("bracket", flange, np.eye(3), bar_inertial(settings.bracket_mass, end))
    rod = rod_inertial(pendulum.w2, settings.pendulum_mass)
    joint = {"name": "phi", "axis": "0 1 0", "armature": "0"}
    joint |= {"solreffriction": f"{DRY_TIME} 1", "solimpfriction": "0.999 0.999"}
    body = add("pendulum", flange + end, upright, rod)
    ElementTree.SubElement(body, "joint", joint)
