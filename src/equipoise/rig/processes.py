"""Run on a real rig: the control loop in a process of its own, and its parent.

The *loop* serves the devices and meets the deadlines; a helper process does its longer jobs. The
*parent* serves the operator, writes the log from a thread, and monitors the loop's heartbeat: it
warns the operator as soon as the heartbeat stops while the servo runs. A console (`console`)
may watch the rings, and answer; the run does not depend on it. A run continues without its log,
with a warning. A loop without its parent, or without a reachable operator, brings the arm to rest.

SIGINT, SIGTERM and SIGHUP become the input `stop` of the loop, which then brings the arm to rest
inside the stream.
"""

import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Final

from equipoise.control.ticks import OperatorMessage
from equipoise.errors import EquipoiseError, OutsideError
from equipoise.log.conditions import RunEnd
from equipoise.log.recorder import (
    CONNECTING,
    ENDED,
    Recorder,
    open_recorder,
    push_event,
    read_events,
    share,
)
from equipoise.rig import host
from equipoise.rig.checks import warm_up
from equipoise.rig.connection import connect
from equipoise.rig.host import SIGNALS, handled_signals
from equipoise.rig.interfaces import Operator
from equipoise.rig.loop import CANNOT_STOP, tell
from equipoise.rig.plugins import robot_plugin
from equipoise.rig.request import RunRequest
from equipoise.rig.run import ALONE, STOP, log_warning, run_on_rig
from equipoise.rig.run_controller import PHASES
from equipoise.rig.series import RunLogs
from equipoise.user_code import format_error, user_code

Live = Callable[[str, float], None]
"""Shows the phase of the run and the angle from upright [rad]; never blocks."""

HEARTBEAT_TIMEOUT: Final = 0.085
"""Time without a tick after which the loop counts as stopped [s]: more than a tick and a stall that
is bridged. With the parent's polling period of 10 ms the operator is warned within 100 ms."""
POLL_PERIOD: Final = 0.010
"""Time between two looks at the loop's process [s]."""
JOIN_TIMEOUT: Final = 5.0
"""Time for a process, and for the disk, to end by itself [s]."""


# The parent.


def run_in_processes(
    request: RunRequest,
    out: Path,
    person: Operator,
    live: Live,
    *,
    ended: Callable[[RunEnd], None] = lambda _: None,
) -> RunEnd:
    """Run a policy on a rig in real time, once or in a series, and write the logs.

    Args:
        request: The run.
        out: Path of the log.
        person: The operator.
        live: Shows the phase of the run and the angle from upright [rad]; never blocks.
        ended: Called with the end of each run of a series but the last, in the log's thread.

    Returns:
        The end of the last run.

    Raises:
        InputError: The policy cannot be sent to the loop's process.
        OutsideError: The log cannot be written, or the loop's process ended without a result.
        EquipoiseError: Error of the loop's process.
    """
    with user_code(f"sending {request.policy.name} to another process", "give it as MODULE:NAME"):
        data = pickle.dumps(request)
    conditions = request.conditions()
    signalled: list[str] = []
    with share(conditions) as memory, handled_signals(SIGNALS, lambda *_: signalled.append(STOP)):
        _, recorder = open_recorder(memory)
        logs = RunLogs(out, conditions, request.runs, time.monotonic())
        context = multiprocessing.get_context("spawn")
        (results, result_end), (series, series_end) = context.Pipe(), context.Pipe()
        over = threading.Event()
        drains = threading.Thread(
            target=_drain, args=(logs, recorder, over, series, ended), daemon=True
        )
        drains.start()
        loop = context.Process(target=_loop, args=(data, memory, result_end, series_end))
        end = RunEnd()
        try:
            blocked = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)  # until it is ready
            try:
                loop.start()
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
            result_end.close()
            series_end.close()
            end = _attend(loop, results, recorder, logs, person, live, signalled)
            return end
        except EquipoiseError as error:
            end = RunEnd(evidence={"text": str(error)})
            raise
        finally:
            recorder.typed.push(word=STOP.encode())  # for a loop that still runs
            if loop.pid is not None:
                loop.join(JOIN_TIMEOUT)
            over.set()
            drains.join(JOIN_TIMEOUT)
            complete = logs.problem is None
            if drains.is_alive():
                logs.problem = "the disk does not answer"
            else:
                logs.finish(recorder, time.monotonic(), end)
            last = OperatorMessage(ENDED, f"{end.outcome}: {end.reason}")
            push_event(recorder.event, time.monotonic(), last)
            if complete and logs.problem is not None:
                person.notify(log_warning(logs.problem))


def _drain(
    logs: RunLogs,
    recorder: Recorder,
    over: threading.Event,
    series: Any,
    ended: Callable[[RunEnd], None],
) -> None:
    """Write the logs during the runs; a failure stays in `logs.problem`.

    Args:
        logs: The logs.
        recorder: Rings of the run.
        over: Set at the end.
        series: Pipe with the end of a run and the conditions of the next one, which an answer lets
            begin.
        ended: Called with the end.
    """
    while not over.wait(0.050):
        logs.drain(recorder)
        with suppress(EOFError, OSError):  # the loop's process has ended
            if series.poll():
                end, conditions = series.recv()
                logs.follow(recorder, time.monotonic(), end, conditions)
                series.send(None)
                ended(end)


