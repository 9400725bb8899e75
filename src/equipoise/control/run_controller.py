"""A run on a rig, from the first setpoint to rest, as one value that measurements go into.

The phases are those of `equipoise.control.states`: the way home, confirmed there; the reference,
the pendulum hanging; the self-test swing, and the zero from its decay; the pendulum is lifted,
stands still in the hand, is let go; the policy balances; a ramp to rest. Any failure leads to that
ramp from wherever the arm is, within the tick that sees it, and nothing leads back.

Nothing here knows a clock, a link or a file. Equal inputs give equal outputs: a log fed through it
again gives the same setpoints.

A tick's two setpoints are where the arm shall be half a tick later and a whole one, as in the
training (`equipoise.control.control_step`).
"""

from collections.abc import Callable, Sequence
from functools import partial
from math import cosh, inf, isfinite, isnan, nan, pi, sinh, sqrt
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from equipoise.control import states
from equipoise.control.control_step import ControllerParams
from equipoise.control.controller import Controller, FlangeKinematics, FlangePose
from equipoise.control.dropouts import DropoutMonitor
from equipoise.control.minimum_jerk import Path, path_within
from equipoise.control.policy import Policy
from equipoise.control.release import ReleaseDetector, ReleaseState
from equipoise.control.safety import (
    MonitorState,
    SafetyInputs,
    SafetyParams,
    check,
    newest_before,
    unexplained,
    update_monitor,
)
from equipoise.control.self_test import (
    MOVE_TIME,
    SWING_TIME,
    SelfTest,
    SelfTestVerdict,
    excitation,
    self_test,
)
from equipoise.control.states import Cause, Phase, RunState
from equipoise.control.stop import Ramp, at_rest, ramp, stoppable_speeds, way_back
from equipoise.control.ticks import (
    OK,
    EncoderSample,
    Job,
    OperatorMessage,
    RobotReply,
    TickInputs,
    TickOutput,
    TickRecord,
)
from equipoise.model.arms.arm import Arm
from equipoise.printable import printable

Array = npt.NDArray[np.float64]
Setpoints = tuple[tuple[float, ...], tuple[float, ...]]

HOMING_SHARE: Final = 0.1
"""Share of the joints' velocity and acceleration limits on the way home [-]."""
YES_OR_NO: Final = ("y", "n")
REST_TIME: Final = 2.0
"""Time for which the count has to stay within one before it is a reference [s]."""
FALL_WINDOW: Final = 0.04
"""Window for estimating the state at release [s]."""
UNCERTAIN_TORQUE_FACTOR: Final = 2.0
"""Factor on the torque limits before the torques at home are known [-]; those at the start of the
servo replace them, and the load on the flange pulls differently there."""
SETTLING_TIME: Final = 0.5
"""Time for which the arm is held after a ramp before the servo ends [s]."""
REST_BEFORE: Final = 0.3
"""Observation of the pendulum before it is moved [s]."""
RETURN_TIME: Final = 1.6
"""Duration of the way back from the self-test [s]: twice that of the way out."""
MAX_SWINGS: Final = 4
"""Maximum number of swings of a self-test whose zero is not sharp enough."""
NUDGE_INTERVAL: Final = 5.0
"""Time after which the operator is reminded of an armed pendulum that is not let go [s]."""
POLICY: Final = "policy"
"""Name of the cause of a stop where the policy raises, is late, or returns no finite number."""
FAILED: Final = "the policy failed"
LATE: Final = "it took"
"""Beginning of the reason of such a stop, and of its second part where the policy is late."""
POLICY_TIME_SHARE: Final = 0.5
"""Longest computing time of the policy, as a share of a tick: later, the second setpoint, due after
half a tick, would be late too."""
EXPECTED_HISTORY: Final = 64
"""Number of samples in memory for the fit at the release: 64 ms at 1 kHz."""


MOVING: Final = frozenset({Phase.HOMING, Phase.SELF_TEST, Phase.BALANCING})
"""Phases in which even a stray Enter stops."""
ON_TRACK: Final = frozenset(
    {Phase.SELF_TEST, Phase.LIFTING, Phase.ARMED, Phase.BALANCING, Phase.REFERENCING, Phase.AT_HOME}
)
"""Phases in which the flange has to be on its line."""
PHASES: Final = tuple(Phase)
"""Phases by the index that logs use."""


