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
from typing import Final

from equipoise.control.controller import FlangePose
from equipoise.control.ticks import OK, TickInputs, TickOutput, TickRecord, missed_ticks
from equipoise.model.actuator import Actuator
from equipoise.outcomes import End, Outcome, Phase, describe
from equipoise.rig.phases.context import ArmResponse, RunContext, RunParts
from equipoise.rig.phases.preparation import Homing
from equipoise.rig.phases.stopping import Stopping
from equipoise.safety import rules
from equipoise.safety.rules import SafetyInputs

UNCERTAIN_TORQUE_FACTOR: Final = 2.0
"""Factor on the torque limits until the torques at home are known [-]: the reference is then that
at the start of the servo, where the load on the flange pulls differently."""
MAX_UNANSWERED: Final = 0.020
"""Time without a reply after which no setpoint is sent until the replies have come [s], while the
arm moves: a link that stands still delivers all setpoints at once, and the arm then goes to the
last one at its highest speed. A round trip takes 1 to 4 ms."""
LOOP_STALLED: Final = "The computer stood still: `equipoise rig doctor` looks for the cause."
"""Warning of a stall of the loop."""
PUNCTUAL: Final = frozenset({Phase.ARMED, Phase.STOPPING})
"""Phases in which late ticks count though Enter does not stop; they count in all that move."""
PHASES: Final = tuple(Phase)
"""Phases by the index that logs use."""


