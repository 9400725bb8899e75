"""Runs on the twin that balance from a prepared state, and are made to fail in a known way.

What comes before the release is left out: the pendulum stands at an angle, the encoder knows its
zero, and the policy takes over. Then one thing goes wrong.
"""

from math import pi
from typing import NamedTuple

import numpy as np

from equipoise.control.baselines import pd_gains
from equipoise.control.policy import LINEAR, KernelPolicy, PolicyKernel, shipped_policy
from equipoise.logs.recorder import Recorder
from equipoise.logs.writer import RunWriter
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import pendulum_on, read_world
from equipoise.outcomes import Outcome
from equipoise.rig.clocks import DrainingClock, VirtualClock
from equipoise.rig.config import RigSettings
from equipoise.rig.explanation import RootCause
from equipoise.rig.guarded import GuardedRobot
from equipoise.rig.loop import run_loop
from equipoise.rig.phases.balancing import Balancing
from equipoise.rig.phases.context import ArmResponse
from equipoise.rig.plugins import Session, robot_plugin
from equipoise.rig.request import RunRequest
from equipoise.rig.run import run_end
from equipoise.rig.run_controller import RunController
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.rig.transports import memory_pipe
from equipoise.robots.encoder.board import Board
from equipoise.robots.encoder.sensor import LineEncoder
from equipoise.worlds.plant import scaled

WORLD = "twin:nominal"


class LateClock(VirtualClock):
    """A clock whose waiter is woken late once."""

    def __init__(self):
        super().__init__()
        self.oversleep = 0.0

    def wait_until(self, moment):
        late, self.oversleep = self.oversleep, 0.0
        super().wait_until(moment + late)


class Silent:
    """Nobody speaks."""

    def __init__(self):
        self.said = []

    def notify(self, event):
        pass

    def read_input(self):
        said, self.said = self.said, []
        return said


class Fault(NamedTuple):
    """What goes wrong; each may be left out."""

    name: Outcome | RootCause
    """What has to be named."""
    start: tuple = (0.03, 0.2)
    """phi [rad] and phi_dot [rad/s] at the release."""
    at: float = 1.0
    """When it goes wrong [s]."""
    once: object = None
    """Called then with the rig."""
    each: object = None
    """Called in each millisecond from then on."""
    policy: object = None
    """Decides instead of the shipped one."""
    u_max: float | None = None
    """Its largest acceleration [m/s^2]."""
    zero: float = 0.0
    """Error of the zero [rad]."""
    limits: object = None
    """Changes the limits that the controller minds."""


class Stage:
    """Everything that a fault can reach."""

    def __init__(self, seed, start):
        self.clock = LateClock()
        world, policy = read_world(WORLD), shipped_policy()
        self.request = RunRequest(
            policy=policy, actuator=policy.actuator, settings=RigSettings(), robot=WORLD,
            encoder=None, duration=5.0, t1=False, dry_run=False, seed=seed,
        )  # fmt: skip
        arm = self.request.settings.described_arm
        random, there = np.random.default_rng([seed, 5]), world.settings
        inertia = 1.0 + there.inertia_sigma * random.standard_normal()
        friction = 1.0 + there.friction_sigma * random.standard_normal()
        # What nobody knows: the real pendulum, and how far its zero is off before any fault.
        real = scaled(pendulum_on(policy.pendulum, there), inertia, friction)
        self.zero = float(random.uniform(-there.zero_error, there.zero_error))
        delay = 0.5 * there.reply_age
        there = there.model_copy(update={"transport": there.transport - delay})
        self.bench = SimulatedRig(arm, PendulumParameters(*real), there, seed=seed)
        self.clock.attach(self.bench.advance)
        self.held = pi - start[0]
        self.board = Board(lambda: self.bench.theta if self.held is None else self.held, seed=seed)
        reader, wire = memory_pipe(self.clock, world.settings.encoder_age)

        def work(now):
            self.board.feed(wire.read())
            wire.write(self.board.advance(now))

        self.clock.attach(work)
        self.sensor = LineEncoder(lambda: reader, self.clock, counts_per_rev=8192)
        session = Session(DrainingClock(self.clock, self.sensor))
        emulated = robot_plugin("kst").emulate(self.bench, arm, session, delay, seed)
        self.clock.attach(emulated.advance)
        self.robot = emulated.device
        self.operator = Silent()


