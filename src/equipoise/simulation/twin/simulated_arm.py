"""Arm of a twin as an emulated controller uses it: servo, measured joints, torques.

Without a servo the arm is held at its resting position; a starting servo holds it there. The arm
sags by a few milliradians after each braking, because the twin's drives have neither load data nor
an integral term. Emergency stop, enabling switch, change of the operating mode and the drives'
protection are modelled alike: the arm brakes and ignores targets until `set_free` and the start of
a servo; measurements continue. Assumed: a target that is not finite has the same effect.

Not modelled: the controller's own limits of position, speed and torque, which would stop the arm
too (the end of a joint's range does, by force), and the brakes' closing.
"""

from collections.abc import Sequence

import numpy as np

from equipoise.arrays import Array
from equipoise.jit import kernel
from equipoise.model.random import TWIN, normal_pair, philox
from equipoise.physics_engine import mujoco
from equipoise.simulation.twin.physics import build_bare
from equipoise.simulation.twin.servo_model import send
from equipoise.simulation.twin.twin import Twin


@kernel
def add_noise(twin: np.record, sigma: float, stream: int, values: Array) -> None:
    """Add the noise of this millisecond to measurements of the joints.

    Args:
        twin: Record of the twin, with time, seed and index of the trial.
        sigma: Standard deviation of the noise.
        stream: One of the twin's streams of random numbers, counted from its first.
        values: Changed in place, shape (n,).
    """
    for i in range(len(values)):
        words = philox(twin.seed, twin.now, twin.index, 1 + i, TWIN + stream)
        values[i] += sigma * normal_pair(words[0], words[1])[0]


class SimulatedArm:
    """The arm behind an emulated controller; angles of all joints [rad], shape (n,)."""

    def __init__(self, twin: Twin) -> None:
        """Wrap the arm of a twin, held at its position."""
        self.arm = twin.arm
        """Its description."""
        self._twin, self._bare = twin, build_bare(twin.arm)
        self._bare_data = mujoco().MjData(self._bare)
        self._braking = 0
        self.running = False
        """Whether a servo runs."""
        self.stopped = ""
        """Cause of the stop; empty without a stop."""

    def measured(self) -> tuple[float, ...]:
        """Return the measured joints [rad]."""
        q = self._twin.data.qpos[:-1].copy()
        add_noise(self._twin.state, self._twin.state.joint_noise, 2, q)
        return tuple(q.tolist())

    def torques(self, external: bool) -> tuple[float, ...]:
        """Return the torques that the joints pass on to their links, about their axes [N m].

        Args:
            external: Whether to return external torques, by the controller's model of the bare arm:
                those of bracket, pendulum and contacts. Otherwise return those on the links.
        """
        state, data, bare = self._twin.state, self._twin.data, self._bare_data
        torques = data.qfrc_applied[:-1] - state.servo.rotors * data.qacc[:-1]
        if external:
            bare.qpos[:], bare.qvel[:] = data.qpos[:-1], data.qvel[:-1]
            bare.qacc[:] = data.qacc[:-1]
            mujoco().mj_inverse(self._bare, bare)
            torques = bare.qfrc_inverse + state.gravity - torques
        add_noise(self._twin.state, 0.05, 3, torques)  # [N m], assumed
        return tuple(torques.tolist())

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
            state = self._twin.state
            send(state.servo, wanted, state.now, state.seed, state.index)

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
            self._twin.state.servo.target[:] = self._twin.data.qpos[:-1]
            self._braking -= 1

    def _brake(self) -> None:
        """Drop the setpoints in transport, and come to rest."""
        state = self._twin.state
        state.servo.arriving[:] = np.nan
        state.servo.newest = state.now
        # [rad/s]: more than a swinging pendulum moves a resting arm.
        moves = np.abs(self._twin.data.qvel[:-1]).max() > 0.02
        self._braking = 40 if moves else 0  # [ms]: five times the lag of the drives