class RunController:
    """Controller of a run: measurements, safety rules, phase."""

    def __init__(self, parts: RunParts, response: ArmResponse, q: Sequence[float]) -> None:
        """Begin the way home from the posture that the servo holds.

        Args:
            parts: Arm, policy and options.
            response: Response of the arm in use; a phase may assume another one.
            q: Measured joints, all of them [rad].
        """
        self._run = run = RunContext(parts, response, q)
        self._stopping = Stopping(run)
        run.phase, run.stopping = Homing(run), self._stopping
        run.phase.enter()
        self._monitor = rules.MonitorState()
        self._pose: FlangePose | None = None
        self._overdue, self._warned = 0.0, False

    @property
    def h(self) -> float:
        """Time between ticks [s]."""
        return self._run.h

    @property
    def phase(self) -> Phase:
        """Phase of the run."""
        return self._run.phase.kind

    @property
    def end(self) -> End | None:
        """Cause of the latched stop; None before a stop."""
        return self._run.end

    @property
    def zero(self) -> float | None:
        """Count of the hanging pendulum; None before the reference."""
        return self._run.encoder.zero

    @property
    def identified(self) -> Actuator | None:
        """Actuator that the excitation has identified, if any."""
        return self._run.identified

    @property
    def lasted(self) -> float:
        """Time for which the policy has acted [s]."""
        run = self._run
        if run.began is None:
            return 0.0
        return run.phase.ticks * run.h if run.ended is None else run.ended - run.began

    def tick(self, now: float, inputs: TickInputs) -> TickOutput:
        """Process the inputs since the last tick, and return the setpoints of this one.

        Args:
            now: The time [s].
            inputs: Samples, replies, the operator's input and faults.
        """
        run, h = self._run, self._run.h
        missed = missed_ticks(inputs.lateness, h)
        late = max(inputs.lateness - missed * h, 0.0)
        if inputs.paused(h):
            run.begin_anew(missed, inputs.unsent, LOOP_STALLED)
        self._take_measurements(inputs)
        self._take_lines(inputs.lines)
        run.result, run.job = inputs.result, None
        for fault in inputs.faults:
            run.stop(fault)
        self._check_rules(now, inputs.lateness)
        run.record = TickRecord(estimated_phi=run.encoder.phi())
        stalls = self._overdue > MAX_UNANSWERED and run.phase.moves
        setpoints = run.phase.wait(now) if stalls else run.phase.tick(now)
        stops = run.phase is self._stopping
        for place, setpoint in enumerate(setpoints):
            sent = now - late + place * 0.5 * h
            run.sent.store(sent, setpoint)
            run.phase.note_sent(sent, setpoint)
        run.phase.ticks += 1
        events, run.events = run.events, []
        output = TickOutput(
            setpoints, run.q, run.dq, PHASES.index(self.phase), run.record, events, run.job
        )
        return output._replace(to_rest=stops, done=self._stopping.done)

    def _take_measurements(self, inputs: TickInputs) -> None:
        run = self._run
        for sample in inputs.samples:
            run.encoder.add(sample)
            run.pressed = run.pressed or sample.pressed
            run.phase.take_sample(sample)
        run.joints.begin_tick()
        rests_at_home = self.phase in (Phase.AT_HOME, Phase.REFERENCING)
        for reply in inputs.replies:
            if run.joints.add(reply, rests_at_home):
                run.phase.take_joints(run.joints.time, run.joints.q)

    def _take_lines(self, lines: Sequence[str]) -> None:
        """Accept an expected answer; other input stops, except Enter while nothing moves."""
        run = self._run
        run.answer = None
        run.key_after_stop = run.key_after_stop or (run.end is not None and bool(lines))
        for line in lines:
            answer = line.strip().lower() or OK
            if answer in run.answers:
                run.answer = answer
            elif answer != OK or run.phase.moves:
                run.stop(End(Outcome.OPERATOR, {"typed": line.strip() or "Enter"}))

    # Safety.

    def _check_rules(self, now: float, lateness: float) -> None:
        """Check the safety rules, and stop where one is broken."""
        run, params = self._run, self._run.response.safety
        if run.joints.torque_at_home is None:
            # The robot controller knows the arm's weight, but not the load on its flange.
            uncertain = tuple(UNCERTAIN_TORQUE_FACTOR * torque for torque in params.torque)
            params = params._replace(torque=uncertain)
        warned, bridged = self._warned, run.encoder.dropouts.bridged
        inputs = self._safety_inputs(now, lateness)
        self._monitor = rules.update_monitor(params, self._monitor, inputs)
        # The observer receives no forbidden measurement; the rules then check its estimate, too.
        measured = inputs._replace(on_track=False, balancing=False)
        if inputs.balancing and rules.check(params, self._monitor, measured) is None:
            run.observe(now)
            estimate = run.controller.estimate
            inputs = inputs._replace(x_dot=estimate.v, phi=estimate.phi)
        broken = list(rules.violations(params, self._monitor, inputs))
        for violation in broken:
            run.stop(violation)
        others = (each for each in broken if each.outcome not in rules.FROM_MEASURED)
        run.forbidden = next(map(describe, others), "")
        if not broken and bridged and not warned:
            self._warned = True
            lost = "An encoder sample was lost on its way. Look at its cable later."
            run.notify("warning", lost)

    def _safety_inputs(self, now: float, lateness: float) -> SafetyInputs:
        """Return the inputs of the safety rules, with the estimate of the tick before."""
        run, joints, balancing = self._run, self._run.joints, self.phase is Phase.BALANCING
        punctual = run.phase.moves or self.phase in PUNCTUAL
        if joints.known_since == inf or (not punctual and missed_ticks(lateness, run.h)):
            joints.known_since = now  # a late loop reads late; nothing moves meanwhile
        # The lateness of the loop itself is not the robot's delay.
        self._overdue = run.sent.unanswered_time(now - lateness, joints.answered)
        inputs = SafetyInputs(
            # A late tick is no danger while nothing moves; the fit of a swing causes some.
            lateness=lateness if punctual else 0.0,
            overdue=self._overdue,
            measured_age=now - joints.known_since,
            torque=joints.new_torque(),
            balancing=balancing,
            phi=run.controller.estimate.phi if balancing else 0.0,
            **run.encoder.take_checks(now),
        )
        if joints.fresh:
            self._pose = run.flange.pose(joints.q)
            expected = run.sent.in_force(joints.time - run.response.safety.reaction)
            inputs = inputs._replace(measured=joints.q, expected=expected)
        if run.phase.on_track and self._pose is not None:
            x_dot = run.controller.estimate.v if balancing else run.controller.x_dot
            if (speed := self._stopping.flange_speed) is not None:
                x_dot = speed
            inputs = inputs._replace(on_track=True, x_dot=x_dot, **self._pose._asdict())
        return inputs
