"""One trial of the closed loop as one reads it: lists of times, small matrices, joint by joint.

What `step` of `equipoise.simulation.plant`, with the controller in it, must equal. It takes
from the package the numbers of settings, actuator and arm, and the arm's uncompiled kinematics,
which has tests of its own; delay line, servo, Riccati recursion, pendulum, observer and prediction
are written here a second time. Times are whole milliseconds from the start of the trial, at which
the arm rests.
"""

from math import cos, exp, floor, pi, sin

import numpy as np

from equipoise.control.control_step import CORRECTION
from equipoise.control.linear import ACCELERATION_SIGMA, ANGLE_SIGMA, BIAS_DRIFT

H = 0.01
MILLISECOND = 1e-3
TICK = 10
HALF = 5
"""Milliseconds between two ticks, and between two setpoints."""


def gains(pendulum, settings, counts_per_rev, h=H):
    """Return the Kalman gains to which the recursion of Riccati converges.

    State: phi, phi_dot, bias. The angular acceleration is shaken, and held over a step; the bias
    drifts; the measurement is phi + bias, with the errors of a count and of its time.
    """
    A = np.array([[0.0, 1.0, 0.0], [pendulum.w2, -pendulum.c, 0.0], [0.0, 0.0, 0.0]])
    F, held, term = np.eye(3), np.zeros((3, 3)), np.eye(3)
    for n in range(1, 25):
        held += term * h / n
        term = term @ A * h / n
        F += term
    shaken = held[:, 1] * ACCELERATION_SIGMA
    N = np.outer(shaken, shaken)
    drifts = 1.0 if settings.estimate_bias else 0.0
    N[2, 2] = drifts * BIAS_DRIFT**2 * h
    R = (2.0 * pi / counts_per_rev) ** 2 / 12.0 + ANGLE_SIGMA**2
    C = np.array([1.0, 0.0, 1.0])
    P, L = np.diag([1e-2, 1.0, 1e-4 * drifts]), np.zeros(3)
    for _ in range(100_000):
        P = F @ P @ F.T + N
        before, L = L, P @ C / (C @ P @ C + R)
        P = (np.eye(3) - np.outer(L, C)) @ P
        P = 0.5 * (P + P.T)
        # What is slowest, the bias, loses 3 in 1,000 of its error in a step.
        if np.max(np.abs(L - before)) < 1e-13:
            break
    return L


def runge_kutta(phi, phi_dot, u, time, pendulum):
    """Return angle and rate of a pendulum without dry friction, u held, after one step."""

    def f(s):
        phi, phi_dot = s
        sine, cosine = (phi, 1.0) if pendulum.linearised else (sin(phi), cos(phi))
        drag = pendulum.drag * abs(phi_dot) * phi_dot
        ddphi = pendulum.w2 * sine - pendulum.c * phi_dot - drag - pendulum.k * u * cosine
        return np.array([phi_dot, ddphi])

    s = np.array([phi, phi_dot])
    k1 = f(s)
    k2 = f(s + time / 2 * k1)
    k3 = f(s + time / 2 * k2)
    k4 = f(s + time * k3)
    return tuple((s + time / 6 * (k1 + 2 * k2 + 2 * k3 + k4)).tolist())


def pivot_velocity(arm, flange):
    """Return the velocity along x of the point of the flange where the spindle is [m/s]."""
    to_pivot = flange.rotation @ np.array(arm.pivot)
    return (flange.twist[:3] + np.cross(flange.twist[3:], to_pivot))[0]


class Joints:
    """Six joints behind servo and drive."""

    def __init__(self, actuator, factor, q):
        """Begin at rest."""
        self.actuator = actuator
        self.lags = [factor * lag.value for lag in actuator.lags]
        self.q, self.dq = np.array(q), np.zeros(6)
        self.past = [self.q.copy()] * HALF

    @property
    def velocity(self):
        """Velocity of the motion [rad/s]: without inertia the mean since the last setpoint."""
        if self.actuator.kind == "kst":
            return self.dq
        return (self.q - self.past[0]) / (1e-3 * HALF)

    def millisecond(self, setpoint):
        """Follow the setpoint that is in force for a millisecond."""
        self.past = [*self.past[1:], self.q.copy()]
        a, b, t_c = self.actuator.amplitude, self.actuator.width, self.actuator.cycle.value
        for i in range(6):
            e = setpoint[i] - self.q[i]
            taken = 1.0 - exp(-MILLISECOND / self.lags[i]) if self.lags[i] > 0.0 else 1.0
            if self.actuator.kind == "kst":
                wanted = np.sign(e) * a / t_c * (1.0 - exp(-((e / b) ** 2)))
                self.dq[i] += (wanted - self.dq[i]) * taken
            else:
                self.dq[i] = e * taken / MILLISECOND
            self.q[i] += MILLISECOND * self.dq[i]


