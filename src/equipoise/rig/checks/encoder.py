"""Stream of an encoder's samples: rate, age, losses, and illegal transitions."""

from collections.abc import Generator, Iterator
from typing import Final

import numpy as np

from equipoise.artefacts import Value
from equipoise.rig.checks.results import STALL, CheckResult, Spread, rated
from equipoise.rig.interfaces import AngleSensor, Clock

READ_PERIOD: Final = 0.001
"""Time between two reads of the encoder [s]: the period of a board at 1 kHz."""
DISCARD_TIME: Final = 0.1
"""Time for discarding buffered samples before a measurement [s]."""
MIN_SAMPLE_RATE: Final = 200.0
"""Rate below which ticks without a new sample are too frequent [1/s]."""
GOOD_SAMPLE_RATE: Final = 450.0
"""Rate that a board at 500 Hz reaches [1/s]."""
GOOD_SAMPLE_AGE: Final = 0.005
"""99th percentile of the newest sample's age on a good line [s]: five samples at 1 kHz."""
MAX_LOST_SHARE: Final = 0.01
"""Share of samples lost or rejected beyond which a wire is suspected [-]."""


class EncoderReading(Value):
    """Statistics of an encoder's stream."""

    counts_per_rev: int
    """Counts per revolution after x4, as the board reports them."""
    rate: float
    """Samples per second [1/s]."""
    delay: Spread | None
    """Time from a count to its arrival, less the shortest delay, which is unknown; None without
    samples."""
    age: Spread
    """Age of the newest sample at any moment."""
    missing: int
    """Samples lost on the way."""
    rejected: int
    """Readings damaged or out of sequence."""
    illegal: int
    """Samples with an illegal transition on the board."""
    moved: int
    """Difference of the highest and the lowest count."""


def listen(sensor: AngleSensor, clock: Clock, seconds: float) -> EncoderReading:
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
    newest, missing, illegal = begin, 0, 0
    delays: list[float] = []
    ages: list[float] = []
    counts: list[int] = []
    for _ in _reads(clock, seconds):
        samples, now = sensor.samples(), clock.now()
        for sample in samples:
            delays.append(now - sample.time)
            counts.append(sample.counts)
            missing, illegal = missing + sample.missing, illegal + sample.illegal
            newest = sample.time
        ages.append(now - newest)
    return EncoderReading(
        counts_per_rev=sensor.counts_per_rev,
        rate=len(delays) / (clock.now() - begin),
        delay=Spread.of(np.array(delays)) if delays else None,
        age=Spread.of(np.array(ages)),
        missing=missing,
        rejected=sensor.rejected - before,
        illegal=illegal,
        moved=max(counts) - min(counts) if counts else 0,
    )


def _reads(clock: Clock, seconds: float) -> Generator[None]:
    """Yield once per read period."""
    begin = deadline = clock.now()
    while (now := clock.now()) < begin + seconds:
        deadline = max(deadline + READ_PERIOD, now)
        clock.wait_until(deadline)
        yield


def check_encoder(
    encoder: EncoderReading, counts_per_rev: int | None = None
) -> Iterator[CheckResult]:
    """Judge an encoder by its stream.

    Args:
        encoder: Statistics of the stream.
        counts_per_rev: Counts per revolution of `rig.toml`, after x4; None skips the comparison.
    """
    same = counts_per_rev is None or counts_per_rev == encoder.counts_per_rev
    yield rated(
        "encoder's counts",
        "good" if same else "bad",
        f"{encoder.counts_per_rev} per revolution"
        + f", the rig says {counts_per_rev}" * (not same),
        "correct counts_per_rev in rig.toml, or COUNTS_PER_REV in the firmware",
    )
    rate, age = encoder.rate, encoder.age.p99
    found = f"{rate:.0f} per second, newest {1e3 * age:.1f} ms old (p99)"
    if encoder.delay is not None:
        found += f", arrival {1e3 * encoder.delay.p99:.1f} ms late (p99)"
    late = rate < GOOD_SAMPLE_RATE or age > GOOD_SAMPLE_AGE
    yield rated(
        "encoder's samples",
        "bad" if rate < MIN_SAMPLE_RATE or age > STALL else "warning" if late else "good",
        found,
        "use a board with native USB (Teensy, Pico), or set the adapter's latency timer to 1 ms: "
        "echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer",
        outside=True,
    )
    lost = encoder.missing + encoder.rejected
    n = encoder.delay.n if encoder.delay is not None else 0
    yield rated(
        "encoder's line",
        "warning" if lost > MAX_LOST_SHARE * n else "good",
        f"{encoder.missing} samples lost, {encoder.rejected} rejected",
        "change the cable, keep it away from the motors', and check the baud rate",
        outside=True,
    )
    yield rated(
        "encoder's signals",
        "bad" if encoder.illegal else "good",
        f"{encoder.illegal or 'no'} illegal transition{'s' * (encoder.illegal > 1)}",
        "counts are being lost: check the encoder's supply, screen and plugs, and keep its cable "
        "away from the motors'",
        outside=True,
    )
