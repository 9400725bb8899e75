"""Run on a real rig, in three processes.

The *loop* serves the devices and meets the deadlines. The *writer* drains its rings to the disk; a
run continues without it, with a warning to the operator. A console (`apps.console`) may watch
the rings, and answer; the run does not depend on it. The *parent* serves the operator and
monitors the loop's heartbeat: it warns the operator as soon as the heartbeat stops while the servo
runs. A loop without its parent, or without a reachable operator, brings the arm to rest.

SIGINT, SIGTERM and SIGHUP become the input `stop` of the loop, which then brings the arm to rest
inside the stream.
"""

import multiprocessing
import os
import pickle
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from equipoise.control.ticks import OperatorMessage
from equipoise.errors import EquipoiseError, OutsideError
from equipoise.logs.conditions import RunConditions, RunEnd
from equipoise.logs.recorder import PULSE, read_events
from equipoise.logs.shared import RunInfo, open_recorder, share
from equipoise.logs.writer import RunWriter
from equipoise.rig import realtime
from equipoise.rig.connection import restart_instruction
from equipoise.rig.interfaces import Operator
from equipoise.rig.loop import CANNOT_STOP
from equipoise.rig.operator_proxy import OperatorProxy
from equipoise.rig.preflight import warm_up
from equipoise.rig.request import RunRequest
from equipoise.rig.run import ALONE, STOP, run_on_rig
from equipoise.rig.run_controller import PHASES
from equipoise.rig.signals import SIGNALS, handled_signals, ignore_signals, start_process
from equipoise.rig.worker import JOIN_TIMEOUT, POLL_PERIOD, InterruptedPolicy, WorkerProcess
from equipoise.user_code import format_error, guest_code

HEARTBEAT_TIMEOUT: Final = 0.085
"""Time without a tick after which the loop counts as stopped [s]: more than a tick and a stall that
is bridged. With the parent's polling period of 10 ms the operator is warned within 100 ms."""
DRAIN_PERIOD: Final = 0.050
"""Time between two drains of the rings [s]."""

_TIME, _STATE, _PHI, _TICKS = (PULSE.index(name) for name in ("time", "state", "phi", "ticks"))

Live = Callable[[str, float], None]
"""Shows the phase of the run and the angle from upright [rad]; never blocks."""


def run_in_processes(request: RunRequest, out: Path, person: Operator, live: Live) -> RunEnd:
    """Run a policy on a rig in real time, and write the log.

    Args:
        request: The run.
        out: Path of the log.
        person: The operator.
        live: Shows the phase of the run and the angle from upright [rad]; never blocks.

    Raises:
        InputError: The policy cannot be sent to the loop's process.
        EquipoiseError: Error of the loop's process, or its end without a result.
    """
    with guest_code(f"sending {request.policy.name} to another process", "give it as MODULE:NAME"):
        data = pickle.dumps(request)
    arm = request.settings.described_arm
    title = f"{request.policy.name} on {request.robot}"[:1024]
    info = RunInfo(title=title, pid=os.getpid(), arm=arm, phases=PHASES, duration=request.duration)
    end: RunEnd | EquipoiseError = RunEnd()
    with share(info) as memory:
        parent = _Parent(memory, len(arm.joints), person, live)
        with handled_signals(SIGNALS, lambda *_: parent.words.append(STOP)):
            try:
                parent.start_writer(out, request.conditions())
                parent.start_loop(data)
                end = parent.attend()
            finally:
                parent.finish(
                    end if isinstance(end, RunEnd) else RunEnd(evidence={"text": str(end)})
                )
    if isinstance(end, EquipoiseError):
        raise end
    return end


