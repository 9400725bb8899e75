"""An emulated board on the other end of a pipe in memory, all in virtual time."""

from equipoise.rig.clocks import VirtualClock
from equipoise.rig.transports import memory_pipe
from equipoise.robots.encoder.board import Board
from equipoise.robots.encoder.sensor import LineEncoder


class Bench:
    """A board, its spindle, and the sensor that listens to it."""

    def __init__(self, expected=None, sensor_sign=1, **board):
        self.clock = VirtualClock()
        self.motion = None
        """Tells theta at a time; without it the spindle rests."""
        self.slip = 0.0
        """Angle that is added to it [rad]."""
        self.board = Board(self.angle, **board)
        self.host, self.device = memory_pipe(self.clock, 0.001)
        self.garble = None
        """Changes what the board sends."""
        self.sensor = LineEncoder(self.open, self.clock, counts_per_rev=expected, sign=sensor_sign)
        self.clock.attach(self.work)

    def angle(self):
        return self.slip + (0.0 if self.motion is None else self.motion(self.clock.now()))

    def lose(self, seconds):
        """Lose all lines from now on, for a while."""
        until = self.clock.now() + seconds + 1e-9
        self.garble = lambda data: b"" if self.clock.now() < until else data

    def open(self):
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
        """Let time pass, and return all samples that came."""
        samples, until = [], self.clock.now() + seconds
        while self.clock.now() < until - 1e-9:
            self.clock.wait_until(self.clock.now() + every)
            samples += self.sensor.samples()
        return samples
