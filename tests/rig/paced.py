"""A robot that sets the pace, in virtual time: a first-order arm that asks every few milliseconds.

Like a real one it gives up where its requests stay without an answer.
"""

from collections import deque

import numpy as np

from equipoise.errors import LinkError
from equipoise.model.arms.iiwa import iiwa
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.interfaces import Request, checked_setpoint

LAG = 0.004
UNANSWERED = 3


class Paced:
    def __init__(self, arm, clock, period_ms):
        self.joints, self.clock, self.period_ms = len(arm.joints), clock, period_ms
        self.q = np.array(arm.home)
        self.goal = self.q.copy()
        self.connected = self.streams = False
        self.waiting = deque()
        self.answers, self.ms = [], 0
        clock.attach(self.advance)

    def advance(self, now):
        self.ms += 1
        self.q = self.q + (1.0 - np.exp(-1e-3 / LAG)) * (self.goal - self.q)
        if self.streams and self.ms % self.period_ms == 0:
            self.waiting.append(Request(now, tuple(self.q.tolist()), (0.1,) * self.joints))

    def link(self):
        if not self.connected:
            raise LinkError("the paced robot is not connected")
        if len(self.waiting) > UNANSWERED:
            raise LinkError(f"{len(self.waiting)} requests without an answer")

    def connect(self):
        self.connected = True

    def measured(self):
        self.link()
        self.clock.wait_until(self.clock.now() + 0.002)
        return self.q.copy()

    def start(self):
        self.link()
        self.goal, self.streams = self.q.copy(), True
        self.waiting.clear()

    def request(self, until):
        self.link()
        while not self.waiting and self.clock.now() < until - 5e-4:
            self.clock.wait_until(self.clock.now() + 1e-3)
        self.link()
        return self.waiting[0] if self.waiting else None

    def answer(self, q):
        self.link()
        self.waiting.popleft()
        self.goal = checked_setpoint(q, self.joints)
        self.answers.append((self.clock.now(), self.goal))

    def stop(self):
        self.link()
        self.streams = False
        self.waiting.clear()

    def close(self):
        self.connected = self.streams = False


def paced_robot(period_ms, arm=None):
    clock = VirtualClock()
    return Paced(arm or iiwa(7), clock, period_ms), clock