class RunController:
    """Controller of a run: phases, safety rules, policy."""

    def __init__(
        self,
        arm: Arm,
        controller: ControllerParams,
        policy: Policy,
        guard: SafetyParams,
        q: Sequence[float],
        *,
        duration: float,
        clock: Callable[[], float] = lambda: 0.0,
    ) -> None:
        """Begin the way home, the servo holding the arm where it stands.

        Args:
            arm: The arm with its home.
            controller: Constants of the control step, with the rig's counts per revolution.
            policy: Any policy.
            guard: The rules of the rig.
            q: Where the arm is measured, all joints [rad].
            duration: How long it shall balance [s].
            clock: Time [s] for the policy's computing; by default it takes none.
        """
        self._arm, self._controller, self._policy, self._guard = arm, controller, policy, guard
        self._lane, self._flange = Controller(arm, controller), FlangeKinematics(arm, controller)
        self._resolution = controller.resolution
        self._release = ReleaseDetector(controller.pendulum)
        self._duration, self._clock = duration, clock
        self._h = controller.h
        self._events: list[OperatorMessage] = []
        self._answers: tuple[str, ...] = ()
        self._answer: str | None = None
        self.state = states.step(RunState(), states.RunEvent.START)
        """State of the run, with the cause of a stop."""
        self.began: float | None = None
        """Time at which the policy began to act [s]."""
        self.ended: float | None = None
        """Time at which it ended [s]."""
        self.zero: float | None = None
        """Count of the hanging pendulum."""

        self._q, self._dq = tuple(q), (0.0,) * len(q)
        limits = [(joint.velocity, joint.acceleration) for joint in arm.joints]
        self._path = path_within(
            self._q,
            arm.home,
            [HOMING_SHARE * velocity for velocity, _ in limits],
            [HOMING_SHARE * acceleration for _, acceleration in limits],
        )
        self._ramp: Ramp = at_rest(self._q)
        self._back: Path | None = None
        self._back_since = 0
        self.phase_before = Phase.IDLE
        self._rested = False
        self._watch = MonitorState()
        self._commanded = np.tile(np.array(q, np.float64), (EXPECTED_HISTORY, 1))
        self._sent_at = np.full(EXPECTED_HISTORY, -inf)
        self._setpoints = 0
        self._answered = nan
        self._torque_sum, self._torques = np.zeros(len(q)), 0
        self._at_home: Array | None = None
        self._at_start: Array | None = None
        # The cabinet knows the arm's weight, but not the load on its flange.
        unsure = tuple(UNCERTAIN_TORQUE_FACTOR * torque for torque in guard.torque)
        self._guard_unsure = guard._replace(torque=unsure)
        self._place: FlangePose | None = None
        self._missing, self._illegal, self._jump = 0, False, 0.0
        self._gaps, self._warned = DropoutMonitor(), False
        self._fresh_q = self._fresh_torque = False
        self._ticks = 0  # of this phase
        self._sample: EncoderSample | None = None
        self._measured, self._measured_at = tuple(q), -inf
        self._torque: Sequence[float] | None = None
        self._rest = _Rest()
        self._pressed = False
        self._times, self._counts = np.zeros(EXPECTED_HISTORY), np.zeros(EXPECTED_HISTORY)
        self._remembered = 0
        self._seen = TickRecord()
        self._counts_per_rev = round(2.0 * pi / controller.resolution)
        self._swing = _Swing(0.0, REST_BEFORE, 1.0, 1)
        self._job: Job | None = None
        self._result: Any = None
        self._tell(
            "homing", f"Moving to home, {self._path.duration:.1f} s. Any key stops, now and later."
        )

    @property
    def h(self) -> float:
        """Time between ticks [s]."""
        return self._h

    def tick(self, now: float, inputs: TickInputs) -> TickOutput:
        """Process the inputs since the last tick, and return the setpoints of this one.

        Args:
            now: The time [s].
            inputs: Samples, replies, words and faults.
        """
        self._take_samples(inputs.samples)
        self._take_replies(inputs.replies)
        self._hear(inputs.words)
        self._result, self._job = inputs.result, None
        for fault in inputs.faults:
            self._stop(Cause("fault", fault))
        self._watch_over(now, inputs.lateness)
        self._seen = TickRecord(estimated_phi=self._phi())
        before = self.phase
        first, second = self._STEPS[before](self, now)
        self._remember(now, first)
        self._remember(now + 0.5 * self._h, second)
        self._ticks = self._ticks + 1 if self.phase is before else 1
        events, self._events = self._events, []
        to_rest = self.phase is Phase.STOPPING  # whatever stops it has begun the ramp by now
        return TickOutput(
            setpoints=(first, second),
            q=self._q,
            dq=self._dq,
            state=PHASES.index(self.phase),
            record=self._seen,
            events=events,
            job=self._job,
            to_rest=to_rest,
            done=to_rest and self._rested,
        )

    @property
    def lasted(self) -> float:
        """Time for which the policy has acted [s]."""
        if self.began is None:
            return 0.0
        return self._ticks * self._h if self.ended is None else self.ended - self.began

    @property
    def phase(self) -> Phase:
        """Phase of the run."""
        return self.state.phase

    # Inputs.

    def _take_samples(self, samples: Sequence[EncoderSample]) -> None:
        watching = self.phase in (Phase.LIFTING, Phase.ARMED)
        for sample in samples:
            self._sample = sample
            self._pressed = self._pressed or sample.pressed
            place = self._remembered % EXPECTED_HISTORY
            self._times[place], self._counts[place] = sample.time, sample.counts
            self._remembered += 1
            if sample.missing and self.zero is not None:
                self._missing += self._gaps.serious(sample.time, sample.missing)
            self._illegal = self._illegal or sample.illegal
            self._jump = max(self._jump, self._unexplained())
            if self.phase is Phase.REFERENCING:
                self._rest.feed(sample.time, sample.counts)
            elif self.phase is Phase.SELF_TEST:
                self._swing.swung(sample.time, sample.counts)
            elif watching:
                self._release.feed(sample.time, self._phi())

    def _unexplained(self) -> float:
        """Return the unexplained motion of the newest sample [rad]."""
        if self._remembered < 3:
            return 0.0
        i, j, k = ((self._remembered - back) % EXPECTED_HISTORY for back in (3, 2, 1))
        times, counts = self._times, self._counts
        return unexplained(
            (float(times[i]), float(times[j]), float(times[k])),
            (int(counts[i]), int(counts[j]), int(counts[k])),
            self._resolution,
        )

    def _take_replies(self, replies: Sequence[RobotReply]) -> None:
        self._fresh_q = self._fresh_torque = False
        for reply in replies:
            self._answered = reply.sent
            if reply.q is not None:
                self._measured, self._fresh_q = tuple(reply.q), True
                self._measured_at = 0.5 * (reply.sent + reply.received)
                if self.phase is Phase.SELF_TEST:
                    x = self._flange.place(self._measured).x
                    self._swing.moved(self._measured_at, x)
            if reply.torque is not None:
                self._torque, self._fresh_torque = tuple(reply.torque), True
                if self._at_start is None:  # the way home has hardly begun
                    self._at_start = np.array(reply.torque)
                if self._at_home is None and self.phase in (Phase.AT_HOME, Phase.REFERENCING):
                    self._torque_sum += reply.torque
                    self._torques += 1

    # Safety.

    def _watch_over(self, now: float, lateness: float) -> None:
        """Check the rules, and stop where one is broken."""
        guard = self._guard if self._at_home is not None else self._guard_unsure
        warned, bridged = self._warned, self._gaps.bridged
        view = self._view(now, lateness)
        self._missing, self._illegal, self._jump = 0, False, 0.0
        self._watch = update_monitor(guard, self._watch, view)
        # The observer receives nothing that a rule forbids; its estimate is then checked, too.
        measured_well = view._replace(on_track=False, balancing=False)
        if view.balancing and check(guard, self._watch, measured_well) is None:
            self._observe(now)
            estimate = self._lane.estimate
            view = view._replace(x_dot=estimate.v, phi=estimate.phi)
        broken = check(guard, self._watch, view)
        if broken is not None:
            self._stop(Cause(broken.rule.value, broken.reason, broken.from_measured))
        elif bridged and not warned:
            self._warned = True
            self._tell("warning", "An encoder sample was lost on its way. Look at its cable later.")

    def _view(self, now: float, lateness: float) -> SafetyInputs:
        """Return the inputs of the safety rules, with the estimate of the tick before."""
        phase = self.phase
        on_track = phase in ON_TRACK
        moves = phase in MOVING or phase in (Phase.ARMED, Phase.STOPPING)
        balancing = phase is Phase.BALANCING
        sees = self.zero is not None and self._sample is not None
        if self._fresh_q:
            self._place = self._flange.place(self._measured)
        place, estimate = self._place, self._lane.estimate
        x_dot = self._lane.x_dot if not balancing else estimate.v
        self._answered = now if isnan(self._answered) else self._answered
        return SafetyInputs(
            # A late tick is no danger while nothing moves; the fit of a swing causes some.
            lateness=lateness if moves else 0.0,
            # The lateness of the loop itself is not the robot's delay.
            overdue=max(now - lateness - self._answered - self._h, 0.0),
            measured=self._measured if self._fresh_q else None,
            expected=self._expected(self._measured_at) if self._fresh_q else None,
            torque=self._pushed() if self._fresh_torque else None,
            encoder_age=now - self._sample.time if sees and self._sample is not None else 0.0,
            encoder_illegal=sees and self._illegal,
            encoder_missing=self._missing if sees else 0,
            encoder_jump=self._jump if sees else 0.0,
            balancing=balancing,
            x=place.x if place is not None and on_track else 0.0,
            x_dot=x_dot if on_track else 0.0,
            phi=estimate.phi if balancing else 0.0,
            on_track=on_track and place is not None,
            manipulability=place.manipulability if place is not None and on_track else inf,
            drift=place.drift if place is not None and on_track else 0.0,
            tilt=place.tilt if place is not None and on_track else 0.0,
        )

    def _observe(self, now: float) -> None:
        """Feed the measurements of this tick to the observer."""
        if self._sample is None or self.zero is None:
            return
        self._lane.observe(
            self._sample.counts - self.zero,
            now - self._sample.time,
            self._measured,
            now - self._measured_at,
        )

    def _pushed(self) -> tuple[float, ...] | None:
        """Return the external torques less those at rest [N m]; None before those are known."""
        at_rest = self._at_start if self._at_home is None else self._at_home
        if at_rest is None or self._torque is None:
            return None
        return tuple((np.asarray(self._torque) - at_rest).tolist())

    def _remember(self, time: float, q: Sequence[float]) -> None:
        place = self._setpoints % EXPECTED_HISTORY
        self._sent_at[place], self._commanded[place] = time, q
        self._setpoints += 1

    def _expected(self, time: float) -> tuple[float, ...]:
        """Return the expected joints at a time [rad]: the setpoint sent T before."""
        since = time - self._guard.reaction
        place = newest_before(self._sent_at, self._setpoints, since)
        return tuple(self._commanded[place].tolist())

    def _hear(self, words: Sequence[str]) -> None:
        """Accept an expected answer; other input stops, except Enter while nothing moves."""
        self._answer = None
        for word in words:
            said = word.strip().lower() or OK
            if said in self._answers:
                self._answer = said
            elif said != OK or self.phase in MOVING:
                self._stop(
                    Cause("operator", f"stopped by the operator ({word.strip() or 'Enter'})")
                )

    def _phi(self) -> float:
        """Return the newest angle from upright, in [-pi, pi) [rad]; NaN while there is no zero."""
        if self.zero is None or self._sample is None:
            return float("nan")
        return self._angle(self._sample.counts)

    def _angle(self, counts: float) -> float:
        zero = 0.0 if self.zero is None else self.zero
        return (2.0 * pi - (counts - zero) * self._resolution) % (2.0 * pi) - pi

    # Outputs.

    def _tell(self, name: str, text: str) -> None:
        self._events.append(OperatorMessage(name, text))

    def _ask(self, name: str, text: str, answers: tuple[str, ...]) -> None:
        self._answers, self._answer = answers, None
        self._events.append(OperatorMessage(name, text, answers))

    def _go(self, event: states.RunEvent, cause: Cause | None = None) -> None:
        self.state = states.step(self.state, event, cause)
        self._ticks = 0
        self._answers, self._pressed = (), False

    def _stop(self, cause: Cause) -> None:
        """Latch a stop; the ramp begins with this tick's setpoints."""
        if self.state.latched:
            self.state = states.step(self.state, states.RunEvent.STOP, cause)
            return
        if self.phase is Phase.BALANCING and self.began is not None:
            self.ended = self.began + self._ticks * self._h
        self.phase_before = self.phase
        self._go(states.RunEvent.STOP, cause)
        self._tell("stopping", cause.reason)

    def _still(self) -> Setpoints:
        self._dq = (0.0,) * len(self._q)
        return self._q, self._q

    def _along(self) -> Setpoints:
        """Return the next setpoints on the path."""
        begin = self._ticks * self._h
        first, second = self._path.at(begin + 0.5 * self._h), self._path.at(begin + self._h)
        self._q, self._dq = second.q, second.dq
        return first.q, second.q

    # The phases.

    def _home(self, now: float) -> Setpoints:
        if self._ticks * self._h < self._path.duration:
            return self._along()
        self._go(states.RunEvent.ARRIVED)
        self._lane.begin(0.0, 0.0)
        self._q = self._lane.q
        self._ask(
            "home", "Is this home, flange down, the track free on both sides? y or n", YES_OR_NO
        )
        return self._still()

    def _confirm(self, now: float) -> Setpoints:
        if self._answer == "y":
            self._go(states.RunEvent.CONFIRMED)
            self._rest = _Rest()
            self._tell("hang", "Let the pendulum hang, and steady it with a finger.")
        elif self._answer == "n":
            self._stop(Cause("operator", "the operator did not confirm home"))
            return self._come_to_rest(now)
        return self._still()

    def _reference(self, now: float) -> Setpoints:
        rest = self._rest
        if not rest.lasted >= REST_TIME:
            self._answers, self._pressed = (), False
        elif not self._answers:
            self._ask(
                "reference",
                "The pendulum hangs still. Take your hand away, then press its button or Enter.",
                (OK,),
            )
        elif self._pressed or self._answer == OK:
            self.zero = rest.middle
            if self._torques:
                self._at_home = self._torque_sum / self._torques
            self._go(states.RunEvent.REFERENCED)
            self._swing = _Swing(self._lane.x, REST_BEFORE, 1.0, 1)
            self._tell("swing", "Self-test: the arm moves by 40 mm. Keep your hands off.")
        return self._still()

    def _test(self, now: float) -> Setpoints:
        """Move, record and judge the swing; then return home, and go on."""
        swing, h = self._swing, self._h
        if swing.judged is not None:
            return self._after_test(swing.judged)
        t = self._ticks * h - swing.begin
        if -REST_BEFORE <= t < MOVE_TIME - 0.5 * h:
            return self._glide(swing.path, t)
        if t >= MOVE_TIME + SWING_TIME and not swing.asked:
            swing.asked = True
            self._job = swing.job(self._controller, self._counts_per_rev, self.zero or 0.0)
        if swing.asked and isinstance(self._result, Exception):
            reason = f"the self-test failed ({self._result})"
            self._stop(Cause("self-test", reason))
            return self._come_to_rest(now)
        if swing.asked and self._result is not None:
            result: SelfTest = self._result
            self._tell("self-test", f"Self-test: {result.reason}.")
            if result.verdict is SelfTestVerdict.REPEAT and swing.number < MAX_SWINGS:
                begin = self._ticks * h + REST_BEFORE
                self._swing = _Swing(self._lane.x, begin, -swing.direction, swing.number + 1)
            elif result.verdict in (SelfTestVerdict.PASSED, SelfTestVerdict.ZERO):
                swing.judged = result
                swing.path = Path((self._lane.x,), (0.0,), RETURN_TIME)
                swing.begin = self._ticks * h + h
            else:
                self._stop(Cause("self-test", result.reason))
                return self._come_to_rest(now)
        return self._glide(Path((0.0,), (0.0,), 0.0), 1.0)

    def _after_test(self, result: SelfTest) -> Setpoints:
        t = self._ticks * self._h - self._swing.begin
        if t < RETURN_TIME + REST_BEFORE:
            return self._glide(self._swing.path, t)
        if result.verdict is SelfTestVerdict.ZERO:
            self._go(states.RunEvent.REFUSED)
            self.zero, self._rest = None, _Rest()
            self._tell("hang", "Let the pendulum hang freely, and steady it with a finger.")
        else:
            self.zero = (self.zero or 0.0) + result.zero.value / self._resolution
            self._go(states.RunEvent.PASSED)
            self._release.reset()
            self._tell("lift", "Lift the pendulum until it stands upright, and hold it there.")
        return self._still()

    def _glide(self, path: Path, t: float) -> Setpoints:
        """Move the flange along a path on its track, as the policy would."""
        h = self._h
        v = path.at(t + h).dq[0] - path.at(t).dq[0]
        first, second = self._lane.command(v / h)
        self._q, self._dq = self._lane.q, self._lane.dq
        return first, second

    def _lift(self, now: float) -> Setpoints:
        if self._release.grip is ReleaseState.ARMED:
            self._go(states.RunEvent.ARMED)
            self._tell("armed", "\aArmed. Let go.")
        return self._still()

    def _hold(self, now: float) -> Setpoints:
        grip = self._release.grip
        if self._ticks % round(NUDGE_INTERVAL / self._h) == round(NUDGE_INTERVAL / self._h) - 1:
            self._tell("nudge", "Let go. If it stands by itself, nudge it.")
        if grip is ReleaseState.HELD:
            self._go(states.RunEvent.DENIED)
            self._tell("disarmed", "Your hand is still on. Hold the pendulum upright again.")
        elif grip is ReleaseState.RELEASED:
            phi, phi_dot = self._falling(now)
            self._lane.begin(phi, phi_dot)
            self._go(states.RunEvent.RELEASED)
            self.began = now
            self._tell("balancing", "Balancing. Any key stops.")
            return self._decide(now, first=True)
        return self._still()

    def _balance(self, now: float) -> Setpoints:
        if self._sample is None or self.zero is None:  # balancing follows from a reference
            self._stop(Cause("fault", "the encoder shows nothing"))
        elif self._lane.limit_exceeded:
            self._stop(Cause("joint limit", "the policy asks for more than a joint can do"))
        elif self._ticks * self._h >= self._duration - 0.5 * self._h:
            self._stop(Cause("lasted", f"It stood for {self._duration:g} s. Catch the pendulum."))
        if self.state.latched:
            return self._come_to_rest(now)
        return self._decide(now)

    def _decide(self, now: float, *, first: bool = False) -> Setpoints:
        """Command the policy's u; stop where the policy fails, for u is then of no use."""
        controller, u, began = self._lane, nan, self._clock()
        try:
            if first:
                self._policy.reset()
            u = controller.decide(self._policy)
            failure = "" if isfinite(u) else f"it returned {u}"
        except BaseException as error:  # not even a request to exit may end the loop
            failure = printable(str(error)) or type(error).__name__
        took, limit = self._clock() - began, POLICY_TIME_SHARE * self._h
        if not failure and took > limit:
            failure = f"{LATE} {1e3 * took:.1f} ms, expected at most {1e3 * limit:.1f} ms"
        estimate = controller.estimate
        u = 0.0 if failure else u
        self._seen = TickRecord(
            *controller.observation,
            controller.box,
            u,
            estimate.phi,
            estimate.phi_dot,
            estimate.bias,
        )
        if failure:
            self._stop(Cause(POLICY, f"{FAILED}: {failure}"))
            return self._come_to_rest(now)
        first_setpoint, second_setpoint = controller.command(u)
        self._q, self._dq = controller.q, controller.dq
        return first_setpoint, second_setpoint

    def _come_to_rest(self, now: float) -> Setpoints:
        if self._ticks == 0:
            before, last = (
                self._commanded[(self._setpoints - n) % EXPECTED_HISTORY].tolist() for n in (2, 1)
            )
            self._dq = stoppable_speeds(self._dq, last, before, 0.5 * self._h)
            speed = abs(self._lane.x_dot) if self.phase_before in ON_TRACK else 0.0
            self._ramp = ramp(self._q, self._dq, speed, self._guard.limits)
        h, begin = self._h, self._ticks * self._h
        if begin < self._ramp.duration:
            self._q, self._dq = self._ramp.at(begin + h), self._ramp.speed_at(begin + h)
            self._back_since = self._ticks + 1
            return self._ramp.at(begin + 0.5 * h), self._q
        if self.state.from_measured and self._back is None:
            self._back = way_back(self._q, self._measured, self._guard.limits)
        since = (self._ticks - self._back_since) * h
        if self._back is not None and since < self._back.duration:
            first, second = self._back.at(since + 0.5 * h), self._back.at(since + h)
            self._q, self._dq = second.q, second.dq
            return first.q, second.q
        self._rested = since > SETTLING_TIME + (self._back.duration if self._back else 0.0)
        return self._still()

    _STEPS: Final[dict[Phase, Callable[["RunController", float], Setpoints]]] = {
        Phase.HOMING: _home,
        Phase.AT_HOME: _confirm,
        Phase.REFERENCING: _reference,
        Phase.SELF_TEST: _test,
        Phase.LIFTING: _lift,
        Phase.ARMED: _hold,
        Phase.BALANCING: _balance,
        Phase.STOPPING: _come_to_rest,
    }

    def _falling(self, now: float) -> tuple[float, float]:
        """Return phi [rad] and phi_dot [rad/s] now, of a pendulum that has fallen for 40 ms.

        A free fall near upright is a cosh(w t) + b sinh(w t) / w; a and b by least squares.
        """
        count = min(self._remembered, EXPECTED_HISTORY)
        order = [(self._remembered - 1 - back) % EXPECTED_HISTORY for back in range(count)]
        w = sqrt(self._controller.pendulum.w2)
        cc = cs = ss = cy = sy = 0.0
        for place in order:
            t = float(self._times[place]) - now
            if t < -FALL_WINDOW:
                break
            c, s = cosh(w * t), sinh(w * t) / w
            phi = self._angle(float(self._counts[place]))
            cc, cs, ss = cc + c * c, cs + c * s, ss + s * s
            cy, sy = cy + c * phi, sy + s * phi
        determinant = cc * ss - cs * cs
        return (ss * cy - cs * sy) / determinant, (cc * sy - cs * cy) / determinant


