"""Robots and encoders in process, for the conformance suites."""

from equipoise.model.arms.iiwa import iiwa
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import TwinSettings
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.plugins import Session, robot_plugin, sensor_plugin
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.settings import GRAVITY

ARM = iiwa(7)
PENDULUM = PendulumParameters(w2=70.2, k=70.2 / GRAVITY, c=0.15, coulomb=0.1)


class Spun(SimulatedRig):
    """A bench whose spindle a motor turns."""

    motion = None

    @property
    def theta(self):
        return 0.0 if self.motion is None else self.motion(self.now)


def stand(kind=SimulatedRig, **more):
    clock = VirtualClock()
    bench = kind(ARM, PENDULUM, TwinSettings(**more))
    clock.attach(bench.advance)
    return bench, clock


def twin_robot(**more):
    bench, clock = stand(joint_noise=1e-5, **more)  # the suite asks for 0.1 mrad at rest
    clock.wait_until(1.0)  # what hangs on the flange has pulled it down by then
    emulated = robot_plugin("kst").emulate(bench, ARM, Session(clock), 0.002, 0)
    clock.attach(emulated.advance)
    return emulated.device, clock


def twin_encoder(**more):
    """The sensor, its clock, what turns its spindle, what presses its button, and its age."""
    bench, clock = stand(Spun, **more)

    def turn(motion):
        bench.motion = motion

    emulated = sensor_plugin("serial").emulate(bench, clock, 8192, 1, 0)
    clock.attach(emulated.advance)
    return emulated.device, clock, turn, bench.press, emulated.link.close, 0.005
