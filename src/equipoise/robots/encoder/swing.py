"""Recording of a free swing that an operator starts by hand.

The pendulum hangs still, which defines the zero. A hand lifts it, holds it and releases it, and it
falls through the zero. The recording begins a second before that, the hand still on (`equipoise
identify` finds the release), and ends after its duration.
"""

from collections import deque
from collections.abc import Callable, Iterator
from math import inf, pi, radians
from typing import Final

import numpy as np

from equipoise.errors import RecordingError
from equipoise.identification.recording import Trajectory
from equipoise.rig.interfaces import AngleSensor, Clock, Sample
from equipoise.rig.plugins import ignore

LEAD_TIME: Final = 1.0
"""Time recorded before the fall [s]."""
MIN_AMPLITUDE: Final = radians(10.0)
"""Minimum amplitude of a swing [rad]: it should be 50 steps of a common encoder, and its decay has
to show the friction."""
MAX_GAP: Final = 0.02
"""Maximum gap in a recording [s]: a fortieth of the paper's period."""


def record_swing(
    sensor: AngleSensor,
    clock: Clock,
    duration: float = 30.0,
    tell: Callable[[str], None] = ignore,
    show: Callable[[float], None] = ignore,
) -> tuple[Trajectory, int]:
    """Record a free swing that an operator starts by hand.

    Args:
        sensor: Connected sensor.
        clock: Clock of the rig.
        duration: Duration of the swing after the fall through the zero [s].
        tell: Receives the next instruction to the operator.
        show: Receives each angle from the zero [rad].

    Returns:
        The swing, whose time begins at zero, and the number of samples missing in it.

    Raises:
        RecordingError: The swing cannot be used.
        LinkError: The sensor is disconnected, or its zero is void.
    """
    step, samples = 2.0 * pi / sensor.counts_per_rev, _samples(sensor, clock)
    tell("let it hang still")
    since, zero = inf, 0
    for sample in samples:
        if since == inf or abs(sample.counts - zero) > 1:
            since, zero = sample.time, sample.counts
        elif sample.time - since >= 2.0:  # [s]
            break
    tell("lift it by 40 to 60 degrees, hold it there, and let it go")
    kept, fall = deque[tuple[float, float]](), inf
    missing = side = 0
    for sample in samples:
        theta = step * (sample.counts - zero)
        show(theta)
        if abs(theta) >= pi or sample.illegal:
            cause = "the encoder lost a count" if sample.illegal else "it went over the top"
            raise RecordingError(
                f"{cause}; lift it by 40 to 60 degrees, check the encoder's wires, and record again"
            )
        if fall < inf:
            missing += sample.missing
            if (gap := sample.time - kept[-1][0]) > MAX_GAP:
                raise RecordingError(
                    f"samples are missing for {1e3 * gap:.0f} ms, expected at most "
                    f"{1e3 * MAX_GAP:.0f}; close other programs, or use a faster link"
                )
        kept.append((sample.time, theta))
        if sample.time - fall >= duration:
            break
        if fall == inf:
            while kept[0][0] < sample.time - LEAD_TIME:
                kept.popleft()
            if abs(theta) > 0.5 * MIN_AMPLITUDE and side == 0:
                side = 1 if theta > 0.0 else -1
            if side * theta < 0.0:
                fall = sample.time
                tell("swinging, hands off")
    times, theta = np.array(kept).T
    before = float(np.abs(theta[times < fall]).max(initial=0.0))
    after = float((-side * theta).max())
    if after < max(0.5 * before, MIN_AMPLITUDE):
        raise RecordingError(
            "the pendulum was brought down by hand, or lifted too little; lift it by 40 to 60 "
            "degrees, let it go, and record again"
        )
    # The board's clock counts microseconds; further digits would be noise.
    time = np.round(times - times[0], 6)
    swing = Trajectory(time=time, theta=theta, resolution=step, source="recorded swing")
    return swing, missing


def _samples(sensor: AngleSensor, clock: Clock) -> Iterator[Sample]:
    """Yield the samples of a sensor as they come."""
    while True:
        clock.wait_until(clock.now() + 0.01)
        yield from sensor.samples()
