"""Robot and encoder of a simulated rig in process, without protocol and bytes.

Delays are those of the twin: a setpoint takes effect after its transport time, a reply arrives
after its age with the joints of half-way, a count is available after its age. Nothing is lost and
nothing fails; broken links are modelled by the drivers with their emulators.
"""

from collections import deque
from collections.abc import Sequence
from math import ceil
from typing import Any, Final

import numpy as np

from equipoise.errors import LinkError
from equipoise.model.arms.arm import Arm
from equipoise.model.encoder import counts_from_theta
from equipoise.rig.interfaces import AngleSensor, Array, Clock, Reply, Sample, checked_setpoint
from equipoise.rig.plugins import Emulated, RobotPlugin, SensorPlugin, Session, robot_plugin
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.worlds.twin.physics import TICK
from equipoise.worlds.twin.sensors import ROUNDING

BRAKED: Final = 0.1
"""Time from the end of a servo until the arm rests [s]; the twin's drives brake for less than half
of it."""
TORQUE_EVERY: Final = 10
"""Number of replies of which one has external torques instead of measured joints: the twin models a
KST server, which sends either."""


class TwinRobot:
    """Arm of a simulated rig as a `Robot`."""

    def __init__(self, bench: SimulatedRig, clock: Clock) -> None:
        """Connect to a simulated rig.

        Args:
            bench: Simulated rig, which `clock` drives.
            clock: Clock of the rig.
        """
        self.joints = bench.joints
        """Number of joints, the held one included."""
        self._bench, self._clock = bench, clock
        self._reply_age = bench.settings.reply_age
        self._asked: deque[tuple[float, bool]] = deque()
        self._replies: deque[Reply] = deque()
        self._connected = self._streams = False
        self._sent = 0
        bench.watch(self._answer)

    def connect(self) -> None:
        """Connect."""
        self._connected = True

    def measured(self) -> Array:
        """Return the measured joints [rad], shape (joints,).

        Raises:
            LinkError: The device is not connected.
        """
        self._check(self._connected, "is not connected; call connect first")
        self._clock.wait_until(self._clock.now() + self._reply_age)
        return np.array(self._bench.body.measured())

    def start(self) -> None:
        """Start the servo, which holds the arm at its position.

        Raises:
            LinkError: The device is not connected, or the arm is stopped.
        """
        self._check(self._connected, "is not connected; call connect first")
        body = self._bench.body
        body.servo(True)
        self._check(body.running, f"was stopped ({body.stopped}); set it free")
        self._streams, self._sent = True, 0
        self._asked.clear()
        self._replies.clear()

    def send(self, q: Sequence[float] | Array) -> None:
        """Send a setpoint of all joints.

        Args:
            q: The joints [rad], shape (joints,).

        Raises:
            LinkError: No servo runs.
            InputError: The setpoint is not one finite number per joint; nothing was sent.
        """
        setpoint = checked_setpoint(q, self.joints)
        self._check(self._streams, "has no servo running; call start first")
        self._bench.body.target(setpoint)
        self._sent += 1
        self._asked.append((self._clock.now(), self._sent % TORQUE_EVERY == 0))

    def replies(self) -> list[Reply]:
        """Return the replies since the last call, the oldest first.

        Raises:
            LinkError: The device is not connected.
        """
        self._check(self._connected, "is not connected; call connect first")
        came = list[Reply]()
        while self._replies and self._replies[0].received <= self._clock.now() + ROUNDING:
            came.append(self._replies.popleft())
        return came

    def stop(self) -> None:
        """Stop the servo, the arm at rest.

        Raises:
            LinkError: The device is not connected.
        """
        self._check(self._connected, "is not connected; call connect first")
        self._bench.body.servo(False)
        self._streams = False
        self._clock.wait_until(self._clock.now() + BRAKED)

    def close(self) -> None:
        """Disconnect, which ends the servo."""
        if self._streams:
            self._bench.body.servo(False)
        self._connected = self._streams = False

    def _answer(self) -> None:
        """Measure for the setpoints that are half-way to their replies."""
        now = self._bench.now
        while self._asked and self._asked[0][0] + 0.5 * self._reply_age <= now + ROUNDING:
            sent, torque = self._asked.popleft()
            body, received = self._bench.body, max(sent + self._reply_age, now)
            q, torques = (None, body.torques(external=True)) if torque else (body.measured(), None)
            self._replies.append(Reply(sent, received, q, torques))

    def _check(self, good: bool, otherwise: str) -> None:
        if not good:
            raise LinkError(f"the twin's robot {otherwise}")


class TwinEncoder:
    """Encoder of a simulated rig as an `AngleSensor`; its zero is the pendulum's current angle."""

    def __init__(self, bench: SimulatedRig, clock: Clock) -> None:
        """Switch the encoder on.

        Args:
            bench: Simulated rig, which `clock` drives.
            clock: Clock of the rig.
        """
        self.counts_per_rev = bench.settings.counts_per_rev
        """Counts per revolution, after x4."""
        self.description = f"the twin's encoder: {self.counts_per_rev} counts per revolution"
        """Name of the device and its counts."""
        self.rejected = 0
        """Number of damaged readings: zero without a link."""
        self._bench, self._clock = bench, clock
        self._age = ceil(bench.settings.encoder_age / TICK - ROUNDING) * TICK
        self._jitter = bench.settings.encoder_jitter
        self._random = np.random.default_rng([bench.seed, 1])
        self._samples: deque[tuple[float, Sample]] = deque(maxlen=4096)
        self._down = self._connected = False
        self._switched_on = self._counted()
        bench.watch(self._count)

    def connect(self) -> None:
        """Connect, and wait for the first sample."""
        self._connected = True
        self._samples.clear()
        self._clock.wait_until(self._clock.now() + TICK + self._age)

    def samples(self) -> list[Sample]:
        """Return the samples since the last call, the oldest first.

        Raises:
            LinkError: The device is not connected.
        """
        if not self._connected:
            raise LinkError("the twin's encoder is not connected; call connect first")
        came = list[Sample]()
        while self._samples and self._samples[0][0] <= self._clock.now() + ROUNDING:
            came.append(self._samples.popleft()[1])
        return came

    def close(self) -> None:
        """Disconnect."""
        self._connected = False

    def _counted(self) -> int:
        return int(counts_from_theta(self._bench.theta, float(self.counts_per_rev), 1.0))

    def _count(self) -> None:
        """Take the sample of a millisecond."""
        bench = self._bench
        down, before = bench.button, self._down
        self._down = down
        if not self._connected:
            return
        time = bench.now + float(self._random.uniform(-self._jitter, self._jitter))
        counts = self._counted() - self._switched_on
        sample = Sample(time, counts, pressed=down and not before, illegal=False, missing=0)
        self._samples.append((bench.now + self._age, sample))


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