def _attend(
    loop: BaseProcess,
    results: Any,
    recorder: Recorder,
    logs: RunLogs,
    person: Operator,
    live: Live,
    signalled: list[str],
) -> RunEnd:
    """Serve the operator and monitor the loop until its process ends; return or raise its result.

    Args:
        loop: The process.
        results: Pipe with its result.
        recorder: Rings of the run.
        logs: Logs of the runs, for their failure.
        person: The operator.
        live: Shows phase and angle.
        signalled: Stops that signals to this process request.
    """
    pulse = recorder.pulse
    result: RunEnd | EquipoiseError | None = None
    silent = warned = False
    while True:
        alive = loop.is_alive()
        if result is None:
            with suppress(EOFError, OSError):  # the process has ended
                if results.poll():
                    result, pulse["ticks"] = results.recv(), 0.0  # it ticks no more
        # The heartbeat comes before the messages, since printing may take long.
        streams = pulse["ticks"] > 0
        beats = alive and time.monotonic() - float(pulse["time"]) < HEARTBEAT_TIMEOUT
        if streams and not beats and not silent:
            text = f"the loop does not answer: {CANNOT_STOP}"
            person.notify(OperatorMessage("fault", text))
        silent = streams and not beats
        for event in read_events(recorder.notices.take()):
            person.notify(event)
        if logs.problem is not None and not warned:
            warned = True
            person.notify(log_warning(logs.problem))
        for word in (*person.read_input(), *signalled):
            recorder.typed.push(word=word.encode())
        signalled.clear()
        if streams and alive:
            live(PHASES[int(pulse["state"])].value, float(pulse["phi"]))
        if not alive:
            break
        time.sleep(POLL_PERIOD)
    if result is None:
        raise OutsideError(
            f"the process that moves the arm has ended with {loop.exitcode}; press the E-stop, "
            "inspect the arm, and start the robot's application again"
        )
    if isinstance(result, EquipoiseError):
        raise result
    return result


# The loop's process.


def _loop(data: bytes, memory: Path, results: Any, series: Any) -> None:
    """Run the loop's process for a pickled request, whose policy is imported here anew."""
    _, recorder = open_recorder(memory)
    operator = OperatorProxy(recorder)
    for number in SIGNALS:
        signal.signal(number, lambda *_: operator.pending.append(STOP))
    context = multiprocessing.get_context("spawn")
    result: RunEnd | EquipoiseError

    def say(text: str) -> None:
        tell(recorder, operator, time.monotonic(), OperatorMessage(CONNECTING, text))

    def attend() -> None:
        """Check for a stop and the encoder, which is connected before the robot."""
        if {STOP, ALONE} & set(operator.read_input()):
            restart = robot_plugin(request.robot).restart or "repeat the command"
            raise OutsideError(
                "stopped during the wait for the robot; nothing has moved. To deploy again, "
                f"{restart}"
            )
        rig.sensor.samples()

    def follow(end: RunEnd, following: RunRequest) -> None:
        """Let the parent end the log and begin the next; a word ends the wait for its disk."""
        series.send((end, following.conditions()))
        while not series.poll(POLL_PERIOD):
            if words := operator.read_input():
                operator.pending += words
                return
        series.recv()

    with ProcessPoolExecutor(1, mp_context=context, initializer=end_with_parent) as helper:
        try:
            request: RunRequest = pickle.loads(data)
            helper.submit(os.getpid).result()  # it inherits blocked signals
            signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
            say("Loading the control loop; the first time it compiles for up to a minute.")
            warm_up(request)  # before the connection, which needs attention once it is open
            rig = connect(request, tell=say, attend=attend)
            result = run_on_rig(
                request,
                rig,
                [operator],
                recorder,
                prepare=host.prepare,
                submit=helper.submit,
                follow=follow,
            )
        except EquipoiseError as error:
            result = type(error)(str(error))
        except BaseException as error:  # one sentence for the parent, without a traceback
            result = OutsideError(f"the run failed ({format_error(error)}); please report it")
        with suppress(OSError):  # the parent may have ended
            results.send(result)


def end_with_parent() -> None:
    """End this process as soon as its parent has ended in any way."""
    parent = multiprocessing.parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
        os._exit(0)

    threading.Thread(target=wait, daemon=True).start()


class OperatorProxy:
    """Operator interface of the loop's process: rings to the parent and from a console.

    The first answer to a question counts. A console names the question that it answers, so that a
    later answer is not taken for another question, or for a key that stops the run.
    """

    def __init__(self, recorder: Recorder) -> None:
        """Connect to the rings of a run."""
        self._recorder = recorder
        self._parent = os.getppid()
        self.pending: list[str] = []
        """Words to be read next: stops that signals request, and what ended the wait for a log."""

    def notify(self, event: OperatorMessage) -> None:
        """Send a message to the operators; never blocks."""
        now = time.monotonic()
        push_event(self._recorder.notices, now, event)
        if event.answers:
            self._recorder.ask(event._replace(time=now))
        elif event.name not in ("warning", "nudge"):  # these come beside an open question
            self._recorder.ask(None)

    def read_input(self) -> list[str]:
        """Return the words of the operators, the oldest first."""
        words = [word.decode("utf-8", "ignore") for word in self._recorder.typed.take()["word"]]
        if any(words):  # Enter alone may be no answer
            self._recorder.ask(None)
        for question, data in self._recorder.console.take().tolist():
            word, asked = data.decode("utf-8", "ignore"), self._recorder.question()
            if word == STOP or (asked is not None and question == asked.time):
                self._recorder.ask(None)
                words.append(word)
                self.notify(OperatorMessage("console", f"Console: {word}"))
        words += self.pending
        self.pending.clear()
        if os.getppid() != self._parent:
            self._parent = os.getppid()
            words.append(ALONE)
        return words
