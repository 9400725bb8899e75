"""Arm of a twin as an emulated controller uses it: servo, measured joints, torques, pose.

Without a servo the arm is held at its resting position; a starting servo holds it there. The arm
sags by a few milliradians after each braking, because the twin's drives have neither load data nor
an integral term. Emergency stop, enabling switch, change of the operating mode and the drives'
protection are modelled alike: the arm brakes and ignores targets until `set_free` and the start of
a servo; measurements continue. Assumed: a target that is not finite has the same effect.

Not modelled: the controller's own limits of position, speed and torque, which would stop the arm
too (the end of a joint's range does, by force), and the brakes' closing.
"""

from collections.abc import Sequence
from math import atan2, hypot
from typing import Final

import numpy as np

from equipoise.arrays import Array
from equipoise.model.arms.arm import Arm
from equipoise.model.physics_engine import mujoco
from equipoise.model.worlds import TwinSettings
from equipoise.worlds.twin.physics import build_bare
from equipoise.worlds.twin.servo_model import NEWEST, NOW, send
from equipoise.worlds.twin.twin import Twin, noise

BRAKING: Final = 40
"""Braking time of the drives before they hold the arm [ms]: five times their lag."""
REST_RATE: Final = 0.02
"""Joint speed below which the arm counts as resting and holds its target [rad/s]; larger than the
motion that a swinging pendulum causes in a resting arm."""
TORQUE_NOISE: Final = 0.05
"""Standard deviation of the noise on a measured torque [N m]. Assumed."""


class SimulatedArm:
    """The arm behind an emulated controller; angles of all joints [rad], shape (n,)."""

    def __init__(self, twin: Twin, arm: Arm, settings: TwinSettings) -> None:
        """Wrap the arm of a twin, held at its position.

        Args:
            twin: The twin.
            arm: Its arm.
            settings: Its settings.

        Raises:
            ArmError: The masses of the arm's links are not known.
        """
        self.arm = arm
        """Its description."""
        self._twin, self._n = twin, len(arm.joints)
        self._joint_noise = settings.joint_noise
        self._mj = mujoco()
        self._bare = build_bare(arm)
        self._bare_data = self._mj.MjData(self._bare)
        self._braking = 0
        self.running = False
        """Whether a servo runs."""
        self.stopped = ""
        """Cause of the stop; empty without a stop."""

    def measured(self) -> tuple[float, ...]:
        """Return the measured joints [rad]."""
        q = self._twin.kernel.bodies.qpos[: self._n].copy()
        noise(self._twin.kernel, self._joint_noise, 2, q)
        return tuple(q.tolist())

    def torques(self, external: bool) -> tuple[float, ...]:
        """Return the torques that the joints pass on to their links, about their axes [N m].

        Args:
            external: Whether to return external torques, by the controller's model of the bare arm:
                those of bracket, pendulum and contacts. Otherwise return those on the links.
        """
        kernel, n = self._twin.kernel, self._n
        acceleration = self._twin.data.qacc[:n]
        torques = kernel.bodies.applied[:n] - kernel.servo.rotors * acceleration
        if external:
            bare = self._bare_data
            bare.qpos[:], bare.qvel[:] = kernel.bodies.qpos[:n], kernel.bodies.qvel[:n]
            bare.qacc[:] = acceleration
            self._mj.mj_inverse(self._bare, bare)
            torques = bare.qfrc_inverse + kernel.bodies.gravity - torques
        noise(kernel, TORQUE_NOISE, 3, torques)
        return tuple(torques.tolist())

    def wrench(self) -> tuple[float, ...]:
        """Return the external force [N] and moment [N m] on the flange, in its axes, shape (6,).

        The controller derives both from the external torques, by least squares.
        """
        twin, bodies = self._twin, self._twin.kernel.bodies
        jacobian = np.zeros((6, twin.model.nv))
        self._mj.mj_jacBody(twin.model, twin.data, jacobian[:3], jacobian[3:], bodies.flange)
        wrench = np.linalg.lstsq(jacobian[:, : self._n].T, self.torques(external=True))[0]
        return tuple(
            (wrench.reshape(2, 3) @ bodies.xmat[bodies.flange].reshape(3, 3)).ravel().tolist()
        )

    def flange(self) -> tuple[float, ...]:
        """Return the pose of the flange in the base: x, y, z [mm], a, b, c [rad].

        R = Rz(a) Ry(b) Rx(c), KUKA's convention.
        """
        bodies = self._twin.kernel.bodies
        R = bodies.xmat[bodies.flange].reshape(3, 3)
        a, c = atan2(R[1, 0], R[0, 0]), atan2(R[2, 1], R[2, 2])
        b = atan2(-R[2, 0], hypot(R[0, 0], R[1, 0]))
        x, y, z = (1e3 * bodies.xpos[bodies.flange]).tolist()
        return x, y, z, a, b, c

    def servo(self, running: bool) -> None:
        """Start a servo, which holds the arm at its position, or stop it, which brakes the arm.

        Args:
            running: Whether the servo runs.
        """
        if self.stopped:
            return
        self.running = running
        self._brake()
        if running:  # hold a braking arm at its present position
            self._braking = min(self._braking, 1)

    def target(self, q: Sequence[float] | Array) -> None:
        """Set the target of the servo [rad]; ignored without a servo.

        The target takes effect after the twin's transport time. A value that is not finite stops
        the arm.
        """
        wanted = np.asarray(q, np.float64)
        if not np.isfinite(wanted).all():
            self.stop("a target that is not finite")
        elif self.running:
            twin = self._twin.kernel
            send(twin.servo_state, twin.servo, wanted, twin.key[0], twin.key[1])

    def stop(self, why: str) -> None:
        """Brake, and ignore targets until `set_free`, as after an emergency stop.

        Args:
            why: Cause of the stop.
        """
        self.stopped, self.running = why, False
        self._brake()

    def set_free(self) -> None:
        """Clear the stop, so that the next servo moves the arm again."""
        self.stopped = ""

    def tick(self) -> None:
        """Prepare the next millisecond."""
        if self._braking:
            self._twin.kernel.servo_state.target[:] = self._twin.kernel.bodies.qpos[: self._n]
            self._braking -= 1

    def _brake(self) -> None:
        """Drop the setpoints in transport, and come to rest."""
        twin = self._twin.kernel
        twin.servo_state.arriving[:] = np.nan
        twin.servo_state.clock[NEWEST] = twin.servo_state.clock[NOW]
        moves = np.abs(twin.bodies.qvel[: self._n]).max() > REST_RATE
        self._braking = BRAKING if moves else 0
