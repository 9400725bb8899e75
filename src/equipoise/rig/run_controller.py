"""Controller of a run on a rig, from the first setpoint to rest.

The phases are those of `equipoise.control.states`: the way home and its confirmation; the reference
of the hanging pendulum; the self-test swing, and the zero from its decay; the operator lifts the
pendulum, holds it still and releases it; the policy balances; a ramp to rest. Any failure starts
that ramp in the tick that detects it, and nothing leads back.

The controller uses no clock, link or file. Equal inputs give equal outputs: the replay of a log
gives the same setpoints.

The two setpoints of a tick are the arm's targets half a tick later and a whole one, as in the
training (`equipoise.control.control_step`).
"""

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from math import cosh, inf, isfinite, nan, pi, sinh, sqrt
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.control import self_test, states, ticks
from equipoise.control.actuator_choice import (
    REST_AFTER_MOVE,
    ActuatorChoice,
    MotionRecord,
    choose_actuator,
)
from equipoise.control.control_step import ControllerParams
from equipoise.control.controller import Controller, FlangeKinematics, FlangePose
from equipoise.control.minimum_jerk import Path, path_within
from equipoise.control.policy import Policy
from equipoise.control.self_test import MOVE_TIME, SWING_TIME, SelfTest, SelfTestVerdict
from equipoise.control.states import RunState
from equipoise.control.ticks import (
    OK,
    OperatorMessage,
    TickInputs,
    TickOutput,
    TickRecord,
    missed_ticks,
)
from equipoise.model.actuator import Actuator
from equipoise.model.arms.arm import Arm
from equipoise.outcomes import End, Outcome, Phase, describe
from equipoise.printable import printable
from equipoise.rig.release import ReleaseDetector, ReleaseState
from equipoise.safety import rules
from equipoise.safety.dropouts import DropoutMonitor
from equipoise.safety.plausibility import JointPlausibility
from equipoise.safety.rules import STOP_DECELERATION, SafetyInputs, SafetyParams
from equipoise.safety.stop import StopMotion, stoppable_speeds
from equipoise.settings import BoxSettings

Array = npt.NDArray[np.float64]
Setpoints = tuple[tuple[float, ...], tuple[float, ...]]

HOMING_SHARE: Final = 0.1
"""Share of the joints' velocity and acceleration limits on the way home [-]."""
YES_OR_NO: Final = ("y", "n")
REST_TIME: Final = 2.0
"""Minimum time for which the count stays within one before it is a reference [s]."""
FALL_WINDOW: Final = 0.04
"""Window for estimating the state at release [s]."""
UNCERTAIN_TORQUE_FACTOR: Final = 2.0
"""Factor on the torque limits until the torques at home are known [-]: the reference is then that
at the start of the servo, where the load on the flange pulls differently."""
SETTLING_TIME: Final = 0.5
"""Hold after a ramp before the servo ends [s]."""
REST_BEFORE: Final = 0.3
"""Observation of the pendulum before the move [s]."""
RETURN_TIME: Final = 1.6
"""Duration of the way back from the self-test [s]: twice that of the way out."""
HOME_TOLERANCE: Final = 2e-5
"""Largest distance of the flange from home at which the balance may begin [m]: as an error of the
first setpoint it is an acceleration of 1 m/s^2."""
MAX_SWINGS: Final = 4
"""Maximum number of swings of a self-test, repeated until the zero's interval is small."""
NUDGE_INTERVAL: Final = 5.0
"""Interval of the reminders to release an armed pendulum [s]."""
POLICY_TIME_SHARE: Final = 0.5
"""Maximum computing time of the policy, as a share of a tick [-]: later, the second setpoint, due
after half a tick, would be late too."""
RESTART_ACCELERATION: Final = 0.5 * STOP_DECELERATION
"""Additional acceleration of the flange after a pause of the setpoints, until it has the speed of
before [m/s^2]: with the policy's largest acceleration that of a stop."""
MAX_UNANSWERED: Final = 0.020
"""Time without a reply after which no setpoint is sent until the replies have come [s], while the
arm moves: a link that stands still delivers all setpoints at once, and the arm then goes to the
last one at its highest speed. A round trip takes 1 to 4 ms."""
SENDING_TIME: Final = 0.001
"""Tolerance of the time at which a setpoint is sent [s]."""
MAX_TIMED_REPLY: Final = 0.020
"""Maximum round trip of a reply whose joints count as measured [s]: in a longer one the time of
their measurement is too uncertain. A link to a robot takes 9 ms at most. With longer round trips
only, the age of the measurement stops the run (`Rule.MEASUREMENT_STALE`)."""
LOOP_STALLED: Final = "The computer stood still: `equipoise rig doctor` looks for the cause."
"""Warning of a stall of the loop."""
LINK_STALLED: Final = "The robot's link stood still: `equipoise rig doctor` looks for the cause."
"""Warning of a stall of the link."""
HISTORY: Final = 64
"""Number of samples and of setpoints in memory: 64 ms at 1 kHz, for the fit at the release."""

