"""Controller of a run on a rig, from the first setpoint to rest.

In each tick it takes samples, replies and typed lines, checks the safety rules, and lets the phase
of the run (`equipoise.rig.phases`) make the setpoints. Any failure latches a stop, whose ramp
begins in the tick that detects it.

The controller uses no clock, link or file. Equal inputs give equal outputs: the replay of a log
gives the same setpoints.

The two setpoints of a tick are the arm's targets half a tick later and a whole one, as in the
training (`equipoise.control.control_step`).
"""

from collections.abc import Sequence
from math import inf
from typing import Any, Final

from equipoise.control.controller import FlangePose
from equipoise.control.ticks import OK, TickInputs, TickOutput, TickRecord, missed_ticks
from equipoise.outcomes import End, Outcome, Phase, describe
from equipoise.rig.phases.context import RunContext
from equipoise.rig.phases.preparation import Homing
from equipoise.rig.phases.readings import MAX_ROUND_TRIP
from equipoise.rig.phases.stopping import Stopping
from equipoise.rig.request import RunRequest
from equipoise.safety import rules
from equipoise.safety.repeats import MAX_REPEATS, REPEAT_WINDOW, RepeatMonitor
from equipoise.safety.rules import SafetyInputs

UNCERTAIN_TORQUE_FACTOR: Final = 2.0
"""Factor on the torque limits until the torques at home are known [-]: the reference is then that
at the start of the servo, where the load on the flange pulls differently."""
PHASES: Final = tuple(Phase)
"""Phases by the index that logs use."""


