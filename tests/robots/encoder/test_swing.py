"""Recording a free swing: from a hand in front of an emulated board to an identified pendulum."""

from math import pi, radians

import numpy as np
import pytest

from equipoise.errors import LinkError, RecordingError
from equipoise.identification.recording import read_swing, write_swing
from equipoise.identification.swing import identify
from equipoise.rig.interfaces import Sample
from equipoise.robots.encoder.swing import (
    LEAD_TIME,
    MAX_GAP,
    RecordingStage,
    SwingRecorder,
    record_swing,
)
from equipoise.settings import IdentificationSettings
from tests.robots.encoder.by_hand import RELEASE, ByHand
from tests.robots.encoder.rig import Bench

N = 8192
PERIOD = 2.0 * pi / np.sqrt(70.2)


def recorded(motion, until=20.0, duration=10.0, change=lambda samples: samples):
    """What a recorder makes of what a perfect sensor would say."""
    recorder = SwingRecorder(N, duration)
    counts = [round(motion(i / 1000.0) * N / (2.0 * pi)) for i in range(round(until * 1000))]
    recorder.take(change([Sample(i / 1000.0, c, False, False, 0) for i, c in enumerate(counts)]))
    return recorder


def bench_of(motion, **board):
    bench = Bench(**board)
    bench.motion = motion
    bench.sensor.connect()
    motion.start = bench.clock.now()
    return bench


@pytest.mark.parametrize("height", [0.8, -0.5])
def test_what_is_recorded_identifies_the_pendulum(tmp_path, height):
    bench = bench_of(ByHand(height), drift=8e-5, offset_us=2**32 - 4_000_000)
    stages = []
    swing, recorder = record_swing(
        bench.sensor, bench.clock, 10.0, lambda recorder: stages.append(recorder.stage)
    )
    assert list(dict.fromkeys(stages)) == list(RecordingStage)
    assert recorder.missing == 0
    write_swing(tmp_path / "swing.csv", swing)
    pendulum = identify(read_swing(tmp_path / "swing.csv"), IdentificationSettings())
    assert pendulum.w2.value == pytest.approx(70.2, rel=0.01)
    assert pendulum.w2.low < 70.2 < pendulum.w2.high
    assert pendulum.c.value == pytest.approx(0.15, abs=0.02)
    # The hand is on at first; the fit begins at a turning point after it has let go.
    assert LEAD_TIME - PERIOD / 4.0 - 0.1 < pendulum.fit.release < LEAD_TIME + PERIOD


def test_w2_is_right_through_malformed_lines_and_gaps():
    bench = bench_of(ByHand(0.8), seed=5)
    bench.board.malformed = 0.02
    swing, recorder = record_swing(bench.sensor, bench.clock, 10.0)
    assert recorder.missing > 100
    pendulum = identify(swing, IdentificationSettings())
    assert pendulum.w2.value == pytest.approx(70.2, rel=0.01)


def test_the_recording_begins_before_the_fall_and_lasts_as_asked():
    swing = recorded(ByHand(0.8), duration=5.0).trajectory()
    assert swing.time[0] == 0.0
    assert swing.time[-1] == pytest.approx(5.0 + LEAD_TIME, abs=0.002)
    assert swing.resolution == 2.0 * pi / N
    assert not swing.released
    # The fall is at its place: a quarter of a period after the release.
    fall = float(swing.time[np.flatnonzero(swing.theta <= 0.0)[0]])
    assert fall == pytest.approx(LEAD_TIME, abs=0.002)


def carried(time):
    """A hand carries it through the middle and holds it there."""
    if time < 3.0:
        return 0.0
    return 0.5 * np.sin(2.0 * (time - 3.0)) if time < 4.7 else -0.12


@pytest.mark.parametrize("motion", [carried, ByHand(radians(9.0))])
def test_what_is_no_free_swing_is_refused(motion):
    recorder = recorded(motion)
    assert recorder.stage is RecordingStage.DONE
    with pytest.raises(RecordingError):
        recorder.trajectory()


def test_what_moves_is_not_taken_for_hanging():
    recorder = recorded(lambda time: 0.01 * np.sin(8.0 * time), until=20.0)
    assert recorder.stage is RecordingStage.SETTLING
    with pytest.raises(RecordingError):
        recorder.trajectory()


def changed(at, **fields):
    def change(samples):
        i = round(at * 1000)
        samples[i] = samples[i]._replace(**fields)
        return samples

    return change


def without(begin, end):
    def change(samples):
        kept = [s for s in samples if not begin <= s.time < end]
        lost = len(samples) - len(kept)
        i = next(i for i, s in enumerate(kept) if s.time >= end)
        kept[i] = kept[i]._replace(missing=lost)
        return kept

    return change


@pytest.mark.parametrize(
    ("motion", "change"),
    [
        (lambda time: min(max(time - 4.0, 0.0), 3.5), lambda samples: samples),  # over the top
        (ByHand(0.8), changed(RELEASE + 2.0, illegal=True)),
        (ByHand(0.8), without(RELEASE + 2.0, RELEASE + 2.03)),
    ],
)
def test_damage_ends_a_recording_at_once(motion, change):
    with pytest.raises(RecordingError):
        recorded(motion, change=change)


@pytest.mark.parametrize(
    ("change", "missing"),
    [
        (changed(0.5, illegal=True), 0),  # before the zero is taken
        (without(4.2, 4.5), 0),  # while the hand holds it
        (without(RELEASE + 2.0, RELEASE + 2.0 + MAX_GAP - 0.002), 18),
    ],
)
def test_what_does_no_harm_is_kept(change, missing):
    recorder = recorded(ByHand(0.8), change=change)
    assert recorder.missing == missing
    recorder.trajectory()


def test_a_sensor_that_fails_ends_it():
    bench = bench_of(ByHand(0.8))

    def unplug(recorder):
        if recorder.stage is RecordingStage.SWINGING and bench.device is not None:
            bench.unplug()

    with pytest.raises(LinkError):
        record_swing(bench.sensor, bench.clock, 10.0, unplug)
