"""Runs on an emulated rig from the checklist until they balance, with the twin's own hand.

Robot and encoder speak the bytes of the hardware, in virtual time; the run is the whole of
`equipoise.rig.run`. The pendulum that hangs there is the policy's, but for what identifying
it leaves open and for what a fault makes of it.
"""

from math import degrees, nan, radians, sqrt
from typing import NamedTuple

import numpy as np

from equipoise.control.policy import shipped_policy
from equipoise.identification.self_test import SelfTestVerdict
from equipoise.model.worlds import pendulum_on, read_world
from equipoise.outcomes import Phase
from equipoise.rig.config import RigSettings
from equipoise.rig.connection import emulated_rig
from equipoise.rig.emulated_operator import EmulatedOperator
from equipoise.rig.request import RunRequest
from equipoise.rig.run import run_virtually
from equipoise.rig.run_controller import PHASES
from equipoise.worlds.plant import scaled

WORLD = "twin:nominal"
IDENTIFIED = 0.005
"""A free swing tells w2 to this share (one standard deviation)."""
FRICTION = 0.2
"""... and the friction is another one each day, by this share."""
LATER = 0.03
"""Delay of the encoder's link as a fault [s]."""
OFF = radians(1.0)
"""So far from where it hangs the pendulum is referenced, as a fault [rad]."""
BALANCED = 10.0
"""A pendulum that was let go shall stand so long [s]."""
NUMBER_OF = {phase: PHASES.index(phase) for phase in Phase}


class Hands:
    """Hands that hold the pendulum for as long as they like, and let go once they may."""

    def __init__(self, bench, clock, *, clumsy, seed):
        self._bench, self._clumsy = bench, clumsy
        self._due, self._may = None, False
        self.manner = None
        """How the pendulum was lifted last."""
        self.released = None
        """When it was let go after that [s]; none before."""
        self.operator = EmulatedOperator(bench, clock, clumsy=clumsy, seed=seed)
        self._give_a_nudge = self.operator.acts["nudge"]
        self.operator.acts |= {
            "lift": self._lift,
            "armed": self._may_let_go,
            "disarmed": self._hold_on,
            "nudge": self._nudge,
        }
        bench.watch(self._let_go_when_due)

    def _lift(self):
        self.manner = self._bench.lift(clumsy=self._clumsy)
        self._due, self._may = self._bench.hand.arrives() + self.manner.holding, False
        self.released = None

    def _may_let_go(self):
        self._may = True

    def _hold_on(self):
        self._may = False
        if not self._bench.hand.holds:
            self._lift()

    def _nudge(self):
        if not self._bench.hand.holds:
            self._give_a_nudge()

    def _let_go_when_due(self):
        if self._may and self._due is not None and self._bench.now >= self._due:
            self._bench.let_go()
            self._due, self.released = None, self._bench.now


class Start(NamedTuple):
    """How a hold and its release ended."""

    clumsy: bool
    """Whether the hand pushed or dragged."""
    held: float
    """How long the hand held the pendulum upright [s]."""
    denied: int
    """How often it was found to be still on, in the whole run, and was."""
    unasked: int
    """How often it let go although it had just been told that it was still on."""
    early: bool
    """Whether the policy began before the fingers began to open."""
    after: float
    """From the release to the start [s]; NaN where it was not seen."""
    grown_deg: float
    """phi + phi_dot / w at the start, as the twin knows it [deg]; NaN likewise."""
    lasted: float
    """How long it balanced [s]."""
    cause: str
    """What ended the run."""