class RunController(RunContext):
    """Controller of a run: measurements, safety rules, phase."""

    def __init__(self, request: RunRequest, q: Sequence[float], **rig: Any) -> None:
        """Begin the way home from the posture that the servo holds; see `RunContext`."""
        super().__init__(request, q, **rig)
        self.phase, self.stopping = Homing(self), Stopping(self)
        self.phase.enter()
        self._monitor = rules.MonitorState()
        self._pose: FlangePose | None = None
        self._stalls, self._overdue, self._link_stalled = RepeatMonitor(), 0.0, False

    @property
    def lasted(self) -> float:
        """Time for which the policy has acted [s]."""
        if self.began is None:
            return 0.0
        return self.phase.ticks * self.h if self.ended is None else self.ended - self.began

    def tick(self, now: float, inputs: TickInputs) -> TickOutput:
        """Process the inputs since the last tick, and return the setpoints of this one.

        Args:
            now: The time [s].
            inputs: Samples, replies, the operator's input and faults.
        """
        h = self.h
        missed = missed_ticks(inputs.lateness, h)
        late = max(inputs.lateness - missed * h, 0.0)
        if paused := inputs.paused(h):
            warning = "The control loop stalled; `equipoise rig doctor` looks for the cause."
            self.begin_anew(missed, inputs.unsent, warning)
        self._take_measurements(inputs)
        self._take_lines(inputs.lines)
        self.result, self.job = inputs.result, None
        for fault in inputs.faults:
            self.stop(fault)
        self._check_rules(now, inputs.lateness)
        self.record = TickRecord(estimated_phi=self.encoder.phi())
        silent, before = self._overdue > MAX_ROUND_TRIP, self._link_stalled
        self._link_stalled = silent or self.joints.late
        stalls = paused or (self._link_stalled and not before)
        if stalls and self.phase.moves and self._stalls.add(now):
            name = "the loop" if paused else "the robot's link"
            counted = {"value": MAX_REPEATS, "duration": REPEAT_WINDOW}
            self.stop(End(Outcome.STALLS, {"name": name, **counted}))
        waits = silent and self.phase.moves
        setpoints = self.phase.wait(now) if waits else self.phase.tick(now)
        stops = self.phase is self.stopping
        for place, setpoint in enumerate(setpoints):
            sent = now - late + place * 0.5 * h
            self.sent.store(sent, setpoint)
            self.phase.note_sent(sent, setpoint)
        self.phase.ticks += 1
        events, self.events = self.events, []
        output = TickOutput(
            setpoints, self.q, self.dq, PHASES.index(self.phase.kind), self.record, events, self.job
        )
        return output._replace(to_rest=stops, done=self.stopping.done)

    def _take_measurements(self, inputs: TickInputs) -> None:
        for sample in inputs.samples:
            self.encoder.add(sample)
            self.pressed = self.pressed or sample.pressed
            self.phase.take_sample(sample)
        self.joints.begin_tick()
        rests_at_home = self.phase.kind in (Phase.AT_HOME, Phase.REFERENCING)
        for reply in inputs.replies:
            if self.joints.add(reply, rests_at_home):
                self.phase.take_joints(self.joints.time, self.joints.q)

    def _take_lines(self, lines: Sequence[str]) -> None:
        """Accept an expected answer; other input stops, except Enter while nothing moves."""
        self.answer = None
        self.key_after_stop = self.key_after_stop or (self.end is not None and bool(lines))
        for line in lines:
            answer = line.strip().lower() or OK
            if answer in self.answers:
                self.answer = answer
            elif answer != OK or self.phase.moves:
                self.stop(End(Outcome.OPERATOR, {"typed": line.strip() or "Enter"}))

    # Safety.

    def _check_rules(self, now: float, lateness: float) -> None:
        """Check the safety rules, and stop where one is broken."""
        params = self.response.safety
        if self.joints.torque_at_home is None:
            # The robot controller knows the arm's weight, but not the load on its flange.
            uncertain = tuple(UNCERTAIN_TORQUE_FACTOR * torque for torque in params.torque)
            params = params._replace(torque=uncertain)
        inputs = self._safety_inputs(now, lateness)
        self._monitor = rules.update_monitor(params, self._monitor, inputs)
        # The observer receives no forbidden measurement; the rules then check its estimate, too.
        measured = inputs._replace(on_track=False, balancing=False)
        if inputs.balancing and rules.check(params, self._monitor, measured) is None:
            self.observe(now)
            estimate = self.controller.estimate
            inputs = inputs._replace(x_dot=estimate.v, phi=estimate.phi)
        broken = list(rules.violations(params, self._monitor, inputs))
        for violation in broken:
            self.stop(violation)
        others = (each for each in broken if each.outcome not in rules.FROM_MEASURED)
        self.forbidden = next(map(describe, others), "")
        if not broken and self.encoder.bridged:
            self.warn_once("An encoder sample was lost on its way. Look at its cable later.")

    def _safety_inputs(self, now: float, lateness: float) -> SafetyInputs:
        """Return the inputs of the safety rules, with the estimate of the tick before."""
        joints, balancing = self.joints, self.phase.kind is Phase.BALANCING
        punctual = self.phase.moves or self.phase.kind in (Phase.ARMED, Phase.STOPPING)
        if joints.known_since == inf or (not punctual and missed_ticks(lateness, self.h)):
            joints.known_since = now  # a late loop reads late; nothing moves meanwhile
        # The lateness of the loop itself is not the robot's delay.
        self._overdue = self.sent.unanswered_time(now - lateness, joints.answered)
        inputs = SafetyInputs(
            # A late tick is no danger while nothing moves; the fit of a swing causes some.
            lateness=lateness if punctual else 0.0,
            overdue=self._overdue,
            measured_age=now - joints.known_since,
            torque=joints.new_torque(),
            balancing=balancing,
            phi=self.controller.estimate.phi if balancing else 0.0,
            **self.encoder.take_checks(now),
        )
        if joints.fresh:
            self._pose = self.flange.pose(joints.q)
            expected = self.sent.in_force(joints.time - self.response.safety.reaction)
            inputs = inputs._replace(measured=joints.q, expected=expected)
        if self.phase.on_track and self._pose is not None:
            x_dot = self.controller.estimate.v if balancing else self.controller.x_dot
            if (speed := self.stopping.flange_speed) is not None:
                x_dot = speed
            inputs = inputs._replace(on_track=True, x_dot=x_dot, **self._pose._asdict())
        return inputs
