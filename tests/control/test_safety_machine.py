"""States, guard and stop together, whatever happens in whatever order.

The stream below is the least that a run needs around them: in each tick it asks the guard, lets the
state move, takes the next setpoint (the path home, a hold, random commands that keep the joints'
limits or do not, the ramp, the way back) and sends it if the guard lets it. The arm follows, or
freezes with its brakes on, as it likes.
"""

from math import isfinite, nan

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
)

from equipoise.control.minimum_jerk import path_within
from equipoise.control.safety import (
    EXPECTED_MOTION,
    MonitorState,
    Rule,
    SafetyInputs,
    Violation,
    check,
    check_first,
    check_setpoint,
    make_safety_params,
    update_monitor,
)
from equipoise.control.states import LATCHED, STREAMING, Cause, Phase, RunEvent, RunState, step
from equipoise.control.stop import RETURN_SHARE, ramp, stoppable_speeds, way_back
from equipoise.model.arms.iiwa import iiwa

ARM = iiwa(14)
H = 0.01
GUARD = make_safety_params(ARM, reaction=0.03, u_max=2.0, h=H, counts_per_rev=8192)
LIMITS = GUARD.limits
REST = (0.0,) * LIMITS.joints
LONGEST_STOP = 200
"""Ticks: the slowest ramp takes 0.25 s at the speeds below, the way back less than 1.5 s."""

NEXT = {
    Phase.IDLE: RunEvent.START,
    Phase.HOMING: RunEvent.ARRIVED,
    Phase.AT_HOME: RunEvent.CONFIRMED,
    Phase.REFERENCING: RunEvent.REFERENCED,
    Phase.SELF_TEST: RunEvent.PASSED,
    Phase.EXCITING: RunEvent.PASSED,
    Phase.LIFTING: RunEvent.ARMED,
    Phase.ARMED: RunEvent.RELEASED,
}
"""What leads to balancing."""

joints = st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7)


