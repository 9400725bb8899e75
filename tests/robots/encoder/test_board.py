"""The emulated board: what it counts, says and does wrong on request."""

from equipoise.robots.encoder.board import Board
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
