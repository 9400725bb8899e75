"""Measurements of machine and rig before a run; nothing moves.

Deadlines are absolute, as in a run: a stall over several deadlines makes all of them late.
"""

from collections.abc import Generator
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.rig.interfaces import SETPOINT_PERIOD, AngleSensor, Clock, ServoedArm

Array = npt.NDArray[np.float64]

READ_PERIOD: Final = 0.001
"""Time between two reads of the encoder [s]: the period of a board at 1 kHz."""
DISCARD_TIME: Final = 0.1
"""Time for discarding buffered samples before a measurement [s]."""


class EncoderStream(NamedTuple):
    """Statistics of an encoder's stream."""

    counts_per_rev: int
    """Counts per revolution after x4, as the board reports them."""
    rate: float
    """Samples per second [1/s]."""
    ages: Array
    """Age of the newest sample at each read [s]."""
    lost_share: float
    """Share of samples lost on the way, damaged or out of sequence [-]."""
    illegal: int
    """Number of samples with an illegal transition on the board."""


def lateness(clock: Clock, seconds: float, *, period: float = SETPOINT_PERIOD) -> Array:
    """Measure how late absolute deadlines are met [s], shape (n,).

    Args:
        clock: The clock to wait at.
        seconds: Length of the measurement [s]; at least one deadline.
        period: Time between deadlines [s].
    """
    late = np.zeros(max(round(seconds / period), 1))
    begin = clock.now()
    for k in range(len(late)):
        deadline = begin + (k + 1) * period
        clock.wait_until(deadline)
        late[k] = clock.now() - deadline
    return late


def round_trips(
    robot: ServoedArm, clock: Clock, seconds: float, *, period: float = SETPOINT_PERIOD
) -> Array:
    """Measure how long a connected robot at rest takes to return its joints [s], shape (n,).

    Args:
        robot: The robot; it does not move.
        clock: The rig's clock.
        seconds: Length of the measurement [s]; at least one round trip is measured.
        period: Time between two requests, where the reply has arrived by then [s].

    Raises:
        LinkError: The robot does not answer.
    """
    robot.measured()
    trips: list[float] = []
    begin = clock.now()
    for k in range(max(round(seconds / period), 1)):
        clock.wait_until(begin + k * period)
        asked = clock.now()
        if k and asked - begin >= seconds:
            break
        robot.measured()
        trips.append(clock.now() - asked)
    return np.array(trips)


def listen(sensor: AngleSensor, clock: Clock, seconds: float) -> EncoderStream:
    """Measure the stream of a connected encoder.

    Args:
        sensor: The encoder.
        clock: The rig's clock.
        seconds: Length of the measurement [s].

    Raises:
        LinkError: The encoder is disconnected or silent.
    """
    for _ in _reads(clock, DISCARD_TIME):
        sensor.samples()
    before, begin = sensor.rejected, clock.now()
    newest, received, missing, illegal = begin, 0, 0, 0
    ages: list[float] = []
    for _ in _reads(clock, seconds):
        samples, now = sensor.samples(), clock.now()
        for sample in samples:
            missing, illegal = missing + sample.missing, illegal + sample.illegal
            newest = sample.time
        received += len(samples)
        ages.append(now - newest)
    lost = missing + sensor.rejected - before
    rate = received / (clock.now() - begin)
    share = lost / max(received + lost, 1)
    return EncoderStream(sensor.counts_per_rev, rate, np.array(ages), share, illegal)


def _reads(clock: Clock, seconds: float) -> Generator[None]:
    """Yield once per read period."""
    begin = deadline = clock.now()
    while (now := clock.now()) < begin + seconds:
        deadline = max(deadline + READ_PERIOD, now)
        clock.wait_until(deadline)
        yield
