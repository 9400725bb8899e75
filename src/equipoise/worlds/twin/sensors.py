"""Measurements of the twin: encoder counts and measured joints, with their times.

Both are sampled each millisecond, and available after an age: the delay of the board's line or of
the robot's reply. Repeated reads return the same sample: its errors depend on its own time.
"""

from math import ceil, pi
from typing import Final, NamedTuple

import numpy as np

from equipoise.arrays import Array
from equipoise.jit import inlined
from equipoise.model.arms.arm import FREE_JOINTS
from equipoise.model.encoder import counts_from_theta
from equipoise.model.random import TWIN, normal_pair, philox, uniform
from equipoise.model.worlds import TwinSettings
from equipoise.worlds.twin.physics import TICK

HISTORY_MS: Final = 128
"""Length of the history [ms], above the maximum age."""
ROUNDING: Final = 1e-9
"""Tolerance of times that are whole milliseconds [s]."""


class Sensors(NamedTuple):
    """Encoder and replies: constants, and the last milliseconds.

    Each of them is at its index modulo `HISTORY_MS`.
    """

    counts_per_rev: float
    """Encoder counts per revolution."""
    zero: Array
    """Encoder zero offset of the trial [rad], shape (1,)."""
    encoder_age: int
    """Age of the newest count [ms]."""
    encoder_jitter: float
    """Maximum error of a count's time stamp [s]."""
    reply_age: int
    """Age of the newest measured joints [ms]."""
    joint_noise: float
    """Standard deviation of the noise on a measured joint [rad]."""
    phi: Array
    """Angle of the pendulum from upright, relative to the flange [rad], shape (HISTORY_MS,)."""
    q: Array
    """Free joints [rad], shape (HISTORY_MS, 6)."""


def make_sensors(settings: TwinSettings, seed: int, index: int) -> Sensors:
    """Return the sensors of one trial, without a history.

    Args:
        settings: Ages and errors.
        seed: Master seed.
        index: Number of the trial, which decides the error of the encoder's zero.
    """
    return Sensors(
        counts_per_rev=float(settings.counts_per_rev),
        zero=np.array([encoder_zero(settings, seed, index)]),
        encoder_age=ceil(settings.encoder_age / TICK - ROUNDING),
        encoder_jitter=settings.encoder_jitter,
        reply_age=ceil(settings.reply_age / TICK - ROUNDING),
        joint_noise=settings.joint_noise,
        phi=np.zeros(HISTORY_MS),
        q=np.zeros((HISTORY_MS, FREE_JOINTS)),
    )


def encoder_zero(settings: TwinSettings, seed: int, index: int) -> float:
    """Return the encoder zero offset in one trial [rad].

    Args:
        settings: Its mean and its error.
        seed: Master seed.
        index: Number of the trial.
    """
    word = philox(seed, 0, index, 0, TWIN + 1)[0]
    return settings.zero_offset + float(uniform(word, -settings.zero_error, settings.zero_error))


@inlined
def encoder(sensors: Sensors, now: int, seed: int, index: int) -> tuple[float, float]:
    """Return the newest encoder counts, and their time stamp [s].

    Args:
        sensors: The sensors.
        now: The time [ms].
        seed: Master seed.
        index: Number of the trial.
    """
    tick = now - sensors.encoder_age
    theta = pi - (sensors.phi[tick % HISTORY_MS] + sensors.zero[0])
    word = philox(seed, tick, index, 0, TWIN)[1]
    stamp = tick * TICK + uniform(word, -sensors.encoder_jitter, sensors.encoder_jitter)
    return counts_from_theta(theta, sensors.counts_per_rev, 1.0), stamp


@inlined
def reply(sensors: Sensors, now: int, seed: int, index: int, q: Array) -> float:
    """Write the newest measured joints, and return their time [s].

    Args:
        sensors: The sensors.
        now: The time [ms].
        seed: Master seed.
        index: Number of the trial.
        q: Receives the free joints [rad], shape (6,).
    """
    tick = now - sensors.reply_age
    w0, w1, w2, w3 = philox(seed, tick, index, 0, TWIN + 2)
    v0, v1, _, _ = philox(seed, tick, index, 0, TWIN + 3)
    noise = (*normal_pair(w0, w1), *normal_pair(w2, w3), *normal_pair(v0, v1))
    for i in range(FREE_JOINTS):
        q[i] = sensors.q[tick % HISTORY_MS, i] + sensors.joint_noise * noise[i]
    return tick * TICK
