"""Recorder of a free swing that an operator starts by hand.

The pendulum hangs still, which defines the zero. A hand lifts it, holds it and releases it, and it
falls through the zero. The recording begins a second before that, the hand still on (`equipoise
identify` finds the release), and ends after its duration.

`SwingRecorder` processes samples without a clock; `record_swing` connects it with a sensor.
"""

from collections import deque
from collections.abc import Callable
from enum import Enum
from math import inf, pi, radians
from typing import Final

import numpy as np

from equipoise.errors import RecordingError
from equipoise.identification.recording import Trajectory
from equipoise.rig.interfaces import AngleSensor, Clock, Sample

STILL: Final = 2.0
"""Time within which a still pendulum moves by at most one count [s]."""
LEAD_TIME: Final = 1.0
"""Time recorded before the fall [s]."""
MIN_AMPLITUDE: Final = radians(10.0)
"""Minimum amplitude of a swing [rad]: it should be 50 steps of a common encoder, and its decay has
to show the friction."""
MAX_GAP: Final = 0.02
"""Maximum gap in a recording [s]: a fortieth of the paper's period."""


class RecordingStage(Enum):
    """Stage of a recording; its value is the instruction to the operator."""

    SETTLING = "let it hang still"
    READY = "lift it by 40 to 60 degrees, hold it there, and let it go"
    SWINGING = "swinging, hands off"
    DONE = "recorded"


class SwingRecorder:
    """Detector and recorder of a free swing in a stream of samples."""

    def __init__(self, counts_per_rev: int, duration: float = 30.0) -> None:
        """Create a recorder that waits for a still pendulum.

        Args:
            counts_per_rev: Counts per revolution, after x4.
            duration: Duration of the swing after the fall through the zero [s].
        """
        self._step, self._duration = 2.0 * pi / counts_per_rev, duration
        self._kept: deque[tuple[float, int]] = deque()
        self._since, self._last = inf, -inf
        self._zero = self._side = 0
        self.stage = RecordingStage.SETTLING
        """Stage of the recording."""
        self.theta = 0.0
        """Newest angle from the zero [rad]; 0 before the zero is known."""
        self.missing = 0
        """Number of samples missing in the swing."""

    def take(self, samples: list[Sample]) -> None:
        """Process new samples.

        Raises:
            RecordingError: The swing cannot be used.
        """
        for sample in samples:
            gap, self._last = sample.time - self._last, sample.time
            if self.stage is RecordingStage.SETTLING:
                self._settle(sample)
            elif self.stage is not RecordingStage.DONE:
                self._record(sample, gap)

    def _settle(self, sample: Sample) -> None:
        """Take the zero once the count has stayed within one."""
        if self._since == inf or abs(sample.counts - self._zero) > 1:
            self._since, self._zero = sample.time, sample.counts
        elif sample.time - self._since >= STILL:
            self.stage = RecordingStage.READY

    def _record(self, sample: Sample, gap: float) -> None:
        """Keep a sample, and notice the fall through the zero and the end."""
        self._kept.append((sample.time, sample.counts))
        self.theta = self._step * (sample.counts - self._zero)
        if abs(self.theta) >= pi or sample.illegal:
            cause = "the encoder lost a count" if sample.illegal else "it went over the top"
            raise RecordingError(
                f"{cause}; lift it by 40 to 60 degrees, check the encoder's wires, and record again"
            )
        if self.stage is RecordingStage.READY:
            while self._kept[0][0] < sample.time - LEAD_TIME:
                self._kept.popleft()
            if abs(self.theta) > 0.5 * MIN_AMPLITUDE and self._side == 0:
                self._side = 1 if self.theta > 0.0 else -1
            if self._side * self.theta < 0.0:
                self._since, self.stage = sample.time, RecordingStage.SWINGING
            return
        self.missing += sample.missing
        if gap > MAX_GAP:
            raise RecordingError(
                f"samples are missing for {1e3 * gap:.0f} ms, expected at most "
                f"{1e3 * MAX_GAP:.0f}; close other programs, or use a faster link"
            )
        if sample.time - self._since >= self._duration:
            self.stage = RecordingStage.DONE

    def trajectory(self) -> Trajectory:
        """Return the recording; its time begins at zero.

        Raises:
            RecordingError: The recording is incomplete, or the hand was still on the pendulum.
        """
        if self.stage is not RecordingStage.DONE:
            raise RecordingError(f"there is no recording yet: {self.stage.value}")
        times, counts = zip(*self._kept, strict=True)
        # The board's clock counts microseconds; further digits would be noise.
        time = np.array([round(time - times[0], 6) for time in times])
        theta = self._step * (np.array(counts) - self._zero)
        before = float(np.abs(theta[np.array(times) < self._since]).max())
        after = float((-self._side * theta).max())
        if after < max(0.5 * before, MIN_AMPLITUDE):
            raise RecordingError(
                "the pendulum was brought down by hand, or lifted too little; lift it by 40 to 60 "
                "degrees, let it go, and record again"
            )
        return Trajectory(time=time, theta=theta, resolution=self._step, source="recorded swing")


def record_swing(
    sensor: AngleSensor,
    clock: Clock,
    duration: float = 30.0,
    show: Callable[[SwingRecorder], None] = lambda recorder: None,
) -> tuple[Trajectory, SwingRecorder]:
    """Record a free swing that an operator starts by hand.

    Args:
        sensor: Connected sensor.
        clock: Clock of the rig.
        duration: Duration of the swing after the fall [s].
        show: Called after each read, to show the stage to the operator.

    Returns:
        The swing, and its recorder with the statistics of the recording.

    Raises:
        RecordingError: The swing cannot be used.
        LinkError: The sensor is disconnected, or its zero is void.
    """
    recorder = SwingRecorder(sensor.counts_per_rev, duration)
    while recorder.stage is not RecordingStage.DONE:
        clock.wait_until(clock.now() + 0.01)
        recorder.take(sensor.samples())
        show(recorder)
    return recorder.trajectory(), recorder
