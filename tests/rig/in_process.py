"""Simulated rigs in process, in virtual time."""

from equipoise.model.arms.iiwa import iiwa
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import TwinSettings
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.settings import GRAVITY

ARM = iiwa(7)
PENDULUM = PendulumParameters(w2=70.2, k=70.2 / GRAVITY, c=0.15)


def stand(settings=None, **more):
    clock = VirtualClock()
    bench = SimulatedRig(ARM, PENDULUM, settings or TwinSettings(), **more)
    clock.attach(bench.advance)
    return bench, clock
