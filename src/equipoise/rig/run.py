"""Run of a policy on a rig: connect, pre-flight, questions to the operator, run, rest.

The same sequence serves a real rig in real time (`equipoise.rig.processes`) and an emulated
one in virtual time; arguments carry the differences.
"""

import gc
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import count
from math import isnan
from pathlib import Path
from typing import Final

from equipoise.control.ticks import OperatorMessage
from equipoise.errors import EquipoiseError, LinkError, OutsideError
from equipoise.log.conditions import Reference, RunEnd
from equipoise.log.recorder import CONNECTING, WORD_TYPED, Recorder, push_event
from equipoise.outcomes import End, Outcome
from equipoise.printable import printable
from equipoise.rig.checks import check_fit, preflight, require
from equipoise.rig.clocks import DrainingClock, ended_stalls
from equipoise.rig.connection import Rig, connect
from equipoise.rig.guarded import GuardedRobot
from equipoise.rig.interfaces import Operator
from equipoise.rig.loop import run_loop, tell
from equipoise.rig.request import RunRequest
from equipoise.rig.run_controller import RunController
from equipoise.rig.script import Run, Submit
from equipoise.rig.series import LEADS_ON, RunLogs
from equipoise.settings import HANGING

CHECKLIST: Final = (
    ("estop", "Is the E-stop in an operator's hand, and was it tested today?"),
    ("fence", "Is the fence closed, with nobody within reach of arm and pendulum?"),
    ("monitoring", "Is the robot's own monitoring of its speed active?"),
)
"""Safety questions before a run on any robot; the operator types the word to acknowledge each."""
STOP: Final = "stop"
"""Word that a signal becomes in the loop's input."""
ALONE: Final = "the operator's process has ended"
"""Word in the loop's input once the parent process has ended."""


class OperatorChannel:
    """Channel to the operators of a run: messages to all of them, and their typed lines."""

    def __init__(self, operators: Sequence[Operator], recorder: Recorder, rig: Rig) -> None:
        """Connect operators to a run.

        Args:
            operators: The operators; each may type.
            recorder: Rings for the log.
            rig: The rig, whose links are checked while a question is open.
        """
        self._operators, self._recorder, self._rig = operators, recorder, rig
        self._clock = DrainingClock(rig.clock, rig.sensor)
        self._pending: list[str] = []

    def notify(self, event: OperatorMessage) -> None:
        """Send a message to all operators."""
        for operator in self._operators:
            operator.notify(event)

    def read_input(self) -> list[str]:
        """Return the pending typed lines, the oldest first."""
        lines, self._pending = self._pending, []
        return lines + [line for operator in self._operators for line in operator.read_input()]

    def tell(self, name: str, text: str, answers: tuple[str, ...] = ()) -> None:
        """Log a message, and send it to all operators; with answers it is a question."""
        event = OperatorMessage(name, text, answers)
        tell(self._recorder, self, self._clock.now(), event)

    def ask(self, name: str, question: str, *answers: str) -> str:
        """Send a question, and return the first expected answer or denial.

        Raises:
            LinkError: A device has failed.
        """
        text = question
        while True:
            self.tell(name, text, answers)
            while (word := self.read_word()) is None:
                until = self._clock.now() + 0.02
                self.check_links()
                self._clock.wait_until(until)
            if word in (*answers, "n", "no", STOP, ALONE):
                return word
            text = f"{word!r} is not {' or '.join(answers)}. {question}"

    def check_links(self) -> None:
        """Request the joints, and drop the encoder's samples; each raises where its link failed."""
        self._rig.robot.measured()
        self._rig.sensor.samples()

    def read_word(self) -> str | None:
        """Return the first pending line, which is logged; None without one."""
        if not (lines := self.read_input()):
            return None
        word, *self._pending = lines
        push_event(self._recorder.event, self._clock.now(), OperatorMessage(WORD_TYPED, word))
        return word.strip().lower()


def run_on_rig(
    request: RunRequest,
    rig: Rig,
    operators: Sequence[Operator],
    recorder: Recorder,
    *,
    prepare: Callable[[], dict[str, str]] = dict,
    submit: Submit | None = None,
    idle: Callable[[], None] = lambda: None,
    follow: Callable[[RunEnd, RunRequest], None] = lambda *_: None,
) -> RunEnd:
    """Connect a rig, run a policy on it once or in a series, and disconnect the rig at rest.

    Args:
        request: The run.
        rig: The rig, not connected yet.
        operators: Operators; each receives the messages and may type.
        recorder: Rings for the log.
        prepare: Applies the real-time settings of this process, and returns their results.
        submit: Starts a long job; None in virtual time, where none takes long.
        idle: Called in each tick, e.g. to drain the rings.
        follow: Called between two runs of a series, with the end of one and the next request.

    Returns:
        The end of the last run.

    Raises:
        InputError: The policy does not fit the rig.
        OutsideError: A device fails.
    """
    _, safety = request.parameters(request.actuator)
    robot = GuardedRobot(rig.robot, safety.limits, request.policy.h / 2.0)
    operator = OperatorChannel(operators, recorder, rig)
    tell = operator.tell
    try:
        tell(CONNECTING, f"Connecting to {request.robot}.")
        rig.sensor.connect()
        rig.robot.connect()
        granted = prepare()
        results, max_speed = preflight(request, rig, granted)
        fit = check_fit(request.policy, request.actuator, request.settings)
        for result in (*fit, *results):
            tell(f"finding {result.status}", printable(result.sentence))
        require(fit)
        require(results, OutsideError)
        if max_speed is not None:
            tell("notice", f"The run stops when the flange reaches {max_speed:.3g} m/s.")
        tell("notice", rig.plugin.failure)
        questions = [*CHECKLIST, *rig.plugin.checklist]
        if request.start == HANGING:
            clear = "Does the pendulum clear arm, cable and table over its whole turn, all along"
            questions.append(("circle", f"{clear} the track?"))
        if request.runs > 1:
            stays = "Does the operator stay, the E-stop in a hand, until the last run has ended?"
            questions.append(("stay", stays))
        for word, question in questions:
            answer = operator.ask("checklist", f"{question} Type {word}.", word)
            if answer != word:
                return _denied(answer)
        if request.dry_run:
            operator.check_links()  # the answers may have been typed ahead
            return RunEnd(outcome=Outcome.DRY_RUN, survival=0.0)
        question = "The arm will move to home at a tenth of its speed. Stand clear. Move? y or n"
        if (answer := operator.ask("move", question, "y", "n")) != "y":
            return _denied(answer)
        number, survived = 1, 0
        while True:
            if request.runs > 1:
                so_far = f"{survived} of {number - 1} survived" if number > 1 else "the first"
                tell("run", f"Run {number} of {request.runs}; {so_far}.")
            limited = replace(request, max_speed=max_speed)
            end, reference = _run_once(
                limited, rig, robot, operator, recorder, submit=submit, idle=idle
            )
            if reference is None or number == request.runs:
                return end
            number, survived = number + 1, survived + (end.outcome is Outcome.SURVIVED)
            actuator = end.identified or request.actuator
            request = replace(request, reference=reference, actuator=actuator, identify=None)
            follow(end, request)
            gc.collect()  # in real time nothing is collected while the arm moves
            results, max_speed = preflight(request, rig, granted)
            require(results, OutsideError)
            if (word := operator.read_word()) is not None:
                return _denied(word or "Enter")
    finally:
        rig.robot.close()
        rig.sensor.close()


