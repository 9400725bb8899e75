"""Recorder of a free swing that an operator starts by hand.

The pendulum hangs still, which defines the zero. A hand lifts it, holds it and releases it. The
pendulum falls through the zero and turns round on the other side, nearly as high. A pendulum that
is lowered by hand does not, and the recorder waits for another attempt. The recording begins a
second before the fall, the hand still on (`equipoise identify` finds the release), and ends after
its duration or when little motion is left.

`SwingRecorder` processes samples without a clock; `record_swing` connects it with a sensor.
"""

from collections import deque
from collections.abc import Callable
from enum import Enum
from math import degrees, inf, pi, radians
from typing import Final

import numpy as np

from equipoise.errors import RecordingError
from equipoise.identification.recording import Trajectory
from equipoise.rig.interfaces import AngleSensor, Clock, Sample

STILL: Final = 2.0
"""Time within which a still pendulum moves by at most one count [s]."""
LIFTED: Final = radians(5.0)
"""Minimum angle from the zero of a lifted pendulum [rad]."""
MIN_AMPLITUDE: Final = radians(10.0)
"""Minimum amplitude of a swing [rad]: it should be 50 steps of a common encoder, and its decay has
to show the friction."""
LEAD_TIME: Final = 1.0
"""Time recorded before the fall [s]."""
MIN_RISE: Final = 0.5
"""Minimum angle of the first turn of a free pendulum, as a share of the angle of its fall [-]."""
MAX_TURN_TIME: Final = 2.0
"""Maximum time from the zero to the first turn [s]: a period of 8 s."""
MIN_PERIODS: Final = 3
"""Minimum number of periods that identify a pendulum; ten are better."""
MIN_DECAY: Final = 0.05
"""Share of the first amplitude at which the recording ends [-]."""
MAX_GAP: Final = 0.02
"""Maximum gap in a recording [s]: a fortieth of the paper's period."""
MAX_OFFSET: Final = radians(3.0)
"""Maximum angle between the centre of the swing and the zero [rad]: three times the effect of the
dry friction of a poor bearing."""
RELEASE_TIMEOUT: Final = 120.0
"""Timeout of the operator in each stage [s]."""
POLL_PERIOD: Final = 0.01
"""Time between two reads of the sensor [s]."""


class RecordingStage(Enum):
    """Stage of a recording; its value is the instruction to the operator."""

    SETTLING = "let it hang still"
    READY = "lift it by 40 to 60 degrees and hold it there"
    LIFTED = "let it go"
    SWINGING = "swinging, hands off"
    DONE = "recorded"


