"""Run of a policy on a rig: connect, pre-flight, questions to the operator, run, rest.

The same sequence serves a real rig in real time (`equipoise.rig.processes`) and an emulated
one in virtual time; arguments carry the differences.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from itertools import count
from math import inf, isnan
from pathlib import Path
from typing import Any, Final

from equipoise.control.ticks import Job, OperatorMessage
from equipoise.errors import EquipoiseError, LinkError, OutsideError
from equipoise.log.conditions import RunEnd
from equipoise.log.recorder import CONNECTING, WORD_TYPED, Recorder, push_event
from equipoise.log.writer import RunWriter
from equipoise.outcomes import End, Outcome
from equipoise.printable import printable
from equipoise.rig.checks import check_fit, preflight, require
from equipoise.rig.clocks import DrainingClock, ended_stalls
from equipoise.rig.connection import Rig, connect
from equipoise.rig.guarded import GuardedRobot
from equipoise.rig.interfaces import Clock, Operator
from equipoise.rig.loop import run_inline, run_loop
from equipoise.rig.request import RunRequest
from equipoise.rig.run_controller import RunController
from equipoise.rig.script import Run

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
DENIALS: Final = ("n", "no", STOP, ALONE)
"""Words that deny a question at once."""


class OperatorChannel:
    """Channel to the operators of a run: messages to all of them, and their typed lines."""

    def __init__(
        self,
        operators: Sequence[Operator],
        recorder: Recorder,
        clock: Clock,
        check_links: Callable[[], None],
    ) -> None:
        """Connect operators to a run.

        Args:
            operators: The operators; each may type.
            recorder: Rings for the log.
            clock: Time of the run before it moves.
            check_links: Raises `LinkError` if a device has failed; called while a question is open.
        """
        self._operators, self._recorder, self._clock = operators, recorder, clock
        self._check_links = check_links
        self._pending: list[str] = []

    def notify(self, event: OperatorMessage) -> None:
        """Send a message to all operators."""
        for operator in self._operators:
            operator.notify(event)

    def read_input(self) -> list[str]:
        """Return the pending typed lines, the oldest first."""
        lines, self._pending = self._pending, []
        return lines + [line for operator in self._operators for line in operator.read_input()]

    def tell(self, event: OperatorMessage) -> None:
        """Log a message, and send it to all operators."""
        push_event(self._recorder.event, self._clock.now(), event)
        self.notify(event)

    def ask(self, event: OperatorMessage) -> str:
        """Send a question, and return the first expected answer or denial.

        Raises:
            LinkError: A device has failed.
        """
        self.tell(event)
        while (word := self._read_word()) not in (*event.answers, *DENIALS):
            expected = " or ".join(event.answers)
            self.tell(event._replace(text=f"{word!r} is not {expected}. {event.text}"))
        return word

    def _read_word(self) -> str:
        while not (lines := self.read_input()):
            until = self._clock.now() + 0.02
            self._check_links()
            self._clock.wait_until(until)
        word, *self._pending = lines
        push_event(self._recorder.event, self._clock.now(), OperatorMessage(WORD_TYPED, word))
        return word.strip().lower()


def run_on_rig(
    request: RunRequest,
    rig: Rig,
    operators: Sequence[Operator],
    recorder: Recorder,
    *,
    measures: Callable[[], dict[str, str]] = dict,
    submit: Callable[[Job], "Future[Any]"] = run_inline,
    idle: Callable[[], None] = lambda: None,
) -> RunEnd:
    """Connect a rig, run a policy on it, bring the arm to rest, and disconnect the rig.

    Args:
        request: The run.
        rig: The rig, not connected yet.
        operators: Operators; each receives the messages and may type.
        recorder: Rings for the log.
        measures: Applies the real-time settings of this process, and returns their results.
        submit: Starts a long job (default: inline).
        idle: Called in each tick, e.g. to drain the rings.

    Raises:
        InputError: The policy does not fit the rig.
        OutsideError: A device fails.
    """
    _, safety = request.parameters(request.actuator, request.settings.counts_per_rev)
    robot = GuardedRobot(rig.robot, safety.limits, request.policy.h / 2.0)

    def check_links() -> None:
        """Request the joints, and drop the encoder's samples; each raises where its link failed."""
        rig.robot.measured()
        rig.sensor.samples()

    waiting = DrainingClock(rig.clock, rig.sensor)
    operator = OperatorChannel(operators, recorder, waiting, check_links)
    tell = operator.tell
    try:
        tell(OperatorMessage(CONNECTING, f"Connecting to {request.robot}."))
        rig.sensor.connect()
        rig.robot.connect()
        results, max_speed = preflight(request, rig, measures())
        fit = check_fit(request.policy, request.actuator, request.settings)
        for result in (*fit, *results):
            text = f"{result.name}: {result.status}, {result.evidence}"
            text += f"; {result.remedy}" if result.remedy else ""
            tell(OperatorMessage(f"finding {result.status}", printable(text)))
        require(fit)
        require(results, OutsideError)
        if max_speed < inf:
            text = f"The run stops when the flange reaches {max_speed:.3g} m/s."
            tell(OperatorMessage("notice", text))
        tell(OperatorMessage("notice", rig.plugin.failure))
        for word, question in CHECKLIST + rig.plugin.checklist:
            answer = operator.ask(OperatorMessage("checklist", f"{question} Type {word}.", (word,)))
            if answer != word:
                return _unmoved(Outcome.OPERATOR, typed=printable(answer))
        if request.dry_run:
            check_links()  # the answers may have been typed ahead
            return _unmoved(Outcome.DRY_RUN)
        question = "The arm will move to home at a tenth of its speed. Stand clear. Move? y or n"
        if (answer := operator.ask(OperatorMessage("move", question, ("y", "n")))) != "y":
            return _unmoved(Outcome.OPERATOR, typed=printable(answer))
        rig.sensor.samples()
        robot.start()
        started = rig.clock.now()
        recorder.reply.push(time=started, q=robot.started_at, taken=started)
        counts = rig.sensor.counts_per_rev
        run = Run(request, robot.started_at, counts_per_rev=counts, max_speed=max_speed)
        controller = RunController(run, rig.clock.now)
        ending = run_loop(
            robot,
            rig.sensor,
            rig.clock,
            controller,
            recorder,
            operator,
            submit=submit,
            idle=idle,
        )
        if ending.stoppable:
            try:
                rig.robot.stop()
            except LinkError as error:
                fault = End(Outcome.LINK_LOST, {"text": str(error)})
                ending = ending._replace(fault=fault, stoppable=False)
        zero = run.encoder.zero
        end = ending.fault or controller.end
        end = end or End(Outcome.FAULT, {"text": "the run ended without a cause"})
        return RunEnd(
            outcome=end.outcome,
            evidence=dict(end.evidence),
            survival=controller.survival,
            stoppable=ending.stoppable,
            zero=None if isnan(zero) else zero,
            max_speed=max_speed if max_speed < inf else None,
            identified=run.identified,
            missed=ending.missed,
        )
    finally:
        rig.robot.close()
        rig.sensor.close()


