"""The arm of a twin as its cabinet's programs see it: a servo, measured joints, torques, a pose.

While no servo runs the arm is held where it came to rest; a servo that begins holds it there. It
sags by a few milliradians whenever it has braked: the twin's drives know nothing of what hangs on
the flange, and have no integral term. What stops it for good (emergency stop,
enabling switch, change of the operating mode, the drives' own protection) is one thing here: it
brakes, stays, and obeys nothing until it is set free and a servo begins anew; whoever asks is still
answered. So does a target that is no number: what KUKA's motion layer does with one is not
published.

Not modelled: KUKA's own limits of position, speed and torque, which would stop the arm too (the end
of a joint's range does, by force), and the brakes' closing.
"""

from collections.abc import Sequence
from math import atan2, hypot
from typing import Final

import numpy as np
import numpy.typing as npt

from equipoise.devices.twin.physics import build_bare
from equipoise.devices.twin.servo_model import NEWEST, NOW, send
from equipoise.devices.twin.twin import Twin, noise
from equipoise.model.arms.arm import Arm
from equipoise.model.physics_engine import mujoco
from equipoise.model.sim_configs import TwinSettings

Array = npt.NDArray[np.float64]

BRAKING: Final = 40
"""Milliseconds for which the drives only brake; then they hold the arm where it is. Five times
their lag."""
REST_RATE: Final = 0.02
"""An arm whose joints are no faster holds its target instead [rad/s]; below 1 deg/s, and more than
a swinging pendulum makes of one that rests."""
TORQUE_NOISE: Final = 0.05
"""Standard deviation of the noise on a measured torque [N m]. Assumed."""
JOINT_STREAM: Final = 2
TORQUE_STREAM: Final = 3


class SimulatedArm:
    """The arm behind an emulated cabinet; angles of all joints [rad], shape (n,)."""

    def __init__(self, twin: Twin, arm: Arm, settings: TwinSettings) -> None:
        """Take over the arm of a twin, held where it is.

        Args:
            twin: The twin.
            arm: Its arm.
            settings: Its settings.

        Raises:
            ArmError: The masses of the arm's links are not known.
        """
        mj = mujoco()
        self._twin = twin
        self._n = len(arm.joints)
        self._joint_noise = settings.joint_noise
        self._inverse = mj.mj_inverse
        self._bare = build_bare(arm, settings.rotor_inertia)
        self._bare_data = mj.MjData(self._bare)
        self._error = np.zeros(self._n)
        self._braking = 0
        self._running = False
        self.stopped = ""
        """What stopped the arm; empty where nothing did."""

    @property
    def running(self) -> bool:
        """Whether a servo runs."""
        return self._running

    def measured(self) -> tuple[float, ...]:
        """Return the joints as they are measured now [rad]."""
        q = self._twin.kernel.bodies.qpos[: self._n] - self._error
        noise(self._twin.kernel, self._joint_noise, JOINT_STREAM, q)
        return tuple(q.tolist())

    def torques(self, external: bool) -> tuple[float, ...]:
        """Return torques at the joints, about their axes [N m].

        Args:
            external: Those with which all that is not the bare arm acts on it, by the model that
                the cabinet has of it: bracket and pendulum, whose weight it does not know, and
                whoever touches it. Otherwise those of the drives.
        """
        bodies, n = self._twin.kernel.bodies, self._n
        if external:
            bare = self._bare_data
            bare.qpos[:], bare.qvel[:] = bodies.qpos[:n], bodies.qvel[:n]
            bare.qacc[:] = self._twin.data.qacc[:n]
            self._inverse(self._bare, bare)
            torques = bare.qfrc_inverse - bodies.applied[:n]
        else:
            torques = bodies.applied[:n] + bodies.gravity[:n]
        noise(self._twin.kernel, TORQUE_NOISE, TORQUE_STREAM, torques)
        return tuple(torques.tolist())

    def flange(self) -> tuple[float, ...]:
        """Return where the flange is in the base: x, y, z [mm], a, b, c [rad].

        R = Rz(a) Ry(b) Rx(c), as KUKA writes it.
        """
        bodies = self._twin.kernel.bodies
        R = bodies.xmat[bodies.flange].reshape(3, 3)
        a, c = atan2(R[1, 0], R[0, 0]), atan2(R[2, 1], R[2, 2])
        b = atan2(-R[2, 0], hypot(R[0, 0], R[1, 0]))
        x, y, z = (1e3 * bodies.xpos[bodies.flange]).tolist()
        return x, y, z, a, b, c

    def servo(self, running: bool) -> None:
        """Let a servo begin, holding the arm where it is, or end; the arm then brakes."""
        if self.stopped:
            return
        self._running = running
        self._brake()
        if running:  # what a braking arm is at now is where it is held
            self._braking = min(self._braking, 1)

    def target(self, q: Sequence[float] | Array) -> None:
        """Take the newest target of the servo [rad]; nothing happens where none runs.

        It is in force after the twin's transport. What is no number stops the arm.
        """
        wanted = np.asarray(q, np.float64)
        if not np.isfinite(wanted).all():
            self.stop("a target that is no number")
        elif self._running:
            twin = self._twin.kernel
            send(twin.cabinet, twin.servo, wanted + self._error, twin.seed, twin.trial)

    def stop(self, why: str) -> None:
        """Brake, and obey nothing until `set_free`: an emergency stop, a change of mode.

        Args:
            why: What stopped it.
        """
        self.stopped, self._running = why, False
        self._brake()

    def set_free(self) -> None:
        """Let the arm be moved again; the next servo does."""
        self.stopped = ""

    def tick(self) -> None:
        """Do what a millisecond asks for before it begins."""
        if self._braking:
            self._twin.kernel.cabinet.target[:] = self._twin.kernel.bodies.qpos[: self._n]
            self._braking -= 1

    def _brake(self) -> None:
        """Forget the setpoints on their way, and come to rest."""
        twin = self._twin.kernel
        twin.cabinet.arriving[:] = np.nan
        twin.cabinet.clock[NEWEST] = twin.cabinet.clock[NOW]
        moves = np.abs(twin.bodies.qvel[: self._n]).max() > REST_RATE
        self._braking = BRAKING if moves else 0
