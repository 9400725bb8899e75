"""A free swing, as someone makes it by hand in front of an encoder.

The pendulum hangs still: that is the zero. A hand lifts it, holds it and lets go. It falls through
the zero and turns round on the other side, nearly as high: a hand that lowers it does not let that
happen, and is waited for again. What is kept begins a second before the fall, the hand still on
(`equipoise identify` finds the release), and ends when the time is over or little motion is left.

`SwingRecorder` takes samples and knows no clock; `record_swing` lets it watch a sensor.
"""

from collections import deque
from collections.abc import Callable
from enum import Enum
from math import degrees, inf, pi, radians
from typing import Final

import numpy as np

from equipoise.devices.interfaces import AngleSensor, Clock, Sample
from equipoise.errors import RecordingError
from equipoise.trajectory import Trajectory

STILL: Final = 2.0
"""Hanging still means: no count moves by more than one for so long [s]."""
LIFTED: Final = radians(5.0)
"""Further from the zero than this a hand has lifted it [rad]."""
LEAST: Final = radians(10.0)
"""A swing must be larger than this [rad]: it should be 50 times the step of a common encoder, and
friction shows in its decay."""
LEAD: Final = 1.0
"""So much before the fall is kept, too [s]."""
RISE: Final = 0.5
"""A free pendulum rises to more than this share of the height angle from which it fell."""
FALL: Final = 2.0
"""Within this time after the zero it must turn round [s]: a period of 8 s."""
LEAST_PERIODS: Final = 3
"""So many periods identify a pendulum; ten are better."""
REST: Final = 0.05
"""The swing is over when this share of its amplitude is left."""
LONGEST_GAP: Final = 0.02
"""So much of a recording may be missing at once [s]: a fortieth of the paper's period."""
OFF_CENTRE: Final = radians(3.0)
"""The middle of the swing may be so far from where it hung [rad]: three times what the dry
friction of a poor bearing explains."""
RELEASE_TIMEOUT: Final = 120.0
"""So long the operator is waited for, in each stage [s]."""
LOOK: Final = 0.01
"""Pause between two looks at the sensor [s]."""


class RecordingStage(Enum):
    """Where a recording is, in the words of an operator."""

    SETTLING = "let it hang still"
    READY = "lift it by 40 to 60 degrees and hold it there"
    LIFTED = "let it go"
    SWINGING = "swinging, hands off"
    DONE = "recorded"


