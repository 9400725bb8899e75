"""Controller of a run on a rig, from the first setpoint to rest.

In each tick it takes samples, replies and typed lines, checks the safety rules, and lets the script
of the run (`equipoise.rig.script`) make the setpoints. Any failure latches a stop, whose ramp
begins in the tick that detects it: the script is closed, and `come_to_rest` takes its place.

The controller uses no link or file. Equal inputs, and equal results of the script's long jobs, give
equal outputs: the replay of a log gives the same setpoints.

The two setpoints of a tick are the arm's targets half a tick later and a whole one, as in the
training (`equipoise.control.control_step`).
"""

from collections import deque
from collections.abc import Sequence
from math import inf
from typing import Final

from equipoise.control.controller import FlangePose
from equipoise.control.ticks import OK, TickInputs, TickOutput, TickRecord, missed_ticks
from equipoise.outcomes import End, Outcome, Phase, describe
from equipoise.rig.readings import HISTORY, MAX_ROUND_TRIP
from equipoise.rig.script import OBSERVED, PhaseError, Run, Setpoints, Tick, come_to_rest, script
from equipoise.safety import rules
from equipoise.safety.monitors import MAX_REPEATS, REPEAT_WINDOW, RepeatMonitor
from equipoise.safety.rules import SafetyInputs

UNCERTAIN_TORQUE_FACTOR: Final = 2.0
"""Factor on the torque limits until the torques at home are known [-]: the reference is then that
at the start of the servo, where the load on the flange pulls differently."""
PHASES: Final = tuple(Phase)
"""Phases by the index that logs use."""
CONTROLLED: Final = {Phase.SELF_TEST, *OBSERVED}
"""Phases in which the controller moves the flange along its track."""
MOVING: Final = {Phase.HOMING, Phase.EXCITING, *CONTROLLED}
"""Phases in which the arm moves: Enter stops them, too, and a silent link is sent nothing."""
OFF_TRACK: Final = {Phase.HOMING, Phase.EXCITING}
"""Phases in which the rules of the flange do not apply."""