class SwingRecorder:
    """Detector and recorder of a free swing in a stream of samples."""

    def __init__(self, counts_per_rev: int, duration: float = 30.0) -> None:
        """Create a recorder that waits for a still pendulum.

        Args:
            counts_per_rev: Counts per revolution, after x4.
            duration: Duration of the swing after the release [s].
        """
        self._step, self._duration = 2.0 * pi / counts_per_rev, duration
        self._kept: deque[tuple[float, int]] = deque()
        self._quiet: tuple[float, int] | None = None
        self._since: float | None = None
        self._fell: float | None = None
        self._last = -inf
        self._zero = self._side = 0
        self._from = self._extreme = 0.0
        self._turns: list[float] = []
        self.stage = RecordingStage.SETTLING
        """Stage of the recording."""
        self.theta = 0.0
        """Newest angle from the zero [rad]; 0 before the zero is known."""
        self.missing = 0
        """Number of samples missing in the recording."""
        self.hint = ""
        """Reason for rejecting the last attempt; empty without one."""

    @property
    def amplitude(self) -> float:
        """Newest amplitude of the swing or of the lift [rad]."""
        return abs(self._turns[-1] if self._turns else self._extreme)

    @property
    def first_amplitude(self) -> float:
        """Angle of the first turn after the fall [rad]; 0 before it."""
        return abs(self._turns[0]) if self._turns else 0.0

    @property
    def periods(self) -> float:
        """Number of recorded periods."""
        return max(len(self._turns) - 1, 0) / 2.0

    @property
    def elapsed(self) -> float:
        """Time since the fall [s]; 0 before it."""
        return 0.0 if self._fell is None else self._last - self._fell

    def take(self, samples: list[Sample]) -> None:
        """Process new samples.

        Raises:
            RecordingError: The swing cannot be used, or a stage timed out.
        """
        for sample in samples:
            if self.stage is not RecordingStage.DONE:
                self._take(sample)

    def trajectory(self) -> Trajectory:
        """Return the recording; its time begins at zero.

        Raises:
            RecordingError: The recording is incomplete, too short, or off centre.
        """
        if self.stage is not RecordingStage.DONE:
            raise RecordingError("there is no recording yet; wait until it is done")
        if self.periods < MIN_PERIODS:
            raise RecordingError(
                f"the swing has {self.periods:g} periods, expected at least {MIN_PERIODS}, "
                "better ten; give a longer --duration, or mend what brakes the pendulum"
            )
        first, second, third = self._turns[:3]
        middle = (first + 2.0 * second + third) / 4.0
        if abs(middle) > MAX_OFFSET:
            raise RecordingError(
                f"the swing is centred {degrees(middle):+.1f} deg from where the pendulum hung, "
                f"expected at most {degrees(MAX_OFFSET):.0f}; let it hang free before the lift"
            )
        times, counts = zip(*self._kept, strict=True)
        # The board's clock counts microseconds; further digits would be noise.
        time = np.array([round(time - times[0], 6) for time in times])
        theta = self._step * (np.array(counts) - self._zero)
        return Trajectory(time=time, theta=theta, resolution=self._step, source="recorded swing")

    def _take(self, sample: Sample) -> None:
        time, gap, self._last = sample.time, sample.time - self._last, sample.time
        if self._since is None:
            self._since = time
        elif self.stage is not RecordingStage.SWINGING and time - self._since > RELEASE_TIMEOUT:
            raise RecordingError(
                f"waited {RELEASE_TIMEOUT:.0f} s in vain: {self.stage.value}; nothing was recorded"
            )
        if self.stage is RecordingStage.SETTLING:
            self._settle(sample)
            return
        self.theta = self._step * (sample.counts - self._zero)
        self._keep(sample, gap)
        if self.stage is RecordingStage.READY:
            if abs(self.theta) > LIFTED:
                self._side = 1 if self.theta > 0.0 else -1
                self._enter(RecordingStage.LIFTED)
            return
        if abs(self.theta) >= pi:
            raise RecordingError(
                "the pendulum went over the top; lift it by 40 to 60 degrees, then record again"
            )
        watch = self._watch_hand if self.stage is RecordingStage.LIFTED else self._watch_swing
        watch(self._side * self.theta)

    def _enter(self, stage: RecordingStage) -> None:
        self.stage, self._since = stage, self._last

    def _settle(self, sample: Sample) -> None:
        if self._quiet is None or abs(sample.counts - self._quiet[1]) > 1:
            self._quiet = sample.time, sample.counts
        elif sample.time - self._quiet[0] >= STILL and (
            not self.hint or abs(self._step * (self._quiet[1] - self._zero)) < LIFTED
        ):
            # A later attempt must stop near the first zero: a pendulum held still is not hanging.
            self._zero = self._quiet[1]
            self._enter(RecordingStage.READY)

    def _keep(self, sample: Sample, gap: float) -> None:
        """Keep a sample; before the fall drop samples older than `LEAD_TIME`."""
        kept = self._kept
        kept.append((sample.time, sample.counts))
        if self.stage is not RecordingStage.SWINGING:
            while kept[0][0] < sample.time - LEAD_TIME:
                kept.popleft()
            self.missing = 0
        self.missing += sample.missing
        if sample.illegal:
            raise RecordingError(
                "the encoder lost a count (an illegal transition of its lines); check its wires, "
                "its shield and its supply, then record again"
            )
        if gap > MAX_GAP and self.stage is RecordingStage.SWINGING:
            raise RecordingError(
                f"samples are missing for {1e3 * gap:.0f} ms, expected at most "
                f"{1e3 * MAX_GAP:.0f}; close other programs, or use a faster link"
            )

    def _watch_hand(self, height: float) -> None:
        """Detect the fall through the zero from an angle on the side of the lift [rad]."""
        self._extreme = max(height, 0.0)
        if height > 0.0:
            return
        self._from = self._step * max(self._side * (c - self._zero) for _, c in self._kept)
        if self._from < LIFTED:
            self._again("the hand brought it down; let it go instead")
            return
        self._fell, self._side = self._last, -self._side
        self._enter(RecordingStage.SWINGING)

    def _watch_swing(self, height: float) -> None:
        self._extreme = max(self._extreme, height)
        if self._extreme - height > max(3.0 * self._step, 0.1 * self._extreme):
            self._turn()
        elif not self._turns and self.elapsed > MAX_TURN_TIME:
            self._again("the hand was still on it")
        if self.stage is RecordingStage.SWINGING and self.elapsed >= self._duration:
            self._enter(RecordingStage.DONE)

    def _turn(self) -> None:
        if not self._turns and self._extreme < max(MIN_RISE * self._from, MIN_AMPLITUDE):
            small = self._extreme < MIN_AMPLITUDE and self._from < 1.5 * MIN_AMPLITUDE
            self._again("lift it higher" if small else "the hand was still on it")
            return
        self._turns.append(self._side * self._extreme)
        if self._extreme < MIN_DECAY * abs(self._turns[0]):
            self._enter(RecordingStage.DONE)
        self._side, self._extreme = -self._side, -inf

    def _again(self, hint: str) -> None:
        """Reject the attempt, and wait for a still pendulum again."""
        self.hint, self._quiet, self._fell = hint, None, None
        self._turns, self._extreme = [], 0.0
        self._kept.clear()
        self._enter(RecordingStage.SETTLING)


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
        duration: Duration of the swing after the release [s].
        show: Called after each read, to show the stage to the operator.

    Returns:
        The swing, and its recorder with the statistics of the recording.

    Raises:
        RecordingError: The swing cannot be used, or a stage timed out.
        LinkError: The sensor is disconnected, or its zero is void.
    """
    recorder = SwingRecorder(sensor.counts_per_rev, duration)
    while recorder.stage is not RecordingStage.DONE:
        clock.wait_until(clock.now() + POLL_PERIOD)
        recorder.take(sensor.samples())
        show(recorder)
    return recorder.trajectory(), recorder