ACTUATOR: Final = "actuator"
"""Name of the message with the selected actuator."""
IDENTIFIED: Final = "identified"
"""Name of the message with the identified actuator."""
REST_AFTER_EXCITATION: Final = 0.3
"""Record after the excitation [s]."""

MOVING: Final = frozenset({Phase.HOMING, Phase.SELF_TEST, Phase.EXCITING, Phase.BALANCING})
"""Phases in which Enter stops, too."""
ON_TRACK: Final = frozenset(
    {Phase.SELF_TEST, Phase.LIFTING, Phase.ARMED, Phase.BALANCING, Phase.REFERENCING, Phase.AT_HOME}
)
"""Phases in which the rules of the flange apply."""
PHASES: Final = tuple(Phase)
"""Phases by the index that logs use."""


class Alternative(NamedTuple):
    """An actuator that a run may select, and what follows from it."""

    actuator: Actuator
    """The actuator."""
    params: ControllerParams
    """Constants of the control step with it."""
    safety: SafetyParams
    """Safety limits with it."""


class Excitation(NamedTuple):
    """Motion before the lift that identifies the arm, and the use of its result."""

    setpoints: Array
    """All joints [rad], h / 2 apart, from home to home, shape (m, joints)."""
    identify: Callable[[Array, Array], Actuator]
    """Job that identifies the actuator from setpoints and measurements of the free joints, rows as
    in `MotionRecord`."""
    respond: Callable[[Actuator], tuple[Alternative, str]]
    """Returns what follows from the identified actuator, and a sentence for the operator; raises
    `EquipoiseError` where the policy cannot run with it."""