def _run_once(
    request: RunRequest,
    rig: Rig,
    robot: GuardedRobot,
    operator: Operator,
    recorder: Recorder,
    *,
    submit: Submit | None,
    idle: Callable[[], None],
) -> tuple[RunEnd, Reference | None]:
    """Start the servo, run once, bring the arm to rest, and stop the servo.

    Returns:
        The end, and the reference for the next run; None where this end leads to none.
    """
    rig.sensor.samples()
    robot.start()
    started = rig.clock.now()
    recorder.reply.push(time=started, q=robot.started_at, taken=started)
    run = Run(request, robot.started_at, rig.clock.now, submit)
    controller = RunController(run)
    parts = robot, rig.sensor, rig.clock, controller, recorder, operator
    fault, stoppable = run_loop(*parts, idle=idle)
    if stoppable:
        try:
            rig.robot.stop()
        except LinkError as error:
            fault, stoppable = End(Outcome.LINK_LOST, {"text": str(error)}), False
    cause = fault or controller.end
    cause = cause or End(Outcome.FAULT, {"text": "the run ended without a cause"})
    zero, test = run.encoder.zero, run.tested
    end = RunEnd(
        outcome=cause.outcome,
        evidence=dict(cause.evidence),
        survival=run.balanced * run.h,
        stoppable=stoppable,
        upright=run.upright,
        zero=None if isnan(zero) else zero,
        zero_change=test and test.zero,
        w2=test and test.w2,
        delay=test and test.delay,
        max_speed=request.max_speed,
        identified=run.identified,
        missed=run.missed,
    )
    leads_on = cause.outcome in LEADS_ON and not controller.key_after_stop
    if not (leads_on and stoppable):
        return end, None
    return end, Reference(zero=zero, torque=run.joints.torque_at_home)


def _denied(answer: str) -> RunEnd:
    return RunEnd(outcome=Outcome.OPERATOR, evidence={"typed": printable(answer)}, survival=0.0)


def log_warning(problem: str) -> OperatorMessage:
    """Return the message that a log is incomplete, with the problem of its writer."""
    return OperatorMessage("warning", f"the log is incomplete: {problem}")


def run_virtually(
    request: RunRequest,
    out: Path | None,
    operator: Operator | None = None,
    *,
    rig: Rig | None = None,
    ended: Callable[[RunEnd], None] = lambda _: None,
) -> RunEnd:
    """Run on an emulated rig in this process, in virtual time.

    Args:
        request: The run; its robot is `twin:...`.
        out: Path of the log; None writes no log.
        operator: Operator besides the emulated one.
        rig: The rig, such as one with faults (default: that of the robot's address).
        ended: Called with the end of each run of a series but the last.

    Returns:
        The end of the last run.

    Raises:
        InputError: The policy does not fit the rig.
        OutsideError: The log cannot be written, or virtual time stands still.
    """
    rig = connect(request) if rig is None else rig
    recorder = Recorder(rig.robot.joints)
    logs = out and RunLogs(out, request.conditions(), request.runs, rig.clock.now())
    ticks = count(1)

    def idle() -> None:
        """Write the log every quarter of a second; the rings hold ten."""
        if logs is not None and next(ticks) % 25 == 0:
            logs.drain(recorder)

    def follow(end: RunEnd, following: RunRequest) -> None:
        """End the log of a run, and begin the next."""
        ended(end)
        if logs is not None:
            logs.follow(recorder, rig.clock.now(), end, following.conditions())

    operators = [person for person in (rig.operator, operator) if person is not None]
    end = RunEnd()
    try:
        with ended_stalls(rig.clock, rig.clock, rig.robot, rig.sensor):
            end = run_on_rig(request, rig, operators, recorder, idle=idle, follow=follow)
        return end
    except EquipoiseError as error:
        end = RunEnd(evidence={"text": str(error)})
        raise
    finally:
        if logs is not None:
            logs.finish(recorder, rig.clock.now(), end)
            if logs.problem is not None:
                for person in operators:
                    person.notify(log_warning(logs.problem))