class SwingRecorder:
    """Watches samples for a free swing, and keeps it."""

    def __init__(self, counts_per_rev: int, duration: float = 30.0) -> None:
        """Wait for the pendulum to hang still.

        Args:
            counts_per_rev: Counts per revolution, after x4.
            duration: Length of the swing after it was let go [s].
        """
        self._step = 2.0 * pi / counts_per_rev
        self._duration = duration
        self._kept: deque[tuple[float, int]] = deque()
        self._quiet: tuple[float, int] | None = None
        self._since: float | None = None
        self._last = -inf
        self._zero = 0
        self._fell: float | None = None
        self._from = 0.0
        self._side = 0
        self._extreme = 0.0
        self._turns: list[float] = []
        self.stage = RecordingStage.SETTLING
        """Where the recording is."""
        self.theta = 0.0
        """Newest angle from where it hung [rad]; zero before that is known."""
        self.missing = 0
        """Samples that are missing in what is kept."""
        self.hint = ""
        """Why an attempt did not count; empty where there is nothing to say."""

    @property
    def amplitude(self) -> float:
        """Newest height of the swing, or of the hand [rad]."""
        if self._turns:
            return abs(self._turns[-1])
        return abs(self._extreme)

    @property
    def first_amplitude(self) -> float:
        """Height at which it first turned round after the fall [rad]; zero before."""
        return abs(self._turns[0]) if self._turns else 0.0

    @property
    def periods(self) -> float:
        """Periods that have been recorded."""
        return max(len(self._turns) - 1, 0) / 2.0

    @property
    def elapsed(self) -> float:
        """Time since the fall [s]; zero before it."""
        return 0.0 if self._fell is None else self._last - self._fell

    def take(self, samples: list[Sample]) -> None:
        """Watch what came.

        Raises:
            RecordingError: The swing cannot be used, or nobody does what is waited for.
        """
        for sample in samples:
            if self.stage is not RecordingStage.DONE:
                self._take(sample)

    def trajectory(self, source: str = "recorded swing") -> Trajectory:
        """Return the recording, its time beginning at zero.

        Args:
            source: What it is called.

        Raises:
            RecordingError: It is not done, too short, too small, or not about where it hung.
        """
        if self.stage is not RecordingStage.DONE:
            raise RecordingError("there is no recording yet; wait until it is done")
        if self.periods < LEAST_PERIODS:
            raise RecordingError(
                f"the swing has {self.periods:g} periods, expected at least {LEAST_PERIODS}, "
                "better ten; give a longer --duration, or mend what brakes the pendulum"
            )
        first, second, third = self._turns[:3]
        middle = (first + 2.0 * second + third) / 4.0
        if abs(middle) > OFF_CENTRE:
            raise RecordingError(
                f"the swing is centred {degrees(middle):+.1f} deg from where the pendulum hung, "
                f"expected at most {degrees(OFF_CENTRE):.0f}; let it hang free before the lift"
            )
        begin = self._kept[0][0]
        return Trajectory(
            # The board's clock has microseconds; more digits would be noise.
            time=np.array([round(time - begin, 6) for time, _ in self._kept]),
            theta=np.array([self._step * (counts - self._zero) for _, counts in self._kept]),
            resolution=self._step,
            source=source,
        )

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
        elif self.stage is RecordingStage.LIFTED:
            self._watch_hand()
        else:
            self._watch_swing()

    def _enter(self, stage: RecordingStage) -> None:
        self.stage, self._since = stage, self._last

    def _settle(self, sample: Sample) -> None:
        if self._quiet is None or abs(sample.counts - self._quiet[1]) > 1:
            self._quiet = sample.time, sample.counts
        elif sample.time - self._quiet[0] >= STILL and (
            not self.hint or abs(self._step * (self._quiet[1] - self._zero)) < LIFTED
        ):
            # Another attempt has the zero of the first: held still is not hanging.
            self._zero = self._quiet[1]
            self._enter(RecordingStage.READY)

    def _keep(self, sample: Sample, gap: float) -> None:
        """Keep a sample; before the fall only those of the last second."""
        kept = self._kept
        kept.append((sample.time, sample.counts))
        if self.stage is not RecordingStage.SWINGING:
            while kept[0][0] < sample.time - LEAD:
                kept.popleft()
            self.missing = 0
        self.missing += sample.missing
        if sample.illegal:
            raise RecordingError(
                "the encoder lost a count (an illegal transition of its lines); check its wires, "
                "its shield and its supply, then record again"
            )
        if gap > LONGEST_GAP and self.stage is RecordingStage.SWINGING:
            raise RecordingError(
                f"samples are missing for {1e3 * gap:.0f} ms, expected at most "
                f"{1e3 * LONGEST_GAP:.0f}; close other programs, or use a faster link"
            )

    def _watch_hand(self) -> None:
        """Wait until the pendulum falls through the zero."""
        self._refuse_over_the_top()
        height = self._side * self.theta
        self._extreme = max(height, 0.0)
        if height > 0.0:
            return
        self._from = self._step * max(self._side * (c - self._zero) for _, c in self._kept)
        if self._from < LIFTED:
            self._again("the hand brought it down; let it go instead")
            return
        self._fell, self._side = self._last, -self._side
        self._enter(RecordingStage.SWINGING)

    def _watch_swing(self) -> None:
        self._refuse_over_the_top()
        height = self._side * self.theta
        self._extreme = max(self._extreme, height)
        back = max(3.0 * self._step, 0.1 * self._extreme)
        if self._extreme - height > back:
            self._turn()
        elif not self._turns and self.elapsed > FALL:
            self._again("the hand was still on it")
        if self.stage is RecordingStage.SWINGING and self.elapsed >= self._duration:
            self._enter(RecordingStage.DONE)

    def _refuse_over_the_top(self) -> None:
        if abs(self.theta) >= pi:
            raise RecordingError(
                "the pendulum went over the top; lift it by 40 to 60 degrees, then record again"
            )

    def _turn(self) -> None:
        if not self._turns and self._extreme < max(RISE * self._from, LEAST):
            small = self._extreme < LEAST and self._from < 1.5 * LEAST
            self._again("lift it higher" if small else "the hand was still on it")
            return
        self._turns.append(self._side * self._extreme)
        if self._extreme < REST * abs(self._turns[0]):
            self._enter(RecordingStage.DONE)
        self._side, self._extreme = -self._side, -inf

    def _again(self, hint: str) -> None:
        """Wait for another attempt: the pendulum must hang still again."""
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
    """Record a free swing, while an operator makes it.

    Args:
        sensor: It is connected.
        clock: The rig's clock.
        duration: Length of the swing after it was let go [s].
        show: Is called after each look, to tell the operator where the recording is.

    Returns:
        The swing, and its recorder, which knows how it went.

    Raises:
        RecordingError: The swing cannot be used, or nobody does what is waited for.
        LinkError: The sensor is gone, or no longer what it was.
    """
    recorder = SwingRecorder(sensor.counts_per_rev, duration)
    while recorder.stage is not RecordingStage.DONE:
        clock.wait_until(clock.now() + LOOK)
        recorder.take(sensor.samples())
        show(recorder)
    return recorder.trajectory(), recorder
