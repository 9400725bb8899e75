"""Motions around home that show how an arm follows its setpoints, and their record on a twin.

Each free joint swings about home in two sines under one Hann window, which begins and ends at rest:
slow and fast motion, from none to the joint's top speed. No two frequencies are equal, and none is
near the pendulum's own, so that it hangs through all of it.

The server's servo answers a stream of 5 ms with bursts of twice the joint's mean speed; what the
shoulder carries makes torques of them. Its top speeds are such that the drives keep below their
limits also where they are twice as fast as we assume.
"""

from typing import Final, NamedTuple

import numpy as np

from equipoise.devices.twin.twin import Twin
from equipoise.errors import ArmError
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.chain import Floats
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.sim_configs import TwinSettings

PERIOD: Final = 0.005
"""Between two setpoints [s]: half a control step."""
DURATION: Final = 10.0
"""Length of a record [s]."""
TOP_SPEED: Final = np.array([0.45, 0.3, 0.4, 1.0, 1.0, 1.0])
"""Of each free joint, from the base on [rad/s]: from shoulder to hand they carry less and less."""
FAST: Final = np.array([16.0, 14.5, 13.0, 12.0, 10.0, 11.0])
"""Angular frequency of the faster sine of each free joint [rad/s]."""
SLOW_SHARE: Final = 0.4
"""Of the slower sine's to the faster one's: the pendulum's own, 8.4 rad/s, lies between them."""
MARGIN: Final = 0.8
"""Share of the limits of velocity and acceleration that is used."""


class ExcitationRecord(NamedTuple):
    """What was sent to an arm and what came back, by one clock."""

    stream_time: Floats
    """When each setpoint was sent [s], shape (m,)."""
    stream_q: Floats
    """The setpoints of the free joints [rad], shape (m, 6)."""
    reply_time: Floats
    """When each measured position was taken [s], shape (p,)."""
    reply_q: Floats
    """The measured free joints [rad], shape (p, 6)."""
    encoder_time: Floats
    """Time stamps of the encoder [s], shape (p,)."""
    counts: Floats
    """Its counts, shape (p,)."""


def excitation(arm: Arm, duration: float = DURATION, period: float = PERIOD) -> Floats:
    """Return setpoints around home that move every free joint, from rest to rest.

    Args:
        arm: The arm with its home posture.
        duration: From the first to the last [s].
        period: From one to the next [s].

    Returns:
        Free joints [rad], shape (m, 6).

    Raises:
        ArmError: A joint's home is too close to its limits.
    """
    t = np.linspace(0.0, duration, round(duration / period) + 1)[:, None]
    slow, order = SLOW_SHARE * FAST, np.arange(len(FAST))
    sines = np.sin(FAST * t + order) / FAST + np.sin(slow * t + 2 * order) / slow
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
    """Send the excitation to a twin whose pendulum hangs, and record what it shows.

    Args:
        arm: The arm with its home posture.
        settings: The world's numbers.
        pendulum: The pendulum, with the friction that acts in the twin.
        seed: Master seed of jitter and noise.
        duration: Length of the record [s].

    Raises:
        ArmError: The masses of the arm's links are not known, or home is close to a limit.
    """
    twin = Twin(arm, pendulum, settings, seed=seed)
    stream_q = excitation(arm, duration)
    sent: list[float] = []
    replies: list[tuple[Floats, float]] = []
    encoder: list[tuple[float, float]] = []
    for q in stream_q:
        sent.append(twin.now)
        twin.send(q)
        twin.advance(PERIOD)
        replies.append(twin.measured())
        encoder.append(twin.encoder())
    return ExcitationRecord(
        stream_time=np.array(sent),
        stream_q=stream_q,
        reply_time=np.array([time for _, time in replies]),
        reply_q=np.array([q for q, _ in replies]),
        encoder_time=np.array([time for _, time in encoder]),
        counts=np.array([counts for counts, _ in encoder]),
    )
