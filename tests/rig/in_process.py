"""Simulated rigs in process, in virtual time."""

from equipoise.model.arms.iiwa import iiwa
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import TwinSettings
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.plugins import Session, robot_plugin
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.settings import GRAVITY

ARM = iiwa(7)
PENDULUM = PendulumParameters(w2=70.2, k=70.2 / GRAVITY, c=0.15)


def stand(settings=None, **more):
    clock = VirtualClock()
    bench = SimulatedRig(ARM, PENDULUM, settings or TwinSettings(), **more)
    clock.attach(bench.advance)
    return bench, clock


def twin_robot():
    bench, clock = stand(TwinSettings(joint_noise=1e-5))  # the suite asks for 0.1 mrad at rest
    clock.wait_until(1.0)  # what hangs on the flange has pulled it down by then
    emulated = robot_plugin("kst").emulate(bench, ARM, Session(clock), 0.002, 0)
    clock.attach(emulated.advance)
    return emulated.device, clock
