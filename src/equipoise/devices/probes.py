"""What a rig shows while nothing moves: lateness of deadlines, round trips, an encoder's samples.

All of it goes by the interfaces and the rig's clock, so that it runs in virtual time as well.
"""

import hashlib
import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.devices.encoder.sensor import LineEncoder
from equipoise.devices.interfaces import AngleSensor, Clock, Robot

Array = npt.NDArray[np.float64]

PERIOD: Final = 0.005
"""Time between two setpoints of a run's stream [s]: the rate of 200 Hz that a KST server needs for
a smooth motion."""
LOOK: Final = 0.001
"""Time between two looks at the encoder [s]: the period of a board at 1 kHz."""
SETTLING: Final = 0.1
"""What waited while nobody looked is read away so long before an encoder is listened to [s]."""
BLOCK: Final = bytes(1 << 20)
"""What is digested to burn time: half a millisecond and more, outside Python's lock."""


class Heard(NamedTuple):
    """What an encoder said."""

    counts_per_rev: int
    """Counts per revolution, after x4, as the board says."""
    seconds: float
    """How long it was listened to [s]."""
    delays: Array
    """From each count to its arrival [s], shape (n,); what the fastest line takes is not known, and
    not in it."""
    ages: Array
    """Age of the newest sample at each look [s], shape (m,)."""
    missing: int
    """Samples that were lost on the way."""
    rejected: int | None
    """Lines that were damaged or did not follow; None where the sensor does not count them."""
    illegal: int
    """Samples whose board had met a transition that cannot be."""
    moved: int
    """Counts between the lowest and the highest that came."""


def lateness(clock: Clock, seconds: float, *, period: float = PERIOD) -> Array:
    """Return how late each of a row of absolute deadlines was met [s], shape (n,).

    A stall that lasts over many deadlines makes all of them late, as it does in a run.

    Args:
        clock: The clock to wait at.
        seconds: For how long; at least one deadline.
        period: From one deadline to the next [s].
    """
    late = np.zeros(max(round(seconds / period), 1))
    begin = clock.now()
    for k in range(len(late)):
        deadline = begin + (k + 1) * period
        clock.wait_until(deadline)
        late[k] = clock.now() - deadline
    return late


@contextmanager
def burning(threads: int) -> Generator[None]:
    """Keep processor cores busy meanwhile.

    Args:
        threads: How many threads burn; each fills a core, and holds Python's own lock hardly ever.
    """
    over = threading.Event()

    def burn() -> None:
        while not over.is_set():
            hashlib.sha256(BLOCK).digest()

    burners = [threading.Thread(target=burn, daemon=True) for _ in range(threads)]
    for burner in burners:
        burner.start()
    try:
        yield
    finally:
        over.set()
        for burner in burners:
            burner.join()


@contextmanager
def connected(device: Robot | AngleSensor) -> Generator[None]:
    """Connect a device meanwhile, and let go of it afterwards.

    Raises:
        LinkError: There is no answer, or a wrong one.
    """
    try:
        device.connect()
        yield
    finally:
        device.close()


def round_trips(robot: Robot, clock: Clock, seconds: float, *, period: float = PERIOD) -> Array:
    """Return how long a connected robot at rest takes to tell its joints [s], shape (n,).

    Args:
        robot: Is asked again and again, and does not move.
        clock: The rig's clock.
        seconds: For how long; at least once.
        period: From one question to the next, if the answer has come by then [s].

    Raises:
        LinkError: It does not answer.
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


def listen(sensor: AngleSensor, clock: Clock, seconds: float) -> Heard:
    """Return what a connected encoder says.

    Args:
        sensor: The encoder.
        clock: The rig's clock.
        seconds: How long to listen [s].

    Raises:
        LinkError: It is gone, or silent.
    """
    for _ in _looks(clock, SETTLING):
        sensor.samples()
    before, begin = _rejected(sensor), clock.now()
    newest, missing, illegal = begin, 0, 0
    delays: list[float] = []
    ages: list[float] = []
    counts: list[int] = []
    for _ in _looks(clock, seconds):
        samples, now = sensor.samples(), clock.now()
        for sample in samples:
            delays.append(now - sample.time)
            counts.append(sample.counts)
            missing, illegal = missing + sample.missing, illegal + sample.illegal
            newest = sample.time
        ages.append(now - newest)
    after = _rejected(sensor)
    return Heard(
        counts_per_rev=sensor.counts_per_rev,
        seconds=clock.now() - begin,
        delays=np.array(delays),
        ages=np.array(ages),
        missing=missing,
        rejected=None if after is None or before is None else after - before,
        illegal=illegal,
        moved=max(counts) - min(counts) if counts else 0,
    )


def _looks(clock: Clock, seconds: float) -> Generator[None]:
    """Yield at each look."""
    begin = deadline = clock.now()
    while (now := clock.now()) < begin + seconds:
        deadline = max(deadline + LOOK, now)
        clock.wait_until(deadline)
        yield


def _rejected(sensor: AngleSensor) -> int | None:
    if not isinstance(sensor, LineEncoder):
        return None
    tally = sensor.tally
    return tally.rejected + tally.untimely + tally.jumps