def run_with(fault, seed, path):
    """Let a run fail, and write its log."""
    stage = Stage(seed, fault.start)
    request, bench, clock = stage.request, stage.bench, stage.clock
    guard, controller = request.guard(8192), request.controller(8192)
    if fault.limits is not None:
        controller = controller._replace(limits=fault.limits(controller.limits))
    period = request.policy.h / 2.0
    robot = GuardedRobot(stage.robot, guard.limits, period)
    stage.sensor.connect()
    stage.robot.connect()
    stage.sensor.samples()
    robot.start()
    policy = KernelPolicy(fault.policy or request.policy.kernel)
    pilot = RunController(
        request.parts(policy, lambda: 0.0, 8192),
        ArmResponse(request.actuator, controller, guard),
        robot.started_at,
    )
    phi, phi_dot = fault.start
    bodies = bench.twin.kernel.bodies
    bodies.qpos[bench.joints], bodies.qvel[bench.joints] = phi, phi_dot
    stage.held = None
    begin_balancing(pilot, clock.now(), fault, stage)
    recorder = Recorder(7)
    conditions = request.conditions()
    if fault.u_max is not None:
        conditions = conditions.model_copy(update={"u_max": fault.u_max})
    writer = RunWriter(path, conditions, clock.now())
    began, struck = clock.now(), []

    def go_wrong(now):
        if now - began < fault.at:
            return
        if fault.once is not None and not struck:
            struck.append(now)
            fault.once(stage)
        if fault.each is not None:
            fault.each(stage)

    clock.attach(go_wrong)
    ending = run_loop(
        robot, stage.sensor, clock, pilot, recorder, stage.operator, max_duration=10.0,
        idle=lambda: writer.drain(recorder) if recorder.pulse["ticks"] % 50 == 0 else None,
    )  # fmt: skip
    writer.drain(recorder)
    outcome = run_end(pilot, ending)
    writer.finish(clock.now(), outcome)
    return outcome


def begin_balancing(pilot, now, fault, stage):
    """Let a pilot balance at once, as after a release."""
    phi, phi_dot = fault.start
    counts_per_radian = 8192 / (2.0 * pi)
    zero = -(pi - phi) * counts_per_radian + (fault.zero + stage.zero) * counts_per_radian
    run = pilot
    run.encoder.zero = zero
    run.controller.begin(phi, phi_dot)
    run.joints.time = now
    run.joints.torque_at_home = np.array(stage.bench.body.torques(True))
    run.phase, run.began = Balancing(run), now


def draw_fault(kind, seed):
    """Return a fault of a kind, its numbers drawn."""
    random = np.random.default_rng([seed, 77])

    def either(low, high):
        return float(random.uniform(low, high) * random.choice((-1.0, 1.0)))

    sign = float(random.choice((-1.0, 1.0)))
    at = float(random.uniform(0.9, 1.6))
    start = sign * np.deg2rad(random.uniform(1.5, 2.5)), sign * np.deg2rad(random.uniform(8, 18))
    if kind == "outside":
        out = sign * np.deg2rad(random.uniform(12.5, 17.0))
        share = float(random.uniform(0.2, 0.5))
        return Fault(RootCause.OUTSIDE, start=(share * out, (1.0 - share) * out * 8.4))
    plain = Fault(Outcome.ERROR, start=start, at=at)
    if kind == "push":
        rate = either(2.0, 3.5)
        return plain._replace(name=RootCause.PUSH, once=lambda s: s.bench.push(rate))
    if kind == "track":
        gains = pd_gains(shipped_policy().pendulum.parameters())
        return plain._replace(
            name=Outcome.TRACK, policy=PolicyKernel(LINEAR, gains=gains), u_max=2.0
        )
    if kind == "late":
        late = float(random.uniform(0.08, 0.15))
        return plain._replace(name=Outcome.TICK, once=lambda s: setattr(s.clock, "oversleep", late))
    if kind == "silent":
        return plain._replace(
            name=Outcome.ENCODER_STALE, once=lambda s: setattr(s.board, "silent", True)
        )
    if kind == "frozen":
        return plain._replace(
            name=Outcome.ENCODER_STALE, once=lambda s: setattr(s.board, "frozen", True)
        )
    if kind == "jump":
        counts = round(either(20, 600))
        return plain._replace(name=Outcome.ENCODER_JUMP, once=lambda s: s.board.jump(counts))
    if kind == "lines":
        return plain._replace(name=Outcome.ENCODER_JUMP, once=lambda s: s.board.skip(5))
    if kind == "zero":
        return plain._replace(name=RootCause.ZERO, zero=float(np.deg2rad(either(3.0, 6.0))))
    if kind == "creep":
        speed = np.deg2rad(either(3.0, 10.0)) * 1e-3
        return plain._replace(name=RootCause.ZERO, each=lambda s: s.bench.slip(speed))
    if kind == "loss":
        share = float(random.uniform(0.35, 0.7))
        return plain._replace(name=RootCause.ZERO, once=lambda s: setattr(s.board, "loss", share))
    if kind == "weak":
        share = float(random.uniform(0.18, 0.24))
        kernel = shipped_policy().kernel
        return plain._replace(
            name=RootCause.SATURATION,
            start=(sign * np.deg2rad(0.5), sign * np.deg2rad(3.0)),
            policy=kernel._replace(u_of_box=share * kernel.u_of_box),
            u_max=2.0 * share,
        )
    if kind == "joint":
        share = float(random.uniform(0.02, 0.15))

        def narrow(limits):
            limits = limits.copy()
            limits[2:] *= share
            return limits

        return plain._replace(name=Outcome.JOINT_LIMIT, limits=narrow)
    if kind == "contact":
        force = either(120.0, 250.0)
        return plain._replace(name=Outcome.TORQUE, once=lambda s: s.bench.touch([0.0, force, 0.0]))
    if kind == "stop":
        return plain._replace(
            name=Outcome.NOT_FOLLOWING, once=lambda s: s.bench.body.stop("emergency stop")
        )
    raise ValueError(kind)


KINDS = (
    "outside", "push", "track", "late", "silent", "frozen", "jump", "lines", "zero", "creep",
    "loss", "weak", "joint", "contact", "stop",
)  # fmt: skip
