"""The controller of an FR3 in memory, in place of the vendor's library, with a simple arm."""

import socket
from types import SimpleNamespace

import numpy as np

from equipoise_franka.velocity import PERIOD

SHARE = 0.2
"""Fraction of its distance from the desired joints that the arm makes up for in a cycle [-]."""


class JointVelocities:
    motion_finished = False

    def __init__(self, values):
        self.values = np.array(values)


class Controller:
    """A controller and its arm; itself the library, its robot, and the control of a motion."""

    RealtimeConfig = SimpleNamespace(kIgnore=0)
    ControllerMode = SimpleNamespace(JointImpedance=0)
    JointVelocities = JointVelocities

    def __init__(self, q, clock):
        self.q, self.desired = np.array(q), np.array(q)
        self.velocity, self.time = np.zeros(7), 0.0
        self.report = lambda state: state
        self.packets = None
        clock.attach(self.cycle)

    def Robot(self, host, realtime):
        self.packets = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.packets.bind(("127.0.0.1", 0))
        self.packets.setblocking(False)
        self.commands = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        return self

    def cycle(self, now):
        self.desired = self.desired + PERIOD * self.velocity
        self.q = self.q + SHARE * (self.desired - self.q)
        self.time += PERIOD
        if self.packets is not None:
            self.packets.sendto(b" ", self.packets.getsockname())

    def read_once(self):
        self.packets.recv(1)
        while True:  # the newest of those that have come
            try:
                self.packets.recv(1)
            except BlockingIOError:
                break
        time = self.time
        state = SimpleNamespace(
            q=tuple(self.q),
            q_d=tuple(self.desired),
            dq_d=tuple(self.velocity),
            tau_ext_hat_filtered=(0.0,) * 7,
            time=SimpleNamespace(to_sec=lambda: time),
            robot_mode=SimpleNamespace(name="Idle"),
            current_errors="[]",
        )
        return self.report(state)

    def readOnce(self):
        return self.read_once(), PERIOD

    def writeOnce(self, command):
        self.velocity = command.values

    def set_collision_behavior(self, *_):
        pass

    def start_joint_velocity_control(self, mode):
        return self

    def close(self):
        self.packets.close()
        self.commands.close()
        self.packets = None
