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
    RELEASE_TIMEOUT,
    RecordingStage,
    SwingRecorder,
    record_swing,
)
from equipoise.settings import IdentificationSettings
from tests.robots.encoder.by_hand import RELEASE, ByHand
from tests.robots.encoder.rig import Bench

N = 8192
PERIOD = 2.0 * pi / np.sqrt(70.2)


def samples_of(motion, until, rate=1000.0, begin=0.0):
    """Return what a perfect sensor would say."""
    return [
        Sample(begin + i / rate, round(motion(i / rate) * N / (2.0 * pi)), False, False, 0)
        for i in range(round(until * rate))
    ]


def recorded(motion, until=20.0, duration=10.0, change=lambda samples: samples, rate=1000.0):
    recorder = SwingRecorder(N, duration)
    recorder.take(change(samples_of(motion, until, rate)))
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
    # The hand is on at first; identification sees it let go, a quarter of a period before the fall.
    assert LEAD_TIME - PERIOD / 4.0 - 0.1 < pendulum.fit.release < LEAD_TIME + 0.1


def test_w2_is_right_through_malformed_lines_and_gaps():
    bench = bench_of(ByHand(0.8), seed=5)
    bench.board.malformed = 0.02
    swing, recorder = record_swing(bench.sensor, bench.clock, 10.0)
    assert recorder.missing > 100
    pendulum = identify(swing, IdentificationSettings())
    assert pendulum.w2.value == pytest.approx(70.2, rel=0.01)


def test_the_recording_begins_before_the_fall_and_lasts_as_asked():
    recorder = recorded(ByHand(0.8), duration=5.0)
    swing = recorder.trajectory()
    assert swing.time[0] == 0.0
    assert swing.time[-1] == pytest.approx(5.0 + LEAD_TIME, abs=0.002)
    assert swing.resolution == 2.0 * pi / N
    assert not swing.released
    # The fall is at its place: a quarter of a period after the release.
    fall = float(swing.time[np.flatnonzero(swing.theta <= 0.0)[0]])
    assert fall == pytest.approx(LEAD_TIME, abs=0.002)
    assert recorder.first_amplitude == pytest.approx(0.8, abs=0.03)
    assert recorder.periods == pytest.approx(5.0 / PERIOD, abs=1.0)
    assert recorder.elapsed == pytest.approx(5.0, abs=0.01)


def lowering(time):
    """A hand lifts it and brings it down again, a little past the middle."""
    if time < 3.0:
        return 0.0
    if time < 7.0:
        return 0.35 * (1.0 - np.cos(2.0 * pi * (time - 3.0) / 4.0))
    return 0.05 * np.sin(-(time - 7.0)) if time < 7.5 else 0.05 * np.sin(-0.5)


def carried(time):
    """A hand carries it through the middle and holds it there."""
    if time < 3.0:
        return 0.0
    return 0.5 * np.sin(2.0 * (time - 3.0)) if time < 5.0 else 0.5 * np.sin(4.0)


def brought_down(time):
    """A hand lifts it, and takes two seconds to bring it to just past the middle."""
    if time < 3.0:
        return 0.0
    if time < 4.0:
        return 0.8 * (time - 3.0)
    return max(0.8 - 0.4 * (time - 4.0), 0.03 - 0.02 * (time - 6.0), -0.01)


@pytest.mark.parametrize("motion", [lowering, carried, brought_down])
def test_a_hand_that_lowers_it_is_waited_for_again(motion):
    recorder = recorded(motion, until=10.0)
    assert recorder.hint
    assert recorder.stage in (RecordingStage.SETTLING, RecordingStage.READY)
    # It hangs again, and this time it is let go.
    recorder.take(samples_of(ByHand(0.8, zero=0.0), 20.0, begin=10.0))
    assert recorder.stage is RecordingStage.DONE
    assert recorder.trajectory().theta.max() > 0.7


def test_a_small_swing_is_asked_for_again_higher():
    recorder = recorded(ByHand(radians(9.0)), until=8.0)
    assert recorder.hint == "lift it higher"
    assert recorder.stage is RecordingStage.SETTLING


def test_what_moves_is_not_taken_for_hanging():
    recorder = recorded(lambda time: 0.01 * np.sin(8.0 * time), until=20.0)
    assert recorder.stage is RecordingStage.SETTLING
    with pytest.raises(RecordingError, match="there is no recording yet"):
        recorder.trajectory()


def test_over_the_top_in_the_hand_is_refused_at_once():
    def lifted_too_far(time):
        return min(max(time - 4.0, 0.0), 3.5)

    with pytest.raises(RecordingError, match="over the top; lift it by 40 to 60 degrees"):
        recorded(lifted_too_far)


def changed(at, **fields):
    def change(samples):
        i = round(at * 1000)
        samples[i] = samples[i]._replace(**fields)
        return samples

    return change


def test_a_lost_count_is_refused():
    with pytest.raises(RecordingError, match="lost a count"):
        recorded(ByHand(0.8), change=changed(RELEASE + 2.0, illegal=True))
    # Before the zero is taken it does no harm.
    recorded(ByHand(0.8), change=changed(0.5, illegal=True)).trajectory()


def without(begin, end):
    def change(samples):
        kept = [s for s in samples if not begin <= s.time < end]
        lost = len(samples) - len(kept)
        i = next(i for i, s in enumerate(kept) if s.time >= end)
        kept[i] = kept[i]._replace(missing=lost)
        return kept

    return change


def test_a_long_gap_in_the_swing_is_refused_and_a_short_one_told():
    begin = RELEASE + 2.0
    with pytest.raises(RecordingError, match="samples are missing for 31 ms, expected at most 20"):
        recorded(ByHand(0.8), change=without(begin, begin + 0.030))
    short = recorded(ByHand(0.8), change=without(begin, begin + MAX_GAP - 0.002))
    assert short.missing == 18
    short.trajectory()
    # While the hand holds it, nothing is lost.
    assert recorded(ByHand(0.8), change=without(4.2, 4.5)).missing == 0


def test_a_zero_that_was_held_is_refused():
    def held_off(time):
        # A hand holds it still, off the middle: it swings about another place.
        return by_hand(time) if time >= 3.0 else 0.3 + radians(4.0)

    by_hand = ByHand(0.8)
    with pytest.raises(RecordingError, match=r"centred -4.0 deg from where the pendulum hung"):
        recorded(held_off).trajectory()


@pytest.mark.parametrize("motion", [lambda time: time, lambda time: 0.0])
def test_an_operator_who_does_nothing_is_not_waited_for_for_ever(motion):
    with pytest.raises(RecordingError, match=r"waited 120 s in vain: (let it hang|lift it)"):
        recorded(lambda time: motion(time) % 1.0, until=RELEASE_TIMEOUT + 5.0, rate=100.0)


def test_a_sensor_that_fails_ends_it():
    bench = bench_of(ByHand(0.8))

    def unplug(recorder):
        if recorder.stage is RecordingStage.SWINGING and bench.device is not None:
            bench.unplug()

    with pytest.raises(LinkError, match="is gone"):
        record_swing(bench.sensor, bench.clock, 10.0, unplug)
