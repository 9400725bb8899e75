"""The emulated board: what it counts, says and does wrong on request."""

from math import pi, sin

import numpy as np
import pytest

from equipoise.robots.encoder.board import BOOT, Board
from equipoise.robots.encoder.codec import Banner, Decoder, Flags, Reading


class Hand:
    """What turns the spindle, and reads what the board sends."""

    def __init__(self, **board):
        self.theta = 0.0
        self.now = 0.0
        self.board = Board(lambda: self.theta, **board)
        self.decoder = Decoder()
        self.decoder.feed(b"\n")

    def advance(self, seconds, motion=None, every=0.001):
        said = []
        for _ in range(round(seconds / every)):
            self.now += every
            if motion:
                self.theta = motion(self.now)
            said += self.decoder.feed(self.board.advance(self.now))
        return said


def readings(said):
    return [line for line in said if isinstance(line, Reading)]


def test_it_introduces_itself_then_sends_a_line_each_millisecond_and_answers_a_question():
    hand = Hand()
    banner, *lines = hand.advance(0.5)
    assert banner == Banner("emulated", "1.0", 8192, 1000)
    assert [line.seq for line in lines] == list(range(500))
    assert [line.t_us for line in lines] == list(range(1000, 501_000, 1000))
    assert {(line.counts, line.flags) for line in lines} == {(0, 0)}
    hand.board.feed(b"?")
    assert len(readings(hand.advance(0.01))) == 10
    hand.board.feed(b"\n")
    asked, *lines = hand.advance(0.01)
    assert asked == banner
    assert len(readings(lines)) == 10


@pytest.mark.parametrize("every", [0.001, 0.004])
def test_its_counts_are_those_of_its_own_times(every):
    hand = Hand(rate_hz=500, drift=2e-3, offset_us=2**32 - 1_000_000)
    lines = readings(hand.advance(4.0, lambda time: sin(8.0 * time), every))
    assert len(lines) == pytest.approx(4.0 * 500 * 1.002, abs=2)
    passed = np.diff([line.t_us for line in lines]) % 2**32
    assert set(passed.tolist()) <= {1999, 2000, 2001}
    elapsed = np.cumsum([lines[0].t_us - (2**32 - 1_000_000), *passed]) * 1e-6 / 1.002
    theta = np.array([line.counts for line in lines]) * 2.0 * pi / 8192
    # Between two calls the angle moves evenly: at most 64 every^2 / 8 off.
    most = pi / 8192 + 64.0 * every**2 / 8.0 + 1e-5
    assert np.max(np.abs(theta - np.sin(8.0 * elapsed))) < most


def test_a_press_is_latched_and_down_is_told_until_it_is_up():
    hand = Hand()
    hand.board.press()
    flags = [line.flags for line in readings(hand.advance(0.003))]
    assert flags == [Flags.DOWN | Flags.PRESSED, Flags.DOWN, Flags.DOWN]
    hand.board.press(False)
    assert readings(hand.advance(0.001))[0].flags == 0
    hand.board.press()
    hand.board.press(False)
    assert [line.flags for line in readings(hand.advance(0.002))] == [Flags.PRESSED, 0]


def test_a_restart_begins_everything_anew():
    hand = Hand(offset_us=5_000_000)
    hand.advance(1.0, lambda time: time)
    hand.board.press()
    hand.board.reboot()
    assert hand.advance(BOOT - 0.002, lambda time: time) == []
    banner, first, *_ = hand.advance(0.1, lambda time: time)
    assert isinstance(banner, Banner)
    assert (first.seq, first.t_us, first.flags) == (0, 1000, 0)
    assert abs(first.counts) < 0.35 * 8192 / (2.0 * pi)
