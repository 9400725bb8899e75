"""Simulated rigs in process, in virtual time."""

from equipoise.arm.iiwa import iiwa
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import TwinSettings
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.simulated_rig import Bodies, SimulatedRig
from equipoise.settings import GRAVITY

ARM = iiwa(7)
PENDULUM = PendulumParameters(w2=70.2, k=70.2 / GRAVITY, c=0.15)


def stand(seed=0, **more):
    clock = VirtualClock()
    bench = SimulatedRig(Bodies(ARM, PENDULUM, TwinSettings(), ARM.home_free, 0.0, seed), **more)
    clock.attach(bench.advance)
    return bench, clock
