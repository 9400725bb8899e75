"""An arm that follows its target with a first-order lag, behind an emulated server in memory."""

from math import exp, isnan

from equipoise.arm.iiwa import iiwa7
from equipoise.errors import LinkError
from equipoise.rig.clocks import TICK, VirtualClock
from equipoise.rig.transports import memory_pipe
from equipoise.robots.kst.emulator import KstServer

HOME = (0.0, 0.4364, 0.0, -1.3962, 0.0, 1.309, 0.0)
LAG = 0.005


class Follower:
    """The simplest arm: each joint closes in on the target within LAG."""

    arm = iiwa7()
    stopped = ""

    def __init__(self):
        self.q, self.goal = list(HOME), list(HOME)
        self.targets = []
        self.running = False
        self.external = (0.5, -1.25, 1e-4, 0.0, 0.0, 0.0, 0.125)

    def measured(self):
        return tuple(self.q)

    def torques(self, external):
        return self.external if external else (0.0, -12.5, 0.0, 8.25, 0.0, 0.5, 0.0)

    def servo(self, running):
        self.running = running
        self.goal = list(self.q)

    def target(self, q):
        self.targets.append(tuple(q))
        self.goal = list(q)

    def advance(self, now):
        if self.running:
            fraction = 1.0 - exp(-TICK / LAG)
            self.q = [
                q + (0.0 if isnan(goal) else fraction * (goal - q))
                for q, goal in zip(self.q, self.goal, strict=True)
            ]


class Bench:
    """Follower, server and a pipe to it, in virtual time."""

    def __init__(self, *, delay=0.0):
        self.clock = VirtualClock()
        self.body = Follower()
        self.server = KstServer(self.body, self)
        self.client, self.end = memory_pipe(self.clock, delay)
        self.heard, self.heard_at, self.gone = b"", [], False
        self.clock.attach(self.body.advance)
        self.clock.attach(self.run)

    # The link of the server: it keeps what was heard, and fails once where the client has gone.

    def read(self):
        if self.gone:
            self.gone = False
            raise LinkError("gone")
        data = self.end.read()
        if data:
            self.heard += data
            self.heard_at.append((self.clock.now(), data))
        return data

    def write(self, data):
        self.end.write(data)

    def run(self, now):
        self.server.advance(now)
        if self.server.ended:
            self.end.close()

    def wait(self, duration):
        self.clock.wait_until(self.clock.now() + duration)

    def say(self, *lines, wait=0.01):
        """Send lines in one segment, and return what has come after a while."""
        self.client.write(b"".join(line.encode() + b"\n" for line in lines))
        self.wait(wait)
        return self.client.read()