class RunController:
    """Controller of a run: measurements, safety rules, script, stop."""

    def __init__(self, run: Run) -> None:
        """Begin a run with the first step of its script.

        Args:
            run: State of the run, at its begin.

        Raises:
            ArmError: Home is too close to a limit for the excitation.
        """
        self.run = run
        """State of the run."""
        self.h = run.h
        """Time between ticks [s]."""
        self._script = script(run)
        next(self._script)
        self._tick = Tick()
        self.end: End | None = None
        """Cause of the latched stop, the first one."""
        self.from_measured = False
        """Whether any cause so far shows that the arm is not at its setpoint."""
        self._stopped = Phase.STOPPING  # the phase before the stop
        self.key_after_stop = False
        """Whether the operator has typed anything after the stop."""
        self._sent = deque([(-inf, run.q)] * HISTORY, HISTORY)  # with the times of sending [s]
        self._monitor = rules.MonitorState()
        self._pose: FlangePose | None = None
        self._stalls, self._overdue, self._link_stalled = RepeatMonitor(), 0.0, False
        self._warnings = set[str]()

    def tick(self, now: float, inputs: TickInputs) -> TickOutput:
        """Process the inputs since the last tick, and return the setpoints of this one.

        Args:
            now: The time [s].
            inputs: Samples, replies, the operator's input and faults.
        """
        run, h = self.run, self.h
        missed = missed_ticks(inputs.lateness, h)
        run.missed += missed
        late = max(inputs.lateness - missed * h, 0.0)
        if paused := inputs.paused(h):
            self._rest(missed, inputs.unsent, "The control loop")
        run.encoder.add(inputs.samples, now)
        rests_at_home = run.phase in (Phase.AT_HOME, Phase.REFERENCING)
        self._tick.samples += inputs.samples
        self._tick.joints += run.joints.add(inputs.replies, rests_at_home)
        self._take_lines(inputs.lines)
        for fault in inputs.faults:
            self.stop(fault)
        self._check_rules(now, inputs.lateness)
        run.record = TickRecord(estimated_phi=run.encoder.phi())
        silent, before = self._overdue > MAX_ROUND_TRIP, self._link_stalled
        self._link_stalled = silent or run.joints.late
        stalls = paused or (self._link_stalled and not before)
        if stalls and run.phase in MOVING and self._stalls.add(now):
            name = "the loop" if paused else "the robot's link"
            counted = {"value": MAX_REPEATS, "duration": REPEAT_WINDOW}
            self.stop(End(Outcome.STALLS, {"name": name, **counted}))
        setpoints: Setpoints = ()
        if silent and run.phase in MOVING:
            self._wait()
        else:
            setpoints = self._step(now)
            run.ticks += 1
        for place, setpoint in enumerate(setpoints):
            self._tick.sent.append((now - late + place * 0.5 * h, setpoint))
        self._sent += self._tick.sent
        if run.phase is Phase.BALANCING:
            run.balanced += 1
        messages, run.messages = run.messages, []
        return TickOutput(
            setpoints,
            run.q,
            run.dq,
            PHASES.index(run.phase),
            run.record,
            messages,
            to_rest=run.phase is Phase.STOPPING,
            done=run.done,
        )

    def stop(self, end: End) -> None:
        """Latch a stop; the ramp begins with this tick's setpoints."""
        self.from_measured = self.from_measured or end.outcome in rules.FROM_MEASURED
        if self.end is None:
            self.end, self._stopped = end, self.run.phase
            self._script.close()
            on_track = self._stopped not in OFF_TRACK
            self._script = come_to_rest(self.run, self._sent, on_track=on_track)
            next(self._script)
            self.run.enter(Phase.STOPPING, "stopping", describe(end))

    # Inputs.

    def _take_lines(self, lines: Sequence[str]) -> None:
        """Accept an expected answer; other input stops, except Enter while nothing moves."""
        self.key_after_stop = self.key_after_stop or (self.end is not None and bool(lines))
        for line in lines:
            answer = line.strip().lower() or OK
            if answer in self.run.answers:
                self._tick.answer = answer
            elif answer != OK or self.run.phase in MOVING:
                self.stop(End(Outcome.OPERATOR, {"typed": line.strip() or "Enter"}))

    # Motion.

    def _step(self, now: float) -> Setpoints:
        """Return the next setpoints of the script, which a stop replaces."""
        tick, self._tick = self._tick, Tick()
        tick.now, tick.away = now, self.from_measured
        try:
            return self._script.send(tick)
        except StopIteration as finished:
            self.stop(finished.value)
        except PhaseError as error:
            self.stop(error.end)
        return self._script.send(tick)

    def _rest(self, missed: int, unsent: bool, part: str) -> None:
        """Begin the motion anew from the last setpoint sent, where the arm rests.

        Args:
            missed: Number of missed ticks.
            unsent: Whether the second setpoint of the last tick was not sent.
            part: The part that stood still.
        """
        run, moved = self.run, any(self.run.dq)
        if unsent:
            self._sent.pop()
        run.q, run.dq = self._sent[-1][1], (0.0,) * len(run.q)
        if run.phase in CONTROLLED:
            run.lost_speed += run.controller.x_dot
            run.controller.rest(run.q, missed, unsent)
        if run.phase is Phase.BALANCING:
            run.balanced += missed
        self._tick.stalled = True
        if moved:
            self._warn_once(f"{part} stalled; `equipoise rig doctor` looks for the cause.")

    def _wait(self) -> None:
        """Send nothing while the link stands still; the time of a balance continues."""
        run = self.run
        self._rest(0, False, "The robot's link")
        if run.phase in CONTROLLED:
            run.controller.hold()
        if run.phase in OBSERVED:
            run.record_decision(0.0)

    # Safety.

    def _check_rules(self, now: float, lateness: float) -> None:
        """Check the safety rules, and stop where one is broken."""
        run, params = self.run, self.run.safety
        if run.joints.torque_at_home is None:
            # The robot controller knows the arm's weight, but not the load on its flange.
            uncertain = tuple(UNCERTAIN_TORQUE_FACTOR * torque for torque in params.torque)
            params = params._replace(torque=uncertain)
        inputs = self._safety_inputs(now, lateness)
        self._monitor = rules.update_monitor(params, self._monitor, inputs)
        # The observer receives no forbidden measurement; the rules then check its estimate, too.
        measured = inputs._replace(on_track=False, balancing=False)
        if run.phase in OBSERVED and not rules.violations(params, self._monitor, measured):
            self._observe(now)
            estimate = run.controller.estimate
            inputs = inputs._replace(x_dot=estimate.pivot_v, phi=estimate.phi)
        broken = rules.violations(params, self._monitor, inputs)
        for violation in broken:
            self.stop(violation)
        others = (end for end in broken if end.outcome not in rules.FROM_MEASURED)
        forbidden = next(map(describe, others), "")
        self._tick.hold_reason = "a key was pressed" if self.key_after_stop else forbidden
        if not broken and run.encoder.bridged:
            self._warn_once("An encoder sample was lost on its way. Look at its cable later.")

    def _safety_inputs(self, now: float, lateness: float) -> SafetyInputs:
        """Return the inputs of the safety rules, with the estimate of the tick before."""
        run, joints, controller = self.run, self.run.joints, self.run.controller
        observed = run.phase in OBSERVED
        punctual = run.phase in (*MOVING, Phase.ARMED, Phase.STOPPING)
        if joints.known_since == inf or (not punctual and missed_ticks(lateness, run.h)):
            joints.known_since = now  # a late loop reads late; nothing moves meanwhile
        unanswered = [sent for sent, _ in self._sent if sent > joints.answered + 0.001]  # [s]
        # The lateness of the loop itself is not the robot's delay.
        self._overdue = max(now - lateness - min(unanswered, default=inf), 0.0)
        inputs = SafetyInputs(
            # A late tick is no danger while nothing moves; the fit of a swing causes some.
            lateness=lateness if punctual else 0.0,
            overdue=self._overdue,
            measured_age=now - joints.known_since,
            torque=joints.torque,
            balancing=run.phase is Phase.BALANCING,
            phi=controller.estimate.phi if observed else 0.0,
            **run.encoder.checks(now),
        )
        if joints.fresh:
            self._pose = controller.pose(joints.q)
            since = joints.time - run.safety.reaction
            in_force = (q for sent, q in reversed(self._sent) if sent <= since)
            expected = next(in_force, self._sent[0][1])
            inputs = inputs._replace(measured=joints.q, expected=expected)
        phase = run.phase if self.end is None else self._stopped
        if phase not in OFF_TRACK and self._pose is not None:
            x_dot = controller.estimate.pivot_v if observed else controller.x_dot
            if run.phase is Phase.STOPPING and run.ticks > 0:
                # The controller does not know the way to rest, which has begun.
                before = [q - run.h * dq for q, dq in zip(run.q, run.dq, strict=True)]
                x_dot = (controller.pose(run.q).x - controller.pose(before).x) / run.h
            inputs = inputs._replace(on_track=True, x_dot=x_dot, **self._pose._asdict())
        return inputs

    def _observe(self, now: float) -> None:
        """Pass the measurements of this tick to the observer."""
        encoder, joints, h = self.run.encoder, self.run.joints, self.run.h
        age = now - encoder.samples[-1].time
        sample = (encoder.samples[-1].counts - encoder.zero, age) if age <= h else None
        reply = (joints.q, now - joints.time) if joints.fresh else None
        self.run.controller.observe(sample, reply, lambda back: encoder.before(now - back, h))

    def _warn_once(self, text: str) -> None:
        """Send a warning, the first time only."""
        if text not in self._warnings:
            self._warnings.add(text)
            self.run.notify("warning", text)