class _Parent:
    """Parent process of a run: it serves the operator, and monitors loop and writer."""

    def __init__(self, memory: Path, joints: int, person: Operator, live: Live) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._shared, self._recorder = (memory, joints), open_recorder(memory, joints)
        self._person, self._live = person, live
        self._loop: Any = None
        self._writer: Any = None
        self._log_pipe, self._loop_pipe = self._context.Pipe(), self._context.Pipe()
        self._warned = False
        self.words: list[str] = []
        """Stops that signals to this process request."""

    def start_writer(self, out: Path, conditions: RunConditions) -> None:
        """Start the writer, and wait until the log exists.

        Raises:
            OutsideError: The log cannot be written.
        """
        ours, theirs = self._log_pipe
        arguments = (*self._shared, out, conditions, theirs)
        self._writer = self._context.Process(target=_write, args=arguments, daemon=True)
        start_process(self._writer)
        theirs.close()
        try:
            problem = ours.recv()
        except (EOFError, OSError):
            problem = "the process that writes the log has ended at its start; try again"
        if problem is not None:
            raise OutsideError(problem)

    def start_loop(self, data: bytes) -> None:
        """Start the loop with a pickled request."""
        theirs = self._loop_pipe[1]
        arguments = (data, *self._shared, theirs)
        self._loop = self._context.Process(target=_loop, args=arguments, daemon=False)
        start_process(self._loop)
        theirs.close()

    def attend(self) -> RunEnd | EquipoiseError:
        """Serve the operator and monitor the loop until its process ends; return its result."""
        recorder, person, pulse = self._recorder, self._person, self._recorder.pulse
        result: RunEnd | EquipoiseError | None = None
        silent = False
        while True:
            alive = self._loop.is_alive()
            if result is None:
                result = _received(self._loop_pipe[0])
            # The heartbeat comes before the messages, since printing may take long.
            streams = pulse[_TICKS] > 0 and result is None
            beats = alive and time.monotonic() - float(pulse[_TIME]) < HEARTBEAT_TIMEOUT
            if streams and not beats and not silent:
                text = f"the loop does not answer: {CANNOT_STOP}"
                person.notify(OperatorMessage("fault", text))
            silent = streams and not beats
            for event in read_events(recorder.notices.take()):
                person.notify(OperatorMessage(event.name, event.text, event.answers))
            self._check_log()
            for word in (*person.read_input(), *self.words):
                recorder.typed.push(word.encode()[:64])
            self.words.clear()
            if streams and alive:
                self._live(PHASES[int(pulse[_STATE])].value, float(pulse[_PHI]))
            if not alive:
                break
            time.sleep(POLL_PERIOD)
        return result or OutsideError(
            f"the process that moves the arm has ended with {self._loop.exitcode}; press the "
            "E-stop, inspect the arm, and start the robot's application again"
        )

    def finish(self, end: RunEnd) -> None:
        """Wait for the end of the loop, which a stop brings where it still runs, and of the log."""
        if self._loop is not None:
            self._recorder.typed.push(STOP.encode())
            self._loop.join(JOIN_TIMEOUT)
        if self._writer is not None:
            _send(self._log_pipe[0], end)
            self._writer.join(JOIN_TIMEOUT)
            self._check_log()

    def _check_log(self) -> None:
        """Warn the operator once if the log is incomplete."""
        problem = _received(self._log_pipe[0])
        if problem is None and not self._writer.is_alive() and self._writer.exitcode != 0:
            problem = f"the process that writes it has ended with {self._writer.exitcode}"
        if problem is not None and not self._warned:
            self._warned = True
            text = f"the log is incomplete: {problem}"
            self._person.notify(OperatorMessage("warning", text))


def _received(pipe: Any) -> Any:
    """Return the next object from a process; None without one, or from a closed pipe."""
    try:
        return pipe.recv() if pipe.poll() else None
    except (EOFError, OSError):
        return None


def _send(pipe: Any, value: object) -> None:
    """Send an object to a process that may have ended."""
    with suppress(OSError):
        pipe.send(value)


def _loop(data: bytes, memory: Path, joints: int, pipe: Any) -> None:
    """Run the loop's process for a pickled request, whose policy is imported here anew."""
    recorder = open_recorder(memory, joints)
    operator = OperatorProxy(recorder)
    for number in SIGNALS:
        signal.signal(number, lambda *_: operator.signals.append(STOP))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    worker: WorkerProcess | None = None
    result: RunEnd | EquipoiseError

    def attend() -> None:
        """Check for a stop and the encoder, which is connected before the robot."""
        if {STOP, ALONE} & set(operator.read_input()):
            restart = restart_instruction(request.robot) or "repeat the command"
            raise OutsideError(
                "stopped during the wait for the robot; nothing has moved. To deploy again, "
                f"{restart}"
            )
        rig.sensor.samples()

    try:
        request: RunRequest = pickle.loads(data)
        worker = WorkerProcess()
        warm_up(request)  # before the connection, which needs attention once it is open
        rig = request.connect(
            tell=lambda text: operator.notify(OperatorMessage("waiting", text)), attend=attend
        )
        result = run_on_rig(
            request,
            rig,
            [operator],
            recorder,
            measures=realtime.prepare,
            executor=worker,
            supervise=InterruptedPolicy,
        )
    except EquipoiseError as error:
        result = type(error)(str(error))
    except BaseException as error:  # one sentence for the parent, without a traceback
        result = OutsideError(f"the run failed ({format_error(error)}); please report it")
    _send(pipe, result)
    if worker is not None:
        worker.close()


def _write(memory: Path, joints: int, out: Path, conditions: RunConditions, pipe: Any) -> None:
    """Run the writer's process until the parent sends the end of the run.

    Without its parent it goes on until the loop has brought the arm to rest.
    """
    ignore_signals()
    parent, until = os.getppid(), float("inf")
    recorder = open_recorder(memory, joints)
    try:
        writer = RunWriter(out, conditions, time.monotonic())
    except OutsideError as error:
        pipe.send(str(error))
        return
    pipe.send(None)
    end: RunEnd | None = None
    while end is None and time.monotonic() < until and writer.problem is None:
        time.sleep(DRAIN_PERIOD)
        end = _received(pipe)
        writer.drain(recorder)
        if os.getppid() != parent:
            rests = recorder.pulse[_TICKS] == 0.0
            until = min(until, time.monotonic() + (0.0 if rests else JOIN_TIMEOUT))
    end = (end or RunEnd()).model_copy(update={"lost_rows": recorder.lost})
    writer.finish(time.monotonic(), end)
    if writer.problem is not None:
        _send(pipe, writer.problem)