class Watching:
    """Stands between heart and loop, and beside the operator, and takes notes."""

    def __init__(self, bench, hands, w, only_tested):
        self._bench, self._hands, self._w = bench, hands, w
        self._heart, self._state, self._released = None, None, None
        self._stop = []
        self.only_tested = only_tested
        self.results = []
        """What the self-tests said."""
        self.denied = self.unasked = 0
        self.early = False
        self.held, self.after, self.grown_deg = nan, nan, nan
        self._asked = False

    def around(self, heart):
        self._heart = heart
        return self

    @property
    def h(self):
        return self._heart.h

    def tick(self, now, inputs):
        if inputs.result is not None:
            self.results.append(inputs.result)
            if self.only_tested:
                self._stop.append("stop")
        released = self._hands.released
        if released is not None and released != self._released:
            self._asked = self._state is Phase.ARMED
            self.unasked += not self._asked
            self.held = released - self._bench.hand.arrives()
        self._released = released
        output = self._heart.tick(now, inputs)
        state = PHASES[output.state]
        if state is Phase.BALANCING and self._state is Phase.ARMED:
            truth = self._bench.truth()
            self.early = released is None
            self.after = nan if self.early else now - released
            self.grown_deg = degrees(truth.phi + truth.phi_dot / self._w)
        elif state is Phase.LIFTING and self._state is Phase.ARMED:
            self.denied += released is None
            if released is not None and self._asked:  # it was not seen to fall
                self._stop.append("stop")
        self._state = state
        return output

    def notify(self, event):
        pass

    def read_input(self):
        said, self._stop = self._stop, []
        return said


def stage(seed, *, share=1.0, clumsy=0.0, duration=BALANCED):
    """Return a request, an emulated rig and the hands at it; w2 is another one by a share."""
    random = np.random.default_rng([seed, 11])
    policy, settings = shipped_policy(), RigSettings()
    inertia = (1.0 + IDENTIFIED * random.standard_normal()) / share
    friction = 1.0 + FRICTION * random.standard_normal()
    world = read_world(WORLD)
    real = scaled(pendulum_on(policy.pendulum, world.settings), inertia, friction)
    emulated = emulated_rig(world, settings, real, seed=seed, robot="kst")
    rig = emulated.rig
    hands = Hands(emulated.bench, rig.clock, clumsy=clumsy, seed=seed)
    request = RunRequest(
        policy=policy, actuator=policy.actuator, settings=settings, robot="kst://emulated",
        encoder="serial://emulated", duration=duration, t1=False, dry_run=False, seed=seed,
    )  # fmt: skip
    return request, emulated._replace(rig=rig._replace(operator=hands.operator)), hands


def run(seed, *, fault=None, only_tested=False, **given):
    """Return what was seen of a run, the hands, and its outcome; the rig may have a fault."""
    request, emulated, hands = stage(seed, **given)
    if fault is not None:
        fault(emulated)
    w = sqrt(request.policy.pendulum.parameters().w2)
    watching = Watching(emulated.bench, hands, w, only_tested)
    outcome = run_virtually(
        request, None, rig=emulated.rig, operator=watching, wrap=watching.around
    )
    return watching, hands, outcome


def start(seed, **given):
    """Return how a hold and its release ended, the hand drawn from a seed."""
    seen, hands, outcome = run(seed, **given)
    return Start(
        hands.manner.clumsy, seen.held, seen.denied, seen.unasked, seen.early, seen.after,
        seen.grown_deg, outcome.lasted, outcome.outcome,
    )  # fmt: skip


def _attribute(name, value):
    return lambda emulated: setattr(emulated.sensor.emulator, name, value)


def _late(emulated):
    emulated.sensor.link.delay += LATER


def _askew(emulated):
    """Let a finger hold the pendulum beside where it hangs until it is referenced."""
    bench = emulated.bench
    steady = bench.steady

    def beside():
        steady()
        bench.hand._to += OFF if bench.seed % 2 else -OFF

    bench.steady = beside


FAULTS = {
    "nothing": (SelfTestVerdict.PASSED, {}),
    "sign": (SelfTestVerdict.SIGN, {"fault": _attribute("sign", -1)}),
    "counts x 1/2": (SelfTestVerdict.COUNTS, {"fault": _attribute("factor", 0.5)}),
    "counts x 1.1": (SelfTestVerdict.COUNTS, {"fault": _attribute("factor", 1.1)}),
    "w2 + 10 %": (SelfTestVerdict.W2, {"share": 1.1}),
    "w2 - 10 %": (SelfTestVerdict.W2, {"share": 0.9}),
    "30 ms": (SelfTestVerdict.DELAY, {"fault": _late}),
    "zero": (SelfTestVerdict.ZERO, {"fault": _askew}),
}
"""What the self-test has to say, and what is wrong with the rig."""


def verdict(kind, seed):
    """Return what the first self-test of a run says; none where it came to none."""
    seen, _, outcome = run(seed, only_tested=True, **FAULTS[kind][1])
    return seen.results[0].verdict if seen.results else outcome
