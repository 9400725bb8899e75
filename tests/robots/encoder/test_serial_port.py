"""A serial port as pyserial gives it: over a pseudo-terminal, and over a socket."""

import threading
import time
from collections import deque
from math import pi

import pytest

from equipoise.errors import LinkError
from equipoise.rig.clocks import SystemClock
from equipoise.robots.encoder.board import Board, Terminal
from equipoise.robots.encoder.plugin import open_serial
from equipoise.robots.encoder.sensor import LineEncoder


class Served:
    """A board on a pseudo-terminal, in real time."""

    def __init__(self):
        self.theta = 0.0
        self.board = Board(lambda: self.theta, start=time.monotonic())
        self.terminal = Terminal(self.board)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self):
        while not self._stop.wait(0.001):
            self.terminal.advance(time.monotonic())

    def unplug(self):
        self._stop.set()
        self._thread.join()
        self.terminal.close()


@pytest.fixture
def served():
    served = Served()
    yield served
    served.unplug()


def test_a_board_on_a_terminal_is_a_sensor(served):
    clock = SystemClock()
    sensor = LineEncoder(lambda: open_serial(str(served.terminal.path)), clock, counts_per_rev=8192)
    sensor.connect()
    samples = []
    for i in range(40):
        if i == 20:
            served.theta = 0.02
            served.board.press()
        clock.wait_until(clock.now() + 0.005)
        samples += sensor.samples()
    assert samples[-1].counts - samples[0].counts == round(0.02 * 8192 / (2.0 * pi))
    assert sum(sample.pressed for sample in samples) == 1
    # A host that stalls for as long as a terminal's 4096 bytes last (110 ms) loses nothing.
    assert sensor.rejected == 0
    assert len(samples) > 100
    sensor.close()


def test_an_unplugged_device_is_an_error():
    served = Served()
    transport = open_serial(str(served.terminal.path))
    served.unplug()
    # What came before it was unplugged may be read first.
    with pytest.raises(LinkError, match=r"is gone .*; check its cable"):
        deque(transport.read() for _ in range(100))
    transport.close()
    for call in (transport.read, lambda: transport.write(b"?\n")):
        with pytest.raises(LinkError, match="is gone"):
            call()
