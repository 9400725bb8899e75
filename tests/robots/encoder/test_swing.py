"""Recording a free swing: from a hand in front of an emulated board to an identified pendulum."""

from math import pi, radians

import numpy as np
import pytest

from equipoise import identify, read_swing, write_swing
from equipoise.errors import LinkError, RecordingError
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.interfaces import Sample
from equipoise.robots.encoder.swing import LEAD_TIME, record_swing
from equipoise.settings import IdentificationSettings
from tests.robots.encoder.by_hand import RELEASE, ByHand
from tests.robots.encoder.rig import Bench

N = 8192
PERIOD = 2.0 * pi / np.sqrt(70.2)


class Listed:
    """A sensor of listed samples, which is gone after the last one."""

    counts_per_rev = N

    def __init__(self, samples):
        self._left = samples

    def samples(self):
        new, self._left = self._left[:10], self._left[10:]
        if not new:
            raise LinkError("no sample is left")
        return new


@pytest.mark.parametrize("height", [0.8, pytest.param(-0.5, marks=pytest.mark.full)])
def test_what_is_recorded_identifies_the_pendulum(tmp_path, height):
    bench = Bench(drift=8e-5, offset_us=2**32 - 4_000_000)
    bench.motion = ByHand(height)
    bench.sensor.connect()
    bench.motion.start = bench.clock.now()
    told, shown = [], []
    swing, missing = record_swing(bench.sensor, bench.clock, 10.0, told.append, shown.append)
    assert [words.split()[0] for words in told] == ["let", "lift", "swinging,"]
    assert np.abs(shown).max() == pytest.approx(abs(height), abs=0.02)
    assert missing == 0
    write_swing(tmp_path / "swing.csv", swing)
    pendulum = identify(read_swing(tmp_path / "swing.csv"), IdentificationSettings())
    assert pendulum.w2.value == pytest.approx(70.2, rel=0.01)
    # The board's clock drifts by 8e-5, and w2 by twice as much.
    assert pendulum.w2.low < 70.2 * (1.0 + 16e-5)
    assert pendulum.w2.high > 70.2
    assert pendulum.c.value == pytest.approx(0.15, abs=0.02)
    # The hand is on at first; the fit begins at a turning point after it has let go.
    assert LEAD_TIME - PERIOD / 4.0 - 0.1 < pendulum.fit.release < LEAD_TIME + PERIOD


def carried(time):
    """A hand carries it through the middle and holds it there."""
    if time < 3.0:
        return 0.0
    return 0.5 * np.sin(2.0 * (time - 3.0)) if time < 4.7 else -0.12


def illegal(at):
    def change(samples):
        samples[round(at * 1000)] = samples[round(at * 1000)]._replace(illegal=True)
        return samples

    return change


def without(begin, end):
    def change(samples):
        kept = [s for s in samples if not begin <= s.time < end]
        i = next(i for i, s in enumerate(kept) if s.time >= end)
        kept[i] = kept[i]._replace(missing=len(samples) - len(kept))
        return kept

    return change


@pytest.mark.parametrize(
    ("motion", "change"),
    [
        (carried, list),
        (ByHand(radians(9.0)), list),
        (lambda time: min(max(time - 4.0, 0.0), 3.5), list),  # over the top
        (ByHand(0.8), illegal(RELEASE + 2.0)),
        (ByHand(0.8), without(RELEASE + 2.0, RELEASE + 2.03)),
    ],
)
def test_what_is_no_free_swing_is_refused(motion, change):
    # What a perfect sensor says in 20 s, but for the change.
    counts = [round(motion(i / 1000.0) * N / (2.0 * pi)) for i in range(20_000)]
    samples = [Sample(i / 1000.0, c, False, False, 0) for i, c in enumerate(counts)]
    with pytest.raises(RecordingError):
        record_swing(Listed(change(samples)), VirtualClock(), 10.0)
