"""An emulated board on the other end of a pipe in memory, all in virtual time."""

from equipoise.rig.clocks import VirtualClock
from equipoise.rig.transports import memory_pipe
from equipoise.robots.encoder.board import Board
from equipoise.robots.encoder.sensor import LineEncoder


class Bench:
    """A board, its spindle, and the sensor that listens to it."""

    def __init__(self, delay=0.001, expected=None, sensor_sign=1, **board):
        self.clock = VirtualClock()
        self.theta = 0.0
        self.motion = None
        """Tells theta at a time, where it is not set by hand."""
        self.board = Board(self.angle, **board)
        self.host, self.device = memory_pipe(self.clock, delay)
        self.opened = 0
        self.garble = None
        """Changes what the board sends."""
        self.sensor = LineEncoder(self.open, self.clock, counts_per_rev=expected, sign=sensor_sign)
        self.clock.attach(self.work)

    def angle(self):
        return self.theta if self.motion is None else self.motion(self.clock.now())

    def open(self):
        self.opened += 1
        return self.host

    def work(self, now):
        if self.device is not None:
            self.board.feed(self.device.read())
            said = self.board.advance(now)
            self.device.write(self.garble(said) if self.garble and said else said)

    def unplug(self):
        self.device.close()
        self.device = None

    def run(self, seconds, every=0.005):
        """Let time pass, and return all samples that came, with the times when they were taken."""
        samples, until = [], self.clock.now() + seconds
        while self.clock.now() < until - 1e-9:
            self.clock.wait_until(self.clock.now() + every)
            samples += self.sensor.samples()
        return samples
