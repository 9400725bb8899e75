"""Excitation of an arm for identifying how it follows setpoints, and its record on a twin.

Each free joint moves about home along two sines under one Hann window, from rest to rest and up to
the joint's top speed. All frequencies differ, and are far from the pendulum's natural frequency, so
that the pendulum keeps hanging.

The server's servo answers a stream of 5 ms with bursts of twice the joint's mean speed, which the
load of the shoulder turns into torques. The top speeds keep the drives below their limits; drives
twice as fast as assumed reach one for 2 of the 10,000 ms.
"""

from typing import Final, NamedTuple

import numpy as np

from equipoise.errors import ArmError
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.chain import Floats
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import TwinSettings
from equipoise.worlds.twin.twin import Twin

PERIOD: Final = 0.005
"""Time between two setpoints [s]: half a control step."""
DURATION: Final = 10.0
"""Duration of a record [s]."""
TOP_SPEED: Final = np.array([0.45, 0.3, 0.4, 1.0, 1.0, 1.0])
"""Top speed of each free joint, from the base on [rad/s]; the load falls towards the flange."""
FAST: Final = np.array([16.0, 14.5, 30.0, 12.0, 10.0, 11.0])
"""Angular frequency of the faster sine of each free joint [rad/s]. That of A4 tells the delay from
the time to the setpoint, whose effects differ with its cube."""
SLOW: Final = np.array([6.4, 5.8, 5.2, 4.8, 4.0, 4.4])
"""Angular frequency of the slower sine [rad/s]; the pendulum's own, 8.4 rad/s, lies between."""
MARGIN: Final = 0.8
"""Maximum share of the limits of velocity and acceleration [-]."""


class ExcitationRecord(NamedTuple):
    """Setpoints sent to an arm, and its measurements, on one clock."""

    stream_time: Floats
    """Time of each setpoint [s], shape (m,)."""
    stream_q: Floats
    """Setpoints of the free joints [rad], shape (m, 6)."""
    reply_time: Floats
    """Time of each measurement of the joints [s], shape (p,)."""
    reply_q: Floats
    """Measured free joints [rad], shape (p, 6)."""
    encoder_time: Floats
    """Time stamps of the encoder [s], shape (p,)."""
    counts: Floats
    """Counts of the encoder, shape (p,)."""


def excitation(arm: Arm, duration: float = DURATION, period: float = PERIOD) -> Floats:
    """Return setpoints around home that move every free joint, from rest to rest.

    Args:
        arm: The arm with its home posture.
        duration: Time from the first to the last setpoint [s].
        period: Time between two setpoints [s].

    Returns:
        Free joints [rad], shape (m, 6).

    Raises:
        ArmError: A joint's home is too close to its limits.
    """
    t = np.linspace(0.0, duration, round(duration / period) + 1)[:, None]
    order = np.arange(len(FAST))
    sines = np.sin(FAST * t + order) / FAST + np.sin(SLOW * t + 2 * order) / SLOW
    motion = np.sin(np.pi * t / duration) ** 2 * sines
    velocity = np.gradient(motion, period, axis=0)
    acceleration = np.gradient(velocity, period, axis=0)
    limits = np.array([(joint.velocity, joint.acceleration) for joint in arm.free_joints]).T
    most = np.minimum(TOP_SPEED, MARGIN * limits[0]) / np.abs(velocity).max(axis=0)
    motion *= np.minimum(most, MARGIN * limits[1] / np.abs(acceleration).max(axis=0))
    q = arm.home_free + motion
    for joint, lowest, highest in zip(arm.free_joints, q.min(axis=0), q.max(axis=0), strict=True):
        if not (joint.lower < lowest and highest < joint.upper):
            raise ArmError(
                f"excitation takes {joint.name} from {lowest:.3g} to {highest:.3g} rad, its limits "
                f"are {joint.lower:.3g} and {joint.upper:.3g} rad; choose a home further inside"
            )
    return q


def excite(
    arm: Arm,
    settings: TwinSettings,
    pendulum: PendulumParameters,
    seed: int,
    duration: float = DURATION,
) -> ExcitationRecord:
    """Send the excitation to a twin with a hanging pendulum, and record its measurements.

    Args:
        arm: The arm with its home posture.
        settings: The world's numbers.
        pendulum: The pendulum, with its friction in the twin.
        seed: Master seed of jitter and noise.
        duration: Duration of the record [s].

    Raises:
        ArmError: The masses of the arm's links are not known, or home is close to a limit.
    """
    twin = Twin(arm, pendulum, settings, seed=seed)
    stream_q = excitation(arm, duration)
    rows: list[tuple[float, Floats, float, float, float]] = []
    for q in stream_q:
        now = twin.now
        twin.send(q)
        twin.advance(PERIOD)
        rows.append((now, *twin.measured(), *twin.encoder()))
    sent, reply_q, reply_time, counts, encoder_time = map(np.array, zip(*rows, strict=True))
    return ExcitationRecord(sent, stream_q, reply_time, reply_q, encoder_time, counts)