class _Swing:
    """Record of one swing, in memory allocated before."""

    def __init__(self, x: float, begin: float, direction: float, number: int) -> None:
        self.path, self.begin = excitation(x, direction), begin
        self.direction, self.number = direction, number
        self.asked = False
        self.judged: SelfTest | None = None
        self._encoder, self._pivot = np.zeros((2, 16384)), np.zeros((2, 4096))
        self._samples = self._moves = 0

    def swung(self, time: float, counts: int) -> None:
        """Record a sample of the encoder."""
        if self._samples < self._encoder.shape[1] and not self.asked:
            self._encoder[:, self._samples] = time, counts
            self._samples += 1

    def moved(self, time: float, x: float) -> None:
        """Record a position of the flange, and so of the pivot."""
        if self._moves < self._pivot.shape[1] and not self.asked:
            self._pivot[:, self._moves] = time, x
            self._moves += 1

    def job(self, controller: ControllerParams, counts_per_rev: int, resting: float) -> Job:
        """Return the job that judges it."""
        time, counts = self._encoder[:, : self._samples].copy()
        pivot_time, pivot_x = self._pivot[:, : self._moves].copy()
        return partial(
            self_test,
            time,
            counts,
            pivot_time,
            pivot_x,
            pendulum=controller.pendulum,
            counts_per_rev=counts_per_rev,
            resting=resting,
            delay=0.0,
        )


class _Rest:
    """Time for which the count has stayed within one."""

    def __init__(self) -> None:
        self.lasted = 0.0
        self._since: float | None = None
        self._low = self._high = self._sum = self._number = 0

    @property
    def middle(self) -> float:
        """Mean of the counts since then."""
        return self._sum / self._number

    def feed(self, time: float, counts: int) -> None:
        low, high = min(self._low, counts), max(self._high, counts)
        if self._since is None or high - low > 1:
            self._since, self._sum, self._number = time, 0, 0
            low = high = counts
        self._low, self._high = low, high
        self._sum, self._number = self._sum + counts, self._number + 1
        self.lasted = time - self._since