class RunController:
    """Controller of a run: phases, safety rules, policy."""

    def __init__(
        self,
        arm: Arm,
        controller: ControllerParams,
        boxes: BoxSettings,
        policy: Policy,
        safety_params: SafetyParams,
        q: Sequence[float],
        *,
        duration: float,
        clock: Callable[[], float] = lambda: 0.0,
        alternatives: Sequence[Alternative] = (),
        excitation: Excitation | None = None,
    ) -> None:
        """Begin the way home from the posture that the servo holds.

        Args:
            arm: The arm with its home.
            controller: Constants of the control step, with the rig's counts per revolution.
            boxes: Grid whose numbers the records hold.
            policy: Any policy.
            safety_params: Safety limits of the rig.
            q: Measured joints, all of them [rad].
            duration: Duration of the balance [s].
            clock: Clock for the policy's computing time [s]; the default gives zero.
            alternatives: Actuators of which the move of the self-test selects one for the balance;
                none or two and more. Until then `controller` and `safety_params` hold.
            excitation: Motion before the lift that identifies the arm; None without one.
        """
        self._params, self._policy, self._safety = controller, policy, safety_params
        self._controller, self._arm, self._boxes = Controller(arm, controller, boxes), arm, boxes
        self._alternatives, self._motion = tuple(alternatives), MotionRecord()
        self._excitation, self._measured_all = excitation, False
        self.identified: Actuator | None = None
        """Actuator that the excitation has identified."""
        self._selects = False
        self._choice: ActuatorChoice | None = None
        self._flange = FlangeKinematics(arm, controller)
        self._release = ReleaseDetector(controller.pendulum)
        self._duration, self._clock, self._h = duration, clock, controller.h
        self._events: list[OperatorMessage] = []
        self._answers: tuple[str, ...] = ()
        self._answer: str | None = None
        self.state = RunState()
        """State of the run, with the cause of a stop."""
        self.began: float | None = None
        """Time at which the policy began to act [s]."""
        self.ended: float | None = None
        """Time at which it ended [s]."""
        self.zero: float | None = None
        """Count of the hanging pendulum."""
        self.phase_before = Phase.HOMING
        """Phase before the stop."""

        self._q, self._dq = tuple(q), (0.0,) * len(q)
        self._path = self._path_home()
        self._stopping: StopMotion | None = None
        self._plausibility = JointPlausibility(safety_params.limits)
        self._before_stop = np.zeros((0, len(q)))
        self._returned, self._forbidden, self._key_after_stop = False, "", False
        self._monitor = rules.MonitorState()
        self._commanded = np.tile(np.array(q, np.float64), (HISTORY, 1))
        self._references = self._commanded.copy()
        self._leads: tuple[tuple[float, ...], ...] = ()
        self._lead = (0.0,) * len(q)  # of the last setpoint
        self._sent_at, self._setpoints = np.full(HISTORY, -inf), 0
        self._answered, self._overdue = -inf, 0.0
        self._torque_sum, self._torques = np.zeros(len(q)), 0
        self._at_home: Array | None = None
        self._at_start: Array | None = None
        # The robot controller knows the arm's weight, but not the load on its flange.
        uncertain = tuple(UNCERTAIN_TORQUE_FACTOR * torque for torque in safety_params.torque)
        self._safety_uncertain = safety_params._replace(torque=uncertain)
        self._pose: FlangePose | None = None
        self._missing, self._illegal, self._jump = 0, False, 0.0
        self._dropouts, self._warned = DropoutMonitor(), False
        self._stalled = set[str]()
        self._lost_speed = 0.0
        self._fresh_q = self._fresh_torque = False
        self._ticks = 0  # of this phase
        self._samples = deque[ticks.Sample](maxlen=HISTORY)
        self._measured, self._measured_at = tuple(q), -inf
        self._known_since = inf  # the age of the measurement counts from then
        self._torque: Sequence[float] | None = None
        self._rest, self._pressed = _Rest(), False
        self._record = TickRecord()
        self._swing = _Swing(0.0, REST_BEFORE, 1.0, 1)
        self._job: ticks.Job | None = None
        self._result: Any = None
        home = f"Moving to home, {self._path.duration:.1f} s. Any key stops, now and later."
        self._notify("homing", home)

    @property
    def h(self) -> float:
        """Time between ticks [s]."""
        return self._h

    def tick(self, now: float, inputs: TickInputs) -> TickOutput:
        """Process the inputs since the last tick, and return the setpoints of this one.

        Args:
            now: The time [s].
            inputs: Samples, replies, the operator's input and faults.
        """
        missed = missed_ticks(inputs.lateness, self._h)
        late = max(inputs.lateness - missed * self._h, 0.0)
        if inputs.paused(self._h):
            self._begin_anew(missed, inputs.unsent, LOOP_STALLED)
        self._take_samples(inputs.samples)
        self._take_replies(inputs.replies)
        self._take_input(inputs.lines)
        self._result, self._job = inputs.result, None
        for fault in inputs.faults:
            self._stop(fault)
        self._check_rules(now, inputs.lateness)
        self._record = TickRecord(estimated_phi=self._phi())
        before, stalls = self.phase, self._overdue > MAX_UNANSWERED and self.phase in MOVING
        self._leads = ()
        if stalls and before is Phase.EXCITING:
            self._interrupt_excitation("the robot's link")
            setpoints = self._come_to_rest(now)
        else:
            setpoints = self._wait() if stalls else self._STEPS[before](self, now)
        if self._leads:
            self._lead = self._leads[-1]
        elif setpoints and self.phase is not Phase.STOPPING:
            self._lead = (0.0,) * len(self._lead)
        for place, setpoint in enumerate(setpoints):
            sent = now - late + place * 0.5 * self._h
            self._store_setpoint(sent, setpoint, self._leads[place] if self._leads else ())
            if self._records_motion:
                self._motion.send(sent, self._arm.without_held(setpoint))
        self._ticks = self._ticks + 1 if self.phase is before else 1
        events, self._events = self._events, []
        phase, to_rest = PHASES.index(self.phase), self.phase is Phase.STOPPING
        done = self._stopping is not None and self._stopping.rested > SETTLING_TIME
        output = TickOutput(setpoints, self._q, self._dq, phase, self._record, events, self._job)
        return output._replace(leads=self._leads, to_rest=to_rest, done=done)

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

    def _begin_anew(self, missed: int, unsent: int, warning: str) -> None:
        """Begin the motion of the phase anew from the last setpoint sent, where the arm rests.

        Args:
            missed: Number of missed ticks.
            unsent: Number of setpoints of the last tick that were not sent.
            warning: Message on what stood still, sent once.
        """
        self._setpoints -= unsent
        q = tuple(self._commanded[(self._setpoints - 1) % HISTORY].tolist())
        moved, self._q, self._dq = any(self._dq), q, (0.0,) * len(q)
        self._references[(self._setpoints - 1) % HISTORY], self._lead = q, (0.0,) * len(q)
        if self._records_motion:
            self._motion.clear()  # the move goes on from rest
        if self.phase is Phase.HOMING:
            self._path, self._ticks = self._path_home(), 0
        elif self._stopping is not None:
            self._stopping.rest(q)
        elif self.phase in (Phase.SELF_TEST, Phase.BALANCING):
            self._lost_speed += self._controller.x_dot
            self._controller.rest(q, missed, unsent > 0)
        elif self.phase is Phase.EXCITING and not self._measured_all:
            self._interrupt_excitation("the computer")
        if self.phase is Phase.BALANCING:
            self._ticks += missed
        if moved and warning not in self._stalled:
            self._stalled.add(warning)
            self._notify("warning", warning)

    def _interrupt_excitation(self, what: str) -> None:
        """Stop: an excitation with a gap identifies nothing."""
        text = f"{what} stood still during the excitation; run again"
        self._stop(End(Outcome.UNIDENTIFIED, {"text": text}))

    def _take_samples(self, samples: Sequence[ticks.Sample]) -> None:
        held = self.phase in (Phase.LIFTING, Phase.ARMED)
        for sample in samples:
            self._samples.append(sample)
            self._pressed = self._pressed or sample.pressed
            if sample.missing and self.zero is not None:
                self._missing += self._dropouts.serious(sample.time, sample.missing)
            self._illegal = self._illegal or sample.illegal
            if len(self._samples) > 2:
                last = [self._samples[i] for i in (-3, -2, -1)]
                times, counts = [one.time for one in last], [one.counts for one in last]
                jump = rules.unexplained_turn(times, counts, self._params.resolution)
                self._jump = max(self._jump, jump)
            if self.phase is Phase.REFERENCING:
                self._rest.feed(sample.time, sample.counts)
            elif self.phase is Phase.SELF_TEST and not self._swing.asked:
                self._swing.encoder.add(sample.time, sample.counts)
            elif held:
                self._release.feed(sample.time, self._phi())

    def _take_replies(self, replies: Sequence[ticks.Reply]) -> None:
        self._fresh_q = self._fresh_torque = False
        for reply in replies:
            self._answered = reply.sent
            if reply.q is not None and reply.received - reply.sent <= MAX_TIMED_REPLY:
                self._measured, self._fresh_q = tuple(reply.q), True
                self._measured_at = self._known_since = 0.5 * (reply.sent + reply.received)
                self._plausibility.add(reply.sent, reply.received, reply.q)
                if self.phase is Phase.SELF_TEST and not self._swing.asked:
                    self._swing.pivot.add(self._measured_at, self._flange.pose(self._measured).x)
                if self._records_motion:
                    self._motion.measure(self._measured_at, self._arm.without_held(reply.q))
            if reply.torque is not None:
                self._torque, self._fresh_torque = tuple(reply.torque), True
                if self._at_start is None:  # the way home has hardly begun
                    self._at_start = np.array(reply.torque)
                if self._at_home is None and self.phase in (Phase.AT_HOME, Phase.REFERENCING):
                    self._torque_sum += reply.torque
                    self._torques += 1

    @property
    def _records_motion(self) -> bool:
        """Whether the first move of the self-test, or the excitation is under way."""
        if self.phase is Phase.EXCITING:
            return not self._measured_all
        if not self._alternatives or self.phase is not Phase.SELF_TEST or self._swing.number > 1:
            return False
        return self._ticks * self._h - self._swing.begin < MOVE_TIME + REST_AFTER_MOVE

    # Safety.

    def _check_rules(self, now: float, lateness: float) -> None:
        """Check the safety rules, and stop where one is broken."""
        params = self._safety if self._at_home is not None else self._safety_uncertain
        warned, bridged = self._warned, self._dropouts.bridged
        inputs = self._safety_inputs(now, lateness)
        self._missing, self._illegal, self._jump = 0, False, 0.0
        self._monitor = rules.update_monitor(params, self._monitor, inputs)
        # The observer receives no forbidden measurement; the rules then check its estimate, too.
        measured = inputs._replace(on_track=False, balancing=False)
        if inputs.balancing and rules.check(params, self._monitor, measured) is None:
            self._observe(now)
            estimate = self._controller.estimate
            inputs = inputs._replace(x_dot=estimate.v, phi=estimate.phi)
        broken = list(rules.violations(params, self._monitor, inputs))
        for violation in broken:
            self._stop(violation)
        others = (each for each in broken if each.outcome not in rules.FROM_MEASURED)
        self._forbidden = next(map(describe, others), "")
        if not broken and bridged and not warned:
            self._warned = True
            lost = "An encoder sample was lost on its way. Look at its cable later."
            self._notify("warning", lost)

    def _safety_inputs(self, now: float, lateness: float) -> SafetyInputs:
        """Return the inputs of the safety rules, with the estimate of the tick before."""
        phase, balancing = self.phase, self.phase is Phase.BALANCING
        moves = phase in MOVING or phase in (Phase.ARMED, Phase.STOPPING)
        if self._known_since == inf or (not moves and missed_ticks(lateness, self._h)):
            self._known_since = now  # a late loop reads late; nothing moves meanwhile
        # The lateness of the loop itself is not the robot's delay.
        self._overdue = self._unanswered_time(now - lateness)
        inputs = SafetyInputs(
            # A late tick is no danger while nothing moves; the fit of a swing causes some.
            lateness=lateness if moves else 0.0,
            overdue=self._overdue,
            measured_age=now - self._known_since,
            torque=self._external_torque() if self._fresh_torque else None,
            balancing=balancing,
            phi=self._controller.estimate.phi if balancing else 0.0,
        )
        if self._fresh_q:
            self._pose = self._flange.pose(self._measured)
            expected = self._expected(self._measured_at)
            inputs = inputs._replace(measured=self._measured, expected=expected)
        if self.zero is not None and self._samples:
            inputs = inputs._replace(
                encoder_age=now - self._samples[-1].time,
                encoder_illegal=self._illegal,
                encoder_missing=self._missing,
                encoder_jump=self._jump,
            )
        if self._on_track and self._pose is not None:
            x_dot = self._controller.estimate.v if balancing else self._controller.x_dot
            if self._stopping is not None:
                x_dot = self._flange_speed(self._stopping)
            inputs = inputs._replace(on_track=True, x_dot=x_dot, **self._pose._asdict())
        return inputs

    @property
    def _on_track(self) -> bool:
        """Whether the rules of the flange apply; after a stop those of the phase before."""
        return (self.phase_before if self.state.latched else self.phase) in ON_TRACK

    def _flange_speed(self, motion: StopMotion) -> float:
        """Return the commanded velocity of the flange along x after a stop [m/s]."""
        before = [q - self._h * dq for q, dq in zip(motion.q, motion.dq, strict=True)]
        return (self._flange.pose(motion.q).x - self._flange.pose(before).x) / self._h

    def _unanswered_time(self, now: float) -> float:
        """Return the time since the oldest setpoint without a reply was sent [s]; or 0."""
        oldest = now
        for back in range(1, HISTORY):
            sent = float(self._sent_at[(self._setpoints - back) % HISTORY])
            if sent <= self._answered + SENDING_TIME:
                break
            oldest = sent
        return max(now - oldest, 0.0)

    def _observe(self, now: float) -> None:
        """Pass the measurements of this tick to the observer."""
        if not self._samples or self.zero is None:
            return
        age = now - self._samples[-1].time
        counts = self._samples[-1].counts - self.zero if age <= self._h else None
        q, reply_age = (self._measured if self._fresh_q else None), now - self._measured_at
        self._controller.observe(counts, age, q, reply_age, lambda back: self._before(now - back))

    def _before(self, time: float) -> tuple[float, float] | None:
        """Return the counts of a tick in the past [s] and their age [s]; None without new ones."""
        for sample in reversed(self._samples):
            age = time - sample.time
            if age > self._h:
                break
            if age >= 0.0:
                return sample.counts - (self.zero or 0.0), age
        return None

    def _external_torque(self) -> tuple[float, ...] | None:
        """Return the external torques less those at rest [N m]; None before those are known."""
        at_rest = self._at_start if self._at_home is None else self._at_home
        if at_rest is None or self._torque is None:
            return None
        return tuple((np.asarray(self._torque) - at_rest).tolist())

    def _store_setpoint(self, time: float, q: Sequence[float], lead: Sequence[float]) -> None:
        place = self._setpoints % HISTORY
        self._sent_at[place], self._commanded[place] = time, q
        self._references[place] = np.subtract(q, lead) if lead else q
        self._setpoints += 1

    def _expected(self, time: float) -> tuple[float, ...]:
        """Return the expected joints at a time [rad]: the setpoint sent T before."""
        since = time - self._safety.reaction
        place = rules.newest_before(self._sent_at, self._setpoints, since)
        return tuple(self._commanded[place].tolist())

    def _take_input(self, lines: Sequence[str]) -> None:
        """Accept an expected answer; other input stops, except Enter while nothing moves."""
        self._answer = None
        self._key_after_stop = self._key_after_stop or (self.state.latched and bool(lines))
        for line in lines:
            answer = line.strip().lower() or OK
            if answer in self._answers:
                self._answer = answer
            elif answer != OK or self.phase in MOVING:
                self._stop(End(Outcome.OPERATOR, {"typed": line.strip() or "Enter"}))

    def _phi(self) -> float:
        """Return the newest angle from upright, in [-pi, pi) [rad]; NaN without a zero."""
        if self.zero is None or not self._samples:
            return nan
        return self._angle(self._samples[-1].counts)

    def _angle(self, counts: float) -> float:
        zero = 0.0 if self.zero is None else self.zero
        return (2.0 * pi - (counts - zero) * self._params.resolution) % (2.0 * pi) - pi

    # Outputs.

    def _notify(self, name: str, text: str) -> None:
        self._events.append(OperatorMessage(name, text))

    def _ask(self, name: str, text: str, answers: tuple[str, ...]) -> None:
        self._answers, self._answer = answers, None
        self._events.append(OperatorMessage(name, text, answers))

    def _go(self, event: states.RunEvent) -> None:
        self.state = states.step(self.state, event)
        self._begin_phase()

    def _begin_phase(self) -> None:
        self._ticks = 0
        self._answers, self._pressed = (), False

    def _stop(self, cause: End) -> None:
        """Latch a stop; the ramp begins with this tick's setpoints."""
        latched, before = self.state.latched, self.phase
        self.state = states.stop(self.state, cause, cause.outcome in rules.FROM_MEASURED)
        if latched:
            return
        if before is Phase.BALANCING and self.began is not None:
            self.ended = self.began + self._ticks * self._h
        self.phase_before = before
        self._begin_phase()
        self._notify("stopping", describe(cause))

    def _still(self) -> Setpoints:
        self._dq = (0.0,) * len(self._q)
        return self._q, self._q

    def _along(self, path: Path, begin: float) -> Setpoints:
        """Return the next setpoints on a path, at a time since its begin [s]."""
        first, second = path.at(begin + 0.5 * self._h), path.at(begin + self._h)
        self._q, self._dq = second.q, second.dq
        return first.q, second.q

    def _wait(self) -> tuple[()]:
        """Send nothing while the link stands still: the arm comes to rest at its last target."""
        self._begin_anew(0, 0, LINK_STALLED)
        if self.phase is not Phase.HOMING:
            self._controller.hold()
        if self.phase is not Phase.BALANCING:
            self._ticks -= 1  # its path waits, too
        else:
            observed, estimate = self._controller.observation, self._controller.estimate
            self._record = TickRecord(*observed, self._controller.box, 0.0, *estimate[:3])
        return ()

    # The phases.

    def _path_home(self) -> Path:
        """Return the path to home from the commanded joints, at rest."""
        velocity = [HOMING_SHARE * joint.velocity for joint in self._arm.joints]
        acceleration = [HOMING_SHARE * joint.acceleration for joint in self._arm.joints]
        return path_within(self._q, self._arm.home, velocity, acceleration)

    def _home(self, now: float) -> Setpoints:
        if self._ticks * self._h < self._path.duration:
            return self._along(self._path, self._ticks * self._h)
        self._go(states.RunEvent.ARRIVED)
        self._controller.begin(0.0, 0.0)
        self._q = self._controller.q
        question = "Is this home, flange down, the track free on both sides? y or n"
        self._ask("home", question, YES_OR_NO)
        return self._still()

    def _confirm(self, now: float) -> Setpoints:
        if self._answer == "y":
            self._go(states.RunEvent.CONFIRMED)
            self._rest = _Rest()
            self._notify("hang", "Let the pendulum hang, and steady it with a finger.")
        elif self._answer == "n":
            self._stop(End(Outcome.OPERATOR, {"typed": "n"}))
            return self._come_to_rest(now)
        return self._still()

    def _reference(self, now: float) -> Setpoints:
        rest = self._rest
        if not rest.lasted >= REST_TIME:
            self._answers, self._pressed = (), False
        elif not self._answers:
            still = "The pendulum hangs still. Take your hand away, then press its button or Enter."
            self._ask("reference", still, (OK,))
        elif self._pressed or self._answer == OK:
            self.zero = rest.middle
            if self._torques:
                self._at_home = self._torque_sum / self._torques
            self._go(states.RunEvent.REFERENCED)
            self._swing = _Swing(self._controller.x, REST_BEFORE, 1.0, 1)
            self._motion.clear()
            self._notify("swing", "Self-test: the arm moves by 40 mm. Keep your hands off.")
        return self._still()

    def _test(self, now: float) -> Setpoints:
        """Move, record and judge the swing, then return home."""
        swing, h = self._swing, self._h
        if swing.judged is not None:
            return self._after_test(now, swing.judged)
        t = self._ticks * h - swing.begin
        if -REST_BEFORE <= t < MOVE_TIME - 0.5 * h:
            return self._glide(swing.path, t)
        if t >= MOVE_TIME + SWING_TIME and not swing.asked:
            swing.asked = True
            self._job = partial(
                self_test.self_test,
                *swing.encoder.values(),
                *swing.pivot.values(),
                pendulum=self._params.pendulum,
                counts_per_rev=round(2.0 * pi / self._params.resolution),
                resting=self.zero or 0.0,
                delay=0.0,
            )
        if swing.asked and isinstance(self._result, Exception):
            self._stop(End(Outcome.SELF_TEST, {"text": f"it failed ({self._result})"}))
            return self._come_to_rest(now)
        if swing.asked and self._result is not None:
            result: SelfTest = self._result
            self._notify("self-test", f"Self-test: {result.reason}.")
            if result.verdict is SelfTestVerdict.REPEAT and swing.number < MAX_SWINGS:
                begin = self._ticks * h + REST_BEFORE
                self._swing = _Swing(self._controller.x, begin, -swing.direction, swing.number + 1)
            elif result.verdict in (SelfTestVerdict.PASSED, SelfTestVerdict.ZERO):
                swing.judged = result
                if self._alternatives and result.verdict is SelfTestVerdict.PASSED:
                    carried = tuple(each.actuator for each in self._alternatives)
                    self._job = partial(choose_actuator, carried, *self._motion.values())
                    self._selects = True
                swing.path = Path((self._controller.x,), (0.0,), RETURN_TIME)
                swing.begin = self._ticks * h + h
            else:
                self._stop(End(Outcome.SELF_TEST, {"text": result.reason}))
                return self._come_to_rest(now)
        return self._glide(Path((0.0,), (0.0,), 0.0), 1.0)

    def _after_test(self, now: float, result: SelfTest) -> Setpoints:
        t = self._ticks * self._h - self._swing.begin
        if self._selects and isinstance(self._result, Exception):
            text = f"the selection of an actuator failed ({self._result})"
            self._stop(End(Outcome.SELF_TEST, {"text": text}))
            return self._come_to_rest(now)
        if self._selects and self._result is not None:
            self._selects, self._choice = False, self._result
            carried = [each.actuator for each in self._alternatives]
            self._notify(ACTUATOR, self._result.describe(carried))
        if t < RETURN_TIME + REST_BEFORE or self._selects:
            return self._glide(self._swing.path, t)
        if abs(self._controller.x) > HOME_TOLERANCE:  # a stall has cost a part of the way
            self._swing.path = Path((self._controller.x,), (0.0,), RETURN_TIME)
            self._swing.begin = (self._ticks + 1) * self._h
            return self._glide(self._swing.path, -self._h)
        if result.verdict is SelfTestVerdict.ZERO:
            self._go(states.RunEvent.REFUSED)
            self.zero, self._rest = None, _Rest()
            self._notify("hang", "Let the pendulum hang freely, and steady it with a finger.")
        else:
            self.zero = (self.zero or 0.0) + result.zero.value / self._params.resolution
            if self._choice is not None:
                self._assume(self._alternatives[self._choice.chosen])
            if self._excitation is None:
                self._ask_to_lift()
            else:
                self._go(states.RunEvent.EXCITED)
                self._motion.clear()
                seconds = 0.5 * self._h * len(self._excitation.setpoints)
                text = f"Excitation: every joint moves about home for {seconds:.0f} s. Keep away."
                self._notify("excitation", text)
        return self._still()

    def _ask_to_lift(self) -> None:
        self._go(states.RunEvent.PASSED)
        self._release.reset()
        self._notify("lift", "Lift the pendulum until it stands upright, and hold it there.")

    def _excite(self, now: float) -> Setpoints:
        """Move every joint, identify the arm, and assume what was found."""
        plan = self._excitation
        if plan is None:  # the phase follows from an excitation
            return self._still()
        row, h = 2 * self._ticks, self._h
        if row < len(plan.setpoints):
            first, second = (tuple(each) for each in plan.setpoints[row - 1 : row + 1].tolist())
            speeds = (plan.setpoints[row] - plan.setpoints[row - 1]) / (0.5 * h)
            self._q, self._dq = second, tuple(speeds.tolist())
            return first, second
        over = (row - len(plan.setpoints)) * 0.5 * h
        if over > REST_AFTER_EXCITATION and not self._measured_all:
            self._measured_all = True
            self._job = partial(plan.identify, *self._motion.values())
            self._notify("notice", "The arm is identified; this takes some seconds.")
        if self._result is not None:
            try:
                if isinstance(self._result, Exception):
                    raise self._result
                self.identified = self._result
                response, text = plan.respond(self._result)
            except Exception as error:  # the arm comes to rest, whatever failed
                self._stop(End(Outcome.UNIDENTIFIED, {"text": printable(str(error))}))
                return self._come_to_rest(now)
            self._notify(IDENTIFIED, text)
            self._assume(response)
            self._ask_to_lift()
        return self._still()

    def _assume(self, response: Alternative) -> None:
        """Assume a response of the arm from now on; the arm rests at home."""
        self._params, self._safety = response.params, response.safety
        self._controller = Controller(self._arm, response.params, self._boxes)

    def _glide(self, path: Path, t: float) -> Setpoints:
        """Move the flange along a path on its track, as the policy would."""
        h = self._h
        v = path.at(t + h).dq[0] - path.at(t).dq[0]
        return self._command(v / h)

    def _command(self, u: float) -> Setpoints:
        """Return the setpoints of the controller for an acceleration of the flange [m/s^2].

        The speed that a pause has taken comes back at `RESTART_ACCELERATION`.
        """
        if self._lost_speed != 0.0:
            most = RESTART_ACCELERATION * self._h
            gained = min(max(self._lost_speed, -most), most)
            self._lost_speed -= gained
            u += gained / self._h
        first, second = self._controller.command(u)
        self._leads = self._controller.leads
        self._q, self._dq = self._controller.q, self._controller.dq
        return first, second

    def _lift(self, now: float) -> Setpoints:
        if self._release.state is ReleaseState.ARMED:
            self._go(states.RunEvent.ARMED)
            self._notify("armed", "\aArmed. Let go.")
        return self._still()

    def _hold(self, now: float) -> Setpoints:
        state = self._release.state
        interval = round(NUDGE_INTERVAL / self._h)
        if self._ticks % interval == interval - 1:
            self._notify("nudge", "Let go. If it stands by itself, nudge it.")
        if state is ReleaseState.HELD:
            self._go(states.RunEvent.DENIED)
            self._notify("disarmed", "Your hand is still on. Hold the pendulum upright again.")
        elif state is ReleaseState.RELEASED:
            phi, phi_dot = self._falling(now)
            self._controller.begin(phi, phi_dot)
            self._lost_speed = 0.0
            self._go(states.RunEvent.RELEASED)
            self.began = now
            self._notify("balancing", "Balancing. Any key stops.")
            return self._decide(now, first=True)
        return self._still()

    def _balance(self, now: float) -> Setpoints:
        if not self._samples or self.zero is None:  # balancing follows from a reference
            self._stop(End(Outcome.ENCODER_LOST, {"text": "the encoder shows nothing"}))
        elif self._controller.limit_exceeded:
            self._stop(End(Outcome.JOINT_LIMIT))
        elif self._ticks * self._h >= self._duration - 0.5 * self._h:
            self._stop(End(Outcome.LASTED, {"duration": self._duration}))
        if self.state.latched:
            return self._come_to_rest(now)
        return self._decide(now)

    def _decide(self, now: float, *, first: bool = False) -> Setpoints:
        """Command the policy's u; stop where the policy fails, for u is then of no use."""
        u, began = nan, self._clock()
        try:
            if first:
                self._policy.reset()
            u = self._controller.decide(self._policy)
            failure = "" if isfinite(u) else f"it returned {u}"
        except BaseException as error:  # not even a request to exit may end the loop
            failure = printable(str(error)) or type(error).__name__
        took, limit = self._clock() - began, POLICY_TIME_SHARE * self._h
        if not failure and took > limit:
            failure = f"it took {1e3 * took:.1f} ms, expected at most {1e3 * limit:.1f} ms"
        u, estimate = 0.0 if failure else u, self._controller.estimate
        self._record = TickRecord(
            *self._controller.observation, self._controller.box, u, *estimate[:3]
        )
        if failure:
            self._stop(End(Outcome.POLICY, {"text": failure, "took": took, "limit": limit}))
            return self._come_to_rest(now)
        return self._command(u)

    def _come_to_rest(self, now: float) -> Setpoints:
        """Return the next setpoints on the way to rest, which keep the last lead."""
        if any(self._lead):
            self._leads = self._lead, self._lead
        motion = self._stopping
        if motion is None:
            newest = ((self._setpoints - n) % HISTORY for n in (2, 1))
            before, last = (self._references[place].tolist() for place in newest)
            q = tuple(q + ahead for q, ahead in zip(self._q, self._lead, strict=True))
            dq = stoppable_speeds(self._dq, last, before, 0.5 * self._h)
            speed = abs(self._controller.x_dot) if self.phase_before in ON_TRACK else 0.0
            motion = self._stopping = StopMotion(q, dq, speed, self._safety.limits)
            self._before_stop = self._commanded.copy()
        elif motion.goes_back and (reason := self._hold_reason()):
            motion.hold()
            self._notify("warning", f"The target holds: {reason}.")
        elif motion.at_rest and self.state.from_measured and not self._returned:
            self._returned = True
            self._go_back(motion)
        setpoints = motion.advance(self._h)
        self._q, self._dq = motion.q, motion.dq
        return setpoints

    def _hold_reason(self) -> str:
        """Return why the target holds after a stop, though the arm is elsewhere; empty for none."""
        return "a key was pressed" if self._key_after_stop else self._forbidden

    def _go_back(self, motion: StopMotion) -> None:
        """Begin the way back towards the measured posture, or say why the target holds."""
        away, joint = rules.largest_difference(self._measured, motion.q)
        place = f"Joint {joint} is measured {away:.3f} rad from its target"
        reason = self._hold_reason()
        if doubt := self._plausibility.doubt(self._measured, self._before_stop):
            reason = f"the measurement is not plausible ({doubt})"
        if reason:
            text = f"{place}, which holds: {reason}. Look at the arm."
        else:
            moved = motion.go_back(self._measured)
            text = f"{place}, which goes back by {moved:.3f} rad. Any key ends this."
        self._notify("warning", text)

    _STEPS: Final[dict[Phase, Callable[["RunController", float], Setpoints]]] = {
        Phase.HOMING: _home,
        Phase.AT_HOME: _confirm,
        Phase.REFERENCING: _reference,
        Phase.SELF_TEST: _test,
        Phase.EXCITING: _excite,
        Phase.LIFTING: _lift,
        Phase.ARMED: _hold,
        Phase.BALANCING: _balance,
        Phase.STOPPING: _come_to_rest,
    }

    def _falling(self, now: float) -> tuple[float, float]:
        """Return phi [rad] and phi_dot [rad/s] now, of a pendulum that has fallen for 40 ms.

        A free fall near upright is a cosh(w t) + b sinh(w t) / w; a and b by least squares.
        """
        w = sqrt(self._params.pendulum.w2)
        cc = cs = ss = cy = sy = 0.0
        for sample in reversed(self._samples):
            t = sample.time - now
            if t < -FALL_WINDOW:
                break
            c, s, phi = cosh(w * t), sinh(w * t) / w, self._angle(sample.counts)
            cc, cs, ss = cc + c * c, cs + c * s, ss + s * s
            cy, sy = cy + c * phi, sy + s * phi
        determinant = cc * ss - cs * cs
        return (ss * cy - cs * sy) / determinant, (cc * sy - cs * cy) / determinant


class _Recording:
    """Values at times, in memory allocated before; further ones are dropped."""

    def __init__(self, size: int) -> None:
        self._rows, self._count = np.zeros((2, size)), 0

    def add(self, time: float, value: float) -> None:
        if self._count < self._rows.shape[1]:
            self._rows[:, self._count] = time, value
            self._count += 1

    def values(self) -> Array:
        """Return times and values, shape (2, n)."""
        return self._rows[:, : self._count].copy()


class _Swing:
    """One swing of a self-test."""

    def __init__(self, x: float, begin: float, direction: float, number: int) -> None:
        self.path, self.begin = self_test.excitation(x, direction), begin
        self.direction, self.number = direction, number
        self.asked = False
        self.judged: SelfTest | None = None
        self.encoder, self.pivot = _Recording(16384), _Recording(4096)


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