class Run(RuleBasedStateMachine):
    @initialize(away=joints)
    def connect(self, away):
        self.state = RunState()
        self.measured = tuple(q + 0.05 * a for q, a in zip(ARM.home, away, strict=True))
        self.frozen = False
        self.sent: list[tuple[tuple[float, ...], tuple[float, ...]]] = []
        self.violation: Violation | None = None
        self.ticks_since_stop = 0
        self.begin_anew()

    def begin_anew(self):
        self.last = self.before = self.target = None
        self.dq = REST
        self.watched = MonitorState()
        self.ramp = self.back = None
        self.time = 0.0

    # What happens.

    @rule(
        event=st.sampled_from(
            [e for e in RunEvent if e not in (RunEvent.REARMED, RunEvent.AT_REST)]
        )
    )
    def anything_is_reported(self, event):
        before = self.state
        # The servo starts only when it is asked to, and then holds what is measured.
        self.move(event, Cause("event", "told"))
        if before.phase is Phase.IDLE and self.state.phase is Phase.HOMING:
            self.begin_anew()
            self.path = path_within(
                self.measured,
                ARM.home,
                [RETURN_SHARE * v for v in LIMITS.velocity],
                LIMITS.acceleration,
            )
        if self.state.phase in LATCHED:
            assert self.state.cause is not None

    @precondition(lambda self: self.state.phase in NEXT)
    @rule(steps=st.integers(1, len(NEXT)))
    def all_goes_well(self, steps):
        for _ in range(steps):
            while self.state.phase is Phase.HOMING and self.time < self.path.duration:
                self.tick([0.0] * 7, 0.0, SafetyInputs())
            if self.state.phase in NEXT:
                self.anything_is_reported(NEXT[self.state.phase])

    @rule()
    def the_operator_re_arms(self):
        before = self.state
        self.move(RunEvent.REARMED)
        if before.phase is Phase.STOPPED:
            assert self.state == RunState()
            self.frozen = False

    @rule()
    def brakes(self):
        self.frozen = True

    @rule(share=joints, wild=st.sampled_from([0.0, 0.0, 0.0, 0.4, 3.0, nan]))
    def a_tick(self, share, wild):
        self.tick(share, wild, SafetyInputs())

    @rule(share=joints, n=st.integers(2, 40))
    def ticks(self, share, n):
        for _ in range(n):
            self.tick(share, 0.0, SafetyInputs())

    @precondition(lambda self: self.state.phase in STREAMING)
    @rule(
        view=st.sampled_from(
            [
                SafetyInputs(lateness=0.08),
                SafetyInputs(overdue=0.08),
                SafetyInputs(x=0.23, on_track=True),
                SafetyInputs(x=nan),
                SafetyInputs(torque=(0.0, 50.0, 0.0, 0.0, 0.0, 0.0, 0.0)),
                SafetyInputs(encoder_age=0.08),
                SafetyInputs(encoder_jump=1.0),
                SafetyInputs(phi=0.2, balancing=True),
            ]
        )
    )
    def something_is_wrong(self, view):
        before, n, last = self.state, len(self.sent), self.last
        self.tick([0.0] * 7, 0.0, view)
        if view.overdue:
            assert self.state.phase is Phase.LOST
            assert len(self.sent) == n
        elif not before.latched:
            assert self.state.phase in (Phase.STOPPING, Phase.STOPPED)
            assert self.state.cause is not None
            # The first decelerating setpoint leaves in the very tick.
            if last is not None:
                assert len(self.sent) == n + 1
                moving = np.abs(np.array(self.sent[-1][0]) - last)
                assert np.all(moving <= np.abs(self.speed_before) * H + 1e-12)
                fast = np.abs(self.speed_before) > 1e-6
                assert np.all(moving[fast] < np.abs(self.speed_before)[fast] * H)

    # The stream.

    def move(self, event, cause=None):
        before = self.state
        self.state = step(before, event, cause)
        if before.phase is not Phase.STOPPING and self.state.phase is Phase.STOPPING:
            self.ticks_since_stop = 0
            q = self.last if self.last is not None else self.measured
            if self.last is not None:
                self.dq = stoppable_speeds(self.dq, self.last, self.before, H)
            speed = float(
                np.linalg.norm(
                    ARM.kinematics(ARM.without_held(q), ARM.without_held(self.dq)).twist[:3]
                )
            )
            self.ramp, self.back, self.time = ramp(q, self.dq, speed, LIMITS), None, 0.0

    def stop_for(self, violation):
        self.violation = violation
        event = RunEvent.LOST if violation.rule is Rule.LINK else RunEvent.STOP
        self.move(event, Cause(violation.rule.value, violation.reason, violation.from_measured))

    def tick(self, share, wild, view):
        if self.state.phase not in STREAMING:
            return
        self.speed_before = self.dq
        if self.last is not None:
            view = view._replace(measured=self.measured, expected=self.last)
        self.watched = update_monitor(GUARD, self.watched, view)
        violation = check(GUARD, self.watched, view)
        if violation:
            self.stop_for(violation)
        if self.state.phase not in STREAMING:
            return
        setpoint, dq = self.next(share, wild)
        broken = self.judge(setpoint)
        if broken:
            # A setpoint that may not be sent is not sent: the ramp takes its place.
            assert self.state.phase is not Phase.STOPPING, broken
            self.stop_for(broken)
            setpoint, dq = self.next(share, wild)
            assert self.judge(setpoint) is None
        self.send(setpoint, dq)
        if self.state.phase is Phase.STOPPING:
            self.ticks_since_stop += 1
            if self.rests():
                self.move(RunEvent.AT_REST)

    def judge(self, setpoint):
        if self.last is None:
            return check_first(LIMITS, setpoint, self.measured)
        to_rest = self.state.phase is Phase.STOPPING
        return check_setpoint(LIMITS, setpoint, self.last, self.before, H, to_rest)

    def next(self, share, wild):
        phase = self.state.phase
        self.time += H
        if phase is Phase.STOPPING:
            return self.towards_rest()
        if self.last is None:
            self.time = 0.0
            return self.measured, REST
        if phase is Phase.HOMING:
            q, dq, _ = self.path.at(self.time)
            return q, dq
        if phase is Phase.BALANCING:
            # Random accelerations of all joints; too wild ones break a limit.
            a = [
                (0.3 + wild) * s * limit
                for s, limit in zip(share, LIMITS.acceleration, strict=True)
            ]
            dq = tuple(v + H * acc for v, acc in zip(self.dq, a, strict=True))
            mean = [0.5 * (v + w) for v, w in zip(self.dq, dq, strict=True)]
            return tuple(q + H * v for q, v in zip(self.last, mean, strict=True)), dq
        # Held; whoever leaves the path home early comes to rest by the ramp.
        if any(self.dq):
            self.stop_for(Violation(Rule.VELOCITY, "held while moving", 1.0, 0.0))
            return self.towards_rest()
        return self.last, REST

    def towards_rest(self):
        if self.ramp is not None and self.last is None:
            return self.measured, REST
        self.time = max(self.time, H)
        if self.time <= self.ramp.duration + H or not self.state.from_measured:
            return self.ramp.at(self.time), self.ramp.speed_at(self.time)
        if self.back is None:
            self.back = (way_back(self.last, self.measured, LIMITS), self.time - H)
        path, begin = self.back
        q, dq, _ = path.at(self.time - begin)
        return q, dq

    def rests(self):
        if self.time < self.ramp.duration + H:
            return False
        if not self.state.from_measured:
            return True
        return self.back is not None and self.time >= self.back[1] + self.back[0].duration

    def send(self, setpoint, dq):
        self.sent.append((setpoint, self.last or setpoint))
        self.before = self.last if self.last is not None else setpoint
        self.last, self.dq = setpoint, dq
        if not self.frozen:
            self.measured = setpoint

    # What always holds.

    @invariant()
    def every_command_is_finite_inside_the_limits_and_near_the_last(self):
        for q, last in getattr(self, "sent", [])[-50:]:
            assert len(q) == 7
            assert all(isfinite(angle) for angle in q)
            for angle, other, low, high, v in zip(
                q, last, LIMITS.lower, LIMITS.upper, LIMITS.velocity, strict=True
            ):
                assert low <= angle <= high
                assert abs(angle - other) <= v * H * (1.0 + 1e-5)

    @invariant()
    def a_stop_ends_at_rest(self):
        assert self.state.phase is not Phase.STOPPING or self.ticks_since_stop < LONGEST_STOP
        if self.state.phase is Phase.STOPPED and self.last is not None and self.sent:
            np.testing.assert_allclose(self.dq, 0.0, atol=1e-12)
            if self.state.from_measured:
                assert np.max(np.abs(np.subtract(self.last, self.measured))) < EXPECTED_MOTION

    def teardown(self):
        """From wherever the run is, a stop is possible, at rest in the end, and latched."""
        if getattr(self, "state", None) is None or self.state.phase is Phase.LOST:
            return
        if self.state.phase in STREAMING:
            self.move(RunEvent.STOP, Cause("key", "pressed"))
        for _ in range(LONGEST_STOP):
            self.tick([0.0] * 7, 0.0, SafetyInputs())
        if self.state.phase in (Phase.STOPPED, Phase.LOST):
            n, state = len(self.sent), self.state
            for event in RunEvent:
                if event not in (RunEvent.REARMED, RunEvent.LOST):
                    self.move(event, Cause("late", "late"))
                self.tick([1.0] * 7, 0.0, SafetyInputs())
            assert (self.state.phase, len(self.sent)) == (state.phase, n)
        else:
            assert self.state.phase is Phase.IDLE, self.state


TestRun = Run.TestCase
TestRun.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
