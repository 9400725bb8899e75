"""Control loop of a run: read, decide, send; wait; send the setpoint of half a tick; wait.

The loop runs in one thread. Deadlines are absolute times of the rig's clock, so that they do not
drift. A loop that stalls sends no setpoint that is later than the next one should be: the arm
comes to rest at the last one sent, the missed ticks are skipped, and the controller
begins anew from there at the time of a later tick. A tick waits for no lock, prints nothing, and
writes its records to preallocated rings (`equipoise.log.recorder`).

A failure ends in one of two ways. While the robot accepts setpoints, the controller brings the arm
to rest inside the stream; if it fails itself, the guard around the robot does. If the link to the
robot is lost, software cannot stop the arm: the loop reports this at once and returns.
"""

from collections.abc import Callable
from contextlib import suppress
from time import perf_counter
from typing import Final

from equipoise.control.ticks import OperatorMessage, TickInputs, missed_ticks
from equipoise.errors import LinkError
from equipoise.log.recorder import Recorder, push_event
from equipoise.outcomes import End, Outcome, describe
from equipoise.rig.guarded import GuardedRobot
from equipoise.rig.interfaces import AngleSensor, Clock, Operator, Sample
from equipoise.rig.run_controller import RunController
from equipoise.user_code import format_error

CANNOT_STOP: Final = "software no longer commands the robot: press the E-stop"
"""Message to the operator when the link to the robot is lost."""


def run_loop(
    robot: GuardedRobot,
    sensor: AngleSensor,
    clock: Clock,
    controller: RunController,
    recorder: Recorder,
    operator: Operator,
    *,
    idle: Callable[[], None] = lambda: None,
) -> tuple[End | None, bool]:
    """Run until the controller is done or the link to the robot is lost. The servo has to run.

    Args:
        robot: The arm, behind its guard.
        sensor: The encoder, connected.
        clock: Clock of both.
        controller: Decides on the setpoints.
        recorder: Rings for the log.
        operator: Receives messages and returns input, without blocking.
        idle: Called once in a tick after its last setpoint, for example to drain the rings in
            virtual time.

    Returns:
        The fault that ended the loop, None after a regular end; and whether software still commands
        the arm, which otherwise the operator must stop.
    """
    h, unsent = controller.h, False
    faults: list[End] = []
    sensor_lost = refused = still = False
    deadline = clock.now() + h
    fault: End | None = None
    stoppable = True
    try:
        while True:
            clock.wait_until(deadline)
            due = deadline
            while (skipped := missed_ticks(clock.now() - deadline, h)) > 0:
                deadline += skipped * h
                clock.wait_until(deadline)
            now, begin = clock.now(), perf_counter()
            samples: list[Sample] = []
            if not sensor_lost:
                try:
                    samples = sensor.samples()
                except LinkError as error:
                    sensor_lost = True
                    faults.append(End(Outcome.ENCODER_LOST, {"text": str(error)}))
            replies, lines = robot.robot.replies(), operator.read_input()
            inputs = TickInputs(samples, replies, lines, faults, now - due, unsent)
            output, faults = controller.tick(now, inputs), []
            if output.setpoints:
                from_rest = still or inputs.paused(h)
                robot.send(output.setpoints[0], to_rest=output.to_rest, from_rest=from_rest)
            sent, took = clock.now(), perf_counter() - begin
            recorder.record_tick(now, took, inputs, output)
            if output.setpoints:  # as sent: the guard may have replaced it
                recorder.stream.push(time=sent, q=robot.last)
            for event in output.events:
                operator.notify(event)
            still, unsent = not output.setpoints, False
            if output.setpoints:
                clock.wait_until(deadline + 0.5 * h)
                moment = clock.now()
                unsent = moment > deadline + h
                if not unsent:
                    robot.send(output.setpoints[1], to_rest=output.to_rest)
                    recorder.stream.push(time=moment, q=robot.last)
            if robot.held_back is not None and not refused:
                refused = True
                faults.append(robot.held_back)
            if output.done:
                break
            idle()
            deadline += h
    except LinkError as error:
        # The arm rests if the guard refused the first setpoint, since no other was sent.
        stoppable = robot.held_back is not None and robot.last is None
        lost = End(Outcome.LINK_LOST, {"text": str(error)})
        fault = robot.held_back if stoppable else lost
    except KeyboardInterrupt:  # Ctrl-C in virtual time, or from a driver
        _rest(robot, clock, recorder, h / 2.0)
        raise
    except BaseException as error:  # after any failure the arm has to come to rest
        text = f"a part of the run failed ({format_error(error)})"
        fault = End(Outcome.FAULT, {"text": text})

    def warn(text: str) -> None:
        """Report a fault; an exception is suppressed, since the arm still has to come to rest."""
        with suppress(Exception):
            tell(recorder, operator, clock.now(), OperatorMessage("fault", text))

    if fault is not None:
        warn(describe(fault) if stoppable else f"{describe(fault)}; {CANNOT_STOP}")
    if stoppable and (fault is not None or not robot.at_rest):
        stoppable = _rest(robot, clock, recorder, h / 2.0)
        if not stoppable:
            warn(CANNOT_STOP)
    recorder.pulse["ticks"] = 0.0  # no further tick
    idle()
    return fault, stoppable


def _rest(robot: GuardedRobot, clock: Clock, recorder: Recorder, period: float) -> bool:
    """Bring the arm to rest without the controller; return whether that was possible."""
    moment = clock.now()
    try:
        robot.stop()
        while not robot.at_rest:
            moment += period
            clock.wait_until(moment)
            with suppress(Exception):  # unused; a lost link is noticed by `send`
                robot.robot.replies()
            now = clock.now()
            robot.send(())  # the guard sends its ramp
            recorder.stream.push(time=now, q=robot.last)
            recorder.pulse["time"] = now  # the loop still commands the arm
    except BaseException:  # the link is lost, or a part that has failed fails again
        return False
    return True


def tell(recorder: Recorder, operator: Operator, now: float, event: OperatorMessage) -> None:
    """Log a message at a time [s], and send it to the operator."""
    push_event(recorder.event, now, event)
    operator.notify(event)