class Loop:
    """Controller, arm and pendulum of one trial."""

    def __init__(self, arm, settings, actuator, pendulum, own, *, horizon, delay=0.0, factor=1.0):
        """Take what the controller knows, and what is different on the plant.

        `own` is the pendulum as it is; `delay` is added to the transport delay [s], and `factor`
        multiplies the lags.
        """
        self.arm, self.settings, self.actuator = arm, settings, actuator
        self.pendulum, self.own, self.horizon = pendulum, own, horizon
        self.delay = 1e3 * actuator.delay.value
        self.transport = round(self.delay + 1e3 * delay)
        self.factor = factor
        self.gains = gains(pendulum, settings.controller, settings.plant.counts_per_rev)
        self.count = 2.0 * pi / settings.plant.counts_per_rev
        self.home = arm.kinematics(arm.home_free)

    def begin(self, q, x, phi, phi_dot, zero=0.0):
        """Start at rest, with the free joints at `q` and the flange at `x`."""
        self.now, self.zero = 0, zero
        self.q, self.dq = np.array(q), np.zeros(6)
        self.x_reference, self.v_reference = x, 0.0
        self.sent = [(-1000, self.q)]
        self.joints = Joints(self.actuator, self.factor, q)
        self.model = Joints(self.actuator, 1.0, q)
        self.commanded = self.flange = self.arm.kinematics(q)
        self.offset = np.zeros(6)
        # What the model did: time [ms], joints, pivot's velocity, flange's x, its tilt.
        self.past = [(-TICK * j, self.model.q.copy(), 0.0, x, 0.0) for j in range(20, -1, -1)]
        self.state = np.array([x, 0.0, phi, phi_dot])
        self.estimate = np.array([phi + zero, phi_dot, 0.0])
        self.v_before = 0.0
        fallen = runge_kutta(phi + zero, phi_dot, 0.0, self.horizon, self.pendulum)
        self.seen = np.array([x, 0.0, *fallen])
        self.tracked = 0.0

    def turn(self, flange):
        """Return sin(angle) times the axis of the turn from the flange to its reference."""
        R = self.home.rotation @ flange.rotation.T
        return 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])

    def step(self, u, noise):
        """Take one tick with the acceleration `u` and the disturbance `noise` of the pose error."""
        v = pivot_velocity(self.arm, self.flange)
        self.command(u, noise)
        for ms in range(self.now, self.now + TICK):
            in_force = [q for time, q in self.sent if time + self.transport <= ms][-1]
            self.joints.millisecond(in_force)
        self.now += TICK
        self.flange = self.arm.kinematics(self.joints.q, self.joints.velocity)
        self.tracked = (pivot_velocity(self.arm, self.flange) - v) / H
        phi, phi_dot = runge_kutta(*self.state[2:], self.tracked, H, self.own)
        x = self.flange.position[0] - self.home.position[0]
        self.state = np.array([x, self.flange.twist[0], phi, phi_dot])
        self.observe()

    def command(self, u, noise):
        """Apply equation (3) to the commanded joints, send two setpoints, let the model follow."""
        K_p, K_d = self.settings.clik.K_p, self.settings.clik.K_d
        flange, along_x = self.commanded, np.eye(6)[0]
        e = np.zeros(6)
        e[:3] = self.home.position - flange.position
        e[3:] = self.turn(flange)
        e += self.x_reference * along_x + noise
        e_dot = self.v_reference * along_x - flange.twist
        Gamma = u * along_x + K_d * e_dot + K_p * e
        ddq = np.linalg.solve(flange.jacobian, Gamma - flange.bias)
        self.x_reference += self.v_reference * H + u * H**2 / 2.0
        self.v_reference += u * H
        for half in (1, 2):
            time = half * H / 2.0
            setpoint = self.q + time * self.dq + time**2 / 2.0 * ddq
            self.sent = [*self.sent[-80:], (self.now + (half - 1) * HALF, setpoint)]
            for _ in range(HALF):
                self.model.millisecond(setpoint)
        self.q, self.dq = self.q + H * self.dq + H**2 / 2.0 * ddq, self.dq + H * ddq
        self.commanded = self.arm.kinematics(self.q, self.dq)
        flange = self.arm.kinematics(self.model.q + self.offset, self.model.velocity)
        v = pivot_velocity(self.arm, flange)
        x = flange.position[0] - self.home.position[0]
        tick = (self.now + TICK, self.model.q.copy(), v, x, -self.turn(flange)[1])
        self.past = [*self.past[-40:], tick]

    def modelled(self, column, time):
        """Return what the model says of a time [ms]: straight lines between ticks, d later."""
        after = next(i for i, row in enumerate(self.past) if row[0] + self.delay >= time - 1e-9)
        t0, t1 = self.past[after - 1][0] + self.delay, self.past[after][0] + self.delay
        y0, y1 = self.past[after - 1][column], self.past[after][column]
        return y0 + (time - t0) / (t1 - t0) * (y1 - y0)

    def observe(self):
        """Measure, estimate, predict."""
        tilt = -self.turn(self.flange)[1]
        theta = pi - (self.state[2] - tilt + self.zero)
        counts = floor(theta / self.count + 0.5)

        unmodelled = self.joints.q - self.modelled(1, self.now)
        correction = CORRECTION
        self.offset = (1.0 - correction) * self.offset + correction * unmodelled

        v = self.modelled(2, self.now)
        phi, phi_dot, bias = self.estimate
        phi, phi_dot = runge_kutta(phi, phi_dot, (v - self.v_before) / H, H, self.pendulum)
        self.v_before = v
        angle = pi - counts * self.count + self.modelled(4, self.now)
        surprise = (angle - bias - phi + pi) % (2.0 * pi) - pi
        self.estimate = np.array([phi, phi_dot, bias]) + self.gains * surprise

        phi, phi_dot, _ = self.estimate
        self.seen = np.array([self.modelled(3, self.now), v, phi, phi_dot])
        if self.horizon == 0.0:
            return
        # The velocity goes straight from tick to tick of the model, then to the reference's.
        ahead = [(row[0] + self.delay - self.now, row[2]) for row in self.past]
        knots = [(1e-3 * time, value) for time, value in ahead if time > 1e-6]
        knots.append((self.horizon, self.commanded.twist[0]))
        begin = 0.0
        for end, v_end in knots:
            u = (v_end - v) / (end - begin)
            phi, phi_dot = runge_kutta(phi, phi_dot, u, end - begin, self.pendulum)
            begin, v = end, v_end
        x = self.commanded.position[0] - self.home.position[0]
        self.seen = np.array([x, v, phi, phi_dot])
