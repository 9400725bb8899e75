"""The loop that moves the arm: read, decide, send; wait; send the setpoint of half a tick; wait.

One thread does it all. Deadlines are absolute times of the rig's clock, so that nothing drifts. A
tick that begins more than a tick too late is not made up for: the ones that were missed are left
out, and counted. Within a tick there is no lock, no print and nothing that grows; what is to be
kept goes into rings that were laid out before (`equipoise.logs.recorder`).

What cannot be handled ends in one of two ways. While the robot takes setpoints, the arm is brought
to rest inside the stream, by the heart or, where the heart itself fails, by the guard around the
robot. Where the link to the robot is gone, software cannot do anything: the loop says so at once
and returns.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from time import perf_counter
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from equipoise.control.ticks import Job, OperatorMessage, TickHandler, TickInputs, TickOutput
from equipoise.devices.guarded import GuardedRobot
from equipoise.devices.interfaces import AngleSensor, Clock, Reply, Sample
from equipoise.devices.operator import Operator
from equipoise.errors import LinkError
from equipoise.logs.recorder import FAILED, PULSE, WORD_TYPED, Recorder, push_event

Array = npt.NDArray[np.float64]


class Executor(Protocol):
    """Where jobs are done that take longer than a tick, one at a time."""

    def begin(self, job: Job) -> None:
        """Begin a job; never blocks for long."""
        ...

    def result(self) -> Any:
        """Return what came of it, once; none while there is nothing. An exception is returned."""
        ...


class InlineExecutor:
    """Where time is virtual a job takes none."""

    def __init__(self) -> None:
        """Begin idle."""
        self._result: Any = None

    def begin(self, job: Job) -> None:
        """Do the job."""
        try:
            self._result = job()
        except Exception as error:  # it is the heart's, to stop on
            self._result = error

    def result(self) -> Any:
        """Return what came of it, once."""
        result, self._result = self._result, None
        return result


class Timing(NamedTuple):
    """How punctual a loop was."""

    late: Array
    """How late each tick began [s], shape (n,)."""
    compute: Array
    """How long each took from reading to sending [s], shape (n,)."""
    missed: int
    """Ticks that were left out."""

    def percentiles(self, of: Array) -> dict[str, float]:
        """Return p50, p99, p99.9 and the largest of an array [s]; nothing of an empty one."""
        if not len(of):
            return {}
        p50, p99, p999 = np.percentile(of, (50.0, 99.0, 99.9)).tolist()
        return {"p50": p50, "p99": p99, "p99.9": p999, "max": float(of.max())}


class LoopResult(NamedTuple):
    """How a loop ended."""

    fault: str | None
    """What broke it; none where the heart was done."""
    stoppable: bool
    """Whether software still commands the arm; where not, the operator has to stop it."""
    timing: Timing
    """How punctual it was."""


def run_loop(
    robot: GuardedRobot,
    sensor: AngleSensor,
    clock: Clock,
    heart: TickHandler,
    recorder: Recorder,
    operator: Operator,
    *,
    longest: float,
    workshop: Executor | None = None,
    idle: Callable[[], None] = lambda: None,
) -> LoopResult:
    """Run until the heart is done, or nothing can be done any more. The servo runs already.

    Args:
        robot: The arm, behind its guard.
        sensor: The encoder, connected.
        clock: Their time.
        heart: What decides.
        recorder: Rings for the log.
        operator: Is told, and answers; neither may block.
        longest: Room for the record of punctuality [s]; ticks beyond are not recorded there.
        workshop: Where longer jobs are done; at once, between two ticks, if not given.
        idle: Called once in a tick after the last setpoint was sent, such as to drain the rings
            where time is virtual.
    """
    h = heart.h
    room = round(longest / h)
    late, compute = np.zeros(room), np.zeros(room)
    workshop = InlineExecutor() if workshop is None else workshop
    ticks = missed = 0
    faults: list[str] = []
    sensor_lost = refused = False
    deadline = clock.now() + h
    fault: str | None = None
    stoppable = True
    try:
        while True:
            clock.wait_until(deadline)
            now, begin = clock.now(), perf_counter()
            lateness = now - deadline
            left_out = int(lateness / h)  # whole ticks that have passed already
            if left_out > 0:
                deadline += left_out * h
                missed += left_out
            samples: list[Sample] = []
            if not sensor_lost:
                try:
                    samples = sensor.samples()
                except LinkError as error:
                    sensor_lost = True
                    faults.append(str(error))
            replies = robot.replies()
            words = operator.read_input()
            output = heart.tick(
                now, TickInputs(samples, replies, words, faults, lateness, workshop.result())
            )
            failed, faults = faults, []
            first, *rest = output.setpoints
            robot.send(first, to_rest=output.to_rest)
            sent, took = clock.now(), perf_counter() - begin
            if ticks < room:
                late[ticks], compute[ticks] = lateness, took
            ticks += 1
            _record(recorder, now, lateness, sent, took, samples, replies, output, robot.last)
            for name, said in ((WORD_TYPED, words), (FAILED, failed)):
                for text in said:
                    push_event(recorder.event, now, name, (), text)
            for event in output.events:
                _notify(recorder, operator, now, event)
            for place, setpoint in enumerate(rest, start=1):
                clock.wait_until(deadline + place * h / len(output.setpoints))
                moment = clock.now()
                robot.send(setpoint, to_rest=output.to_rest)
                recorder.stream.push(moment, robot.last)
            if output.job is not None:
                workshop.begin(output.job)
            if robot.held_back is not None and not refused:
                refused = True
                faults.append(robot.held_back)
            if output.done:
                break
            idle()
            deadline += h
    except LinkError as error:
        # Where the guard has refused the first setpoint, none was sent and the arm stands.
        fault, stoppable = str(error), robot.held_back is not None and robot.last is None
    except Exception as error:  # whatever it is, the arm is to come to rest
        fault = f"the controller failed ({type(error).__name__}: {error})"
    if fault is not None:
        _notify_best_effort(
            recorder, operator, clock, fault if stoppable else f"{fault}; {CANNOT_STOP}"
        )
    if stoppable and (fault is not None or not robot.at_rest):
        stoppable = _rest(robot, clock, recorder, h / 2.0)
        if not stoppable:
            _notify_best_effort(recorder, operator, clock, CANNOT_STOP)
    recorder.pulse[_TICKS] = 0.0  # nobody need wait for another
    idle()
    timing = Timing(late[: min(ticks, room)], compute[: min(ticks, room)], missed)
    return LoopResult(fault, stoppable, timing)


CANNOT_STOP: Final = (
    "software cannot stop the robot any more, it holds its last target: press the E-stop"
)
"""What the operator is told when the link to the robot is gone."""


def _rest(robot: GuardedRobot, clock: Clock, recorder: Recorder, period: float) -> bool:
    """Bring the arm to rest without the heart; return whether that was possible."""
    moment = clock.now()
    try:
        for setpoint in robot.rest():
            moment += period
            clock.wait_until(moment)
            robot.replies()
            now = clock.now()
            robot.send(setpoint)
            recorder.stream.push(now, robot.last)
            recorder.pulse[_TIME] = now  # the loop still commands the arm
    except Exception:  # of a link that is gone, or of what has failed already
        return False
    return True


def _notify_best_effort(recorder: Recorder, operator: Operator, clock: Clock, text: str) -> None:
    """Tell of a fault; where that fails too, the arm is still to come to rest."""
    with suppress(Exception):
        _notify(recorder, operator, clock.now(), OperatorMessage("fault", text))


def _notify(recorder: Recorder, operator: Operator, now: float, event: OperatorMessage) -> None:
    push_event(recorder.event, now, event.name, event.answers, event.text)
    operator.notify(event)


_TIME, _STATE, _PHI, _TICKS = (PULSE.index(name) for name in ("time", "state", "phi", "ticks"))


def _record(
    recorder: Recorder,
    now: float,
    lateness: float,
    sent: float,
    took: float,
    samples: Sequence[Sample],
    replies: Sequence[Reply],
    output: TickOutput,
    went: Sequence[float] | None,
) -> None:
    seen, unknown = output.record, recorder.unknown
    for sample in samples:
        recorder.encoder.push(*sample, now)
    for reply in replies:
        recorder.reply.push(
            reply.received,
            reply.sent,
            unknown if reply.q is None else reply.q,
            unknown if reply.torque is None else reply.torque,
            now,
        )
    recorder.tick.push(
        now,
        lateness,
        took,
        output.state,
        seen.x,
        seen.x_dot,
        seen.phi,
        seen.phi_dot,
        seen.box,
        seen.u,
        seen.estimated_phi,
        seen.estimated_phi_dot,
        seen.bias,
        output.q,
        output.dq,
    )
    recorder.stream.push(sent, went)  # not what the heart wanted: the guard may hold it back
    pulse = recorder.pulse
    pulse[_TIME], pulse[_STATE], pulse[_PHI] = now, output.state, seen.estimated_phi
    pulse[_TICKS] += 1.0