def _unmoved(outcome: Outcome, **evidence: float | str) -> RunEnd:
    return RunEnd(outcome=outcome, evidence=evidence, survival=0.0)


def log_warning(problem: str) -> OperatorMessage:
    """Return the message that a log is incomplete, with the problem of its writer."""
    return OperatorMessage("warning", f"the log is incomplete: {problem}")


def run_virtually(
    request: RunRequest,
    out: Path | None,
    operator: Operator | None = None,
    *,
    rig: Rig | None = None,
) -> RunEnd:
    """Run on an emulated rig in this process, in virtual time.

    Args:
        request: The run; its robot is `twin:...`.
        out: Path of the log; None writes no log.
        operator: Operator besides the emulated one.
        rig: The rig, such as one with faults (default: that of the robot's address).

    Raises:
        InputError: The policy does not fit the rig.
        OutsideError: The log cannot be written, or virtual time stands still.
    """
    rig = connect(request) if rig is None else rig
    recorder = Recorder(rig.robot.joints)
    writer = out and RunWriter(out, request.conditions(), rig.clock.now())
    ticks = count(1)

    def idle() -> None:
        """Write the log every quarter of a second; the rings hold ten."""
        if writer is not None and next(ticks) % 25 == 0:
            writer.drain(recorder)

    operators = [person for person in (rig.operator, operator) if person is not None]
    end = RunEnd()
    try:
        with ended_stalls(rig.clock, rig.clock, rig.robot, rig.sensor):
            end = run_on_rig(request, rig, operators, recorder, idle=idle)
        return end
    except EquipoiseError as error:
        end = RunEnd(evidence={"text": str(error)})
        raise
    finally:
        if writer is not None:
            writer.drain(recorder)
            writer.finish(rig.clock.now(), end)
            if writer.problem is not None:
                for person in operators:
                    person.notify(log_warning(writer.problem))
