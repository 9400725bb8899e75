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
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.context import SpawnContext
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from equipoise.control.policy import Policy
from equipoise.control.self_test import SelfTest, self_test
from equipoise.control.ticks import Job, OperatorMessage
from equipoise.errors import EquipoiseError, OutsideError
from equipoise.logs.conditions import RunConditions, RunEnd
from equipoise.logs.recorder import PULSE, Question, Recorder, push_event, read_events
from equipoise.logs.shared import RunInfo, open_recorder, share
from equipoise.logs.writer import RunWriter
from equipoise.model.pendulum import PendulumParameters
from equipoise.rig import realtime
from equipoise.rig.config import restart_instruction
from equipoise.rig.loop import CANNOT_STOP
from equipoise.rig.operator import Operator
from equipoise.rig.run import ALONE, STOP, RunRequest, run_on_rig, warm_up
from equipoise.rig.run_controller import PHASES
from equipoise.user_code import format_error, guest_code

HEARTBEAT_TIMEOUT: Final = 0.085
"""Time without a tick after which the loop counts as stopped [s]: more than a tick and a stall that
is bridged. With the parent's polling period of 10 ms the operator is warned within 100 ms."""
POLL_PERIOD: Final = 0.010
"""Polling period of the parent [s]."""
DRAIN_PERIOD: Final = 0.050
"""Time between two drains of the rings [s]."""
JOIN_TIMEOUT: Final = 5.0
"""Time for a process to end by itself [s]."""
ASIDE: Final = ("warning", "nudge")
"""Names of messages beside an open question."""
CONSOLE: Final = "console"
"""Name of the message with a word from a console."""
SIGNALS: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""Signals that end a program: Ctrl-C, a request of the system, a closed terminal."""

_TIME, _STATE, _PHI, _TICKS = (PULSE.index(name) for name in ("time", "state", "phi", "ticks"))


Array = npt.NDArray[np.float64]
T = TypeVar("T")


class LocalOperator(Operator, Protocol):
    """Operator at a screen."""

    def live(self, phase: str, phi: float) -> None:
        """Show the phase of the run and the angle from upright [rad]; never blocks."""
        ...


def run_in_processes(request: RunRequest, out: Path, person: LocalOperator) -> RunEnd:
    """Run a policy on a rig in real time, and write the log.

    Args:
        request: The run.
        out: Path of the log.
        person: The operator.

    Raises:
        InputError: The policy cannot be sent to the loop's process.
        EquipoiseError: Error of the loop's process, or its end without a result.
    """
    with guest_code(f"sending {request.policy.name} to another process", "give it as MODULE:NAME"):
        pickle.dumps(request)
    context = multiprocessing.get_context("spawn")
    with share(_described(request)) as memory:
        return _run(context, request, memory, out, person)


def _run(
    context: SpawnContext,
    request: RunRequest,
    memory: Path,
    out: Path,
    person: LocalOperator,
) -> RunEnd:
    """Run the processes around shared memory; further arguments as of `run_in_processes`."""
    joints = len(request.settings.described_arm.joints)
    recorder = open_recorder(memory, joints)
    theirs, ours = context.Pipe()
    log_pipe, done = context.Pipe(), context.Event()
    writer = context.Process(
        target=_write,
        args=(memory, joints, out, request.conditions(), done, log_pipe[0]),
        daemon=True,
    )
    loop = context.Process(
        target=_loop, args=(_Pickled(request), memory, joints, theirs), daemon=False
    )
    words: list[str] = []
    log = LogProcess(writer, log_pipe[1])
    with handled_signals(SIGNALS, lambda *_: words.append(STOP)):
        try:
            _start(writer)
            log_pipe[0].close()
            log.begin()
            _start(loop)
            theirs.close()
            try:
                result = _attend(loop, recorder, person, words, ours, log)
            except BaseException:
                recorder.typed.push(STOP.encode())  # no later poll would send it
                raise
            log.end(
                result if isinstance(result, RunEnd) else RunEnd(evidence={"text": str(result)})
            )
        finally:
            if loop.pid is not None:
                loop.join(JOIN_TIMEOUT)
            done.set()
            if writer.pid is not None:
                writer.join(JOIN_TIMEOUT)
    log.check(person)
    if isinstance(result, EquipoiseError):
        raise result
    return result


class _Pickled:
    """Object that arrives in a new process as bytes, to be unpickled where errors are handled."""

    def __init__(self, value: object) -> None:
        self._value = value

    def __reduce__(self) -> Any:
        return bytes, (bytes(ForkingPickler.dumps(self._value)),)


def _described(request: RunRequest) -> RunInfo:
    """Return the description of a run for a console."""
    return RunInfo(
        title=f"{request.policy.name} on {request.robot}"[:1024],
        pid=os.getpid(),
        arm=request.settings.described_arm,
        phases=PHASES,
        duration=request.duration,
    )


@contextmanager
def handled_signals(
    signals: Iterable[signal.Signals], handler: Callable[..., object]
) -> Generator[None]:
    """Handle signals in this context; for the main thread only."""
    before = [(number, signal.signal(number, handler)) for number in signals]
    try:
        yield
    finally:
        for number, old in before:
            signal.signal(number, old)


def _start(process: BaseProcess) -> None:
    """Start a process with signals blocked, until it is ready for them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class LogProcess:
    """The writer's process, for the parent."""

    def __init__(self, writer: Any, pipe: Any) -> None:
        self._writer, self._pipe = writer, pipe
        self._warned = False

    def begin(self) -> None:
        """Wait until the log exists.

        Raises:
            OutsideError: The log cannot be written.
        """
        try:
            problem = self._pipe.recv()
        except (EOFError, OSError):
            problem = "the process that writes the log has ended at its start; try again"
        if problem is not None:
            raise OutsideError(problem)

    def check(self, person: LocalOperator) -> None:
        """Warn the operator once if the log is incomplete."""
        problem = None if self._warned else self._problem()
        if problem is not None:
            self._warned = True
            person.notify(OperatorMessage("warning", f"the log is incomplete: {problem}"))

    def end(self, outcome: RunEnd) -> None:
        """Send the end of the run to the writer."""
        _send(self._pipe, outcome)  # `check` warns of a writer that has ended

    def _problem(self) -> str | None:
        problem = _received(self._pipe)
        if problem is not None:
            return str(problem)
        if self._writer.is_alive() or self._writer.exitcode == 0:
            return None
        return f"the process that writes it has ended with {self._writer.exitcode}"


def _attend(
    loop: Any,
    recorder: Recorder,
    person: LocalOperator,
    words: list[str],
    ours: Any,
    log: LogProcess,
) -> RunEnd | EquipoiseError:
    """Serve the operator and monitor the loop until its process ends; return its result."""
    result: RunEnd | EquipoiseError | None = None
    silent = False
    while True:
        alive = loop.is_alive()
        if result is None:
            result = _received(ours)
        # The heartbeat comes before the messages, since printing may take long.
        pulse = recorder.pulse
        streams = pulse[_TICKS] > 0 and result is None
        beats = alive and time.monotonic() - float(pulse[_TIME]) < HEARTBEAT_TIMEOUT
        if streams and not beats and not silent:
            person.notify(OperatorMessage("fault", f"the loop does not answer: {CANNOT_STOP}"))
        silent = streams and not beats
        for event in read_events(recorder.notices.take()):
            person.notify(OperatorMessage(event.name, event.text, event.answers))
        log.check(person)
        said = [*person.read_input(), *words]
        words.clear()
        for word in said:
            recorder.typed.push(word.encode()[:64])
        if streams and alive:
            person.live(PHASES[int(pulse[_STATE])].value, float(pulse[_PHI]))
        if not alive:
            break
        time.sleep(POLL_PERIOD)
    if result is None:
        return OutsideError(
            f"the process that moves the arm has ended with {loop.exitcode}; press the E-stop, "
            "inspect the arm, and start the robot's application again"
        )
    return result


def _received(pipe: Any) -> Any:
    """Return the next object from a process; None without one, or from a closed pipe."""
    try:
        return pipe.recv() if pipe.poll() else None
    except (EOFError, OSError):
        return None


class OperatorProxy:
    """The operators, for the loop's process: rings to the parent process, and one from a console.

    The first answer to a question counts. A console names the question that it answers, so that a
    later answer is not taken for another question, or for a key that stops the run.
    """

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._asked = self._open = 0
        self._parent = os.getppid()
        self.signals: list[str] = []
        """Stops that signals to this process request."""

    def notify(self, event: OperatorMessage) -> None:
        """Send a message to the operators; never blocks."""
        now = time.monotonic()
        push_event(self._recorder.notices, now, event.name, event.answers, event.text)
        if event.answers:
            self._asked += 1
            self._open = self._asked
            question = Question(self._asked, event.name, event.answers, event.text)
            self._recorder.ask(question)
        elif event.name not in ASIDE:
            self._close()

    def read_input(self) -> list[str]:
        """Return the words of the operators, the oldest first."""
        words = [word.decode("utf-8", "ignore") for word in self._recorder.typed.take()["word"]]
        if any(words):  # Enter alone may be no answer
            self._close()
        for number, data in self._recorder.console.take().tolist():
            word = data.decode("utf-8", "ignore")
            if word == STOP or number == self._open > 0:
                self._close()
                words.append(word)
                push_event(
                    self._recorder.notices, time.monotonic(), CONSOLE, (), f"Console: {word}"
                )
        while self.signals:
            words.append(self.signals.pop())
        if os.getppid() != self._parent:
            self._parent = os.getppid()
            words.append(ALONE)
        return words

    def _close(self) -> None:
        """Withdraw the open question."""
        if self._open:
            self._open = 0
            self._recorder.ask(None)

    def attend(self, restart: str) -> None:
        """Check for a stop during the wait for a robot.

        Args:
            restart: Instruction for a new connection to the robot.

        Raises:
            OutsideError: The wait was stopped.
        """
        if {STOP, ALONE} & set(self.read_input()):
            raise OutsideError(
                "stopped during the wait for the robot; nothing has moved. To deploy again, "
                f"{restart or 'repeat the command'}"
            )


class WorkerProcess:
    """Process for jobs longer than a tick, started before the stream.

    It runs a self-test once, so that in the stream all its code is loaded.
    """

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        # A daemon ends with this process.
        self._process = context.Process(target=_work, args=(theirs,), daemon=True)
        _start(self._process)
        theirs.close()
        time_ = np.linspace(0.0, 6.0, 1200)
        move = 0.04 / (1.0 + np.exp(-12.0 * (time_ - 0.7)))
        self.begin(partial(_practise, time_, np.round(200.0 * np.sin(8.4 * time_)), move))
        while (result := self.result()) is None:
            time.sleep(POLL_PERIOD)
        if isinstance(result, Exception):
            self.close()
            raise OutsideError(f"the process for the self-test does not work ({result})")

    def begin(self, job: Job) -> None:
        """Send a job to the worker."""
        _send(self._pipe, job)  # `result` returns the error of a worker that has ended

    def result(self) -> Any:
        """Return the result of the job, once; an exception where the worker failed."""
        try:
            return self._pipe.recv() if self._pipe.poll() else None
        except (EOFError, OSError) as error:
            return error

    def close(self) -> None:
        """End the worker."""
        self._pipe.close()
        self._process.join(JOIN_TIMEOUT)
        if self._process.is_alive():
            self._process.kill()


class PolicyTimeout(KeyboardInterrupt):
    """Time limit of a policy exceeded: an interruption from outside, which `guest_code` passes on.

    No handler of `Exception` in the policy catches it.
    """


class InterruptedPolicy:
    """Policy with a time limit per call, enforced by a timer of the system.

    The timer interrupts Python code in the main thread; compiled code returns first.
    """

    def __init__(self, policy: Policy, limit: float) -> None:
        """Limit the time of each call of `policy` to `limit` [s]."""
        self._policy, self._limit, self._running = policy, limit, False
        signal.signal(signal.SIGALRM, self._interrupt)

    def reset(self) -> None:
        """Reset the policy."""
        self._within(self._policy.reset)

    def act(self, observation: Array) -> float:
        """Return u [m/s^2] for the observation, shape (4,).

        Raises:
            PolicyTimeout: The call exceeds the time limit.
        """
        return self._within(partial(self._policy.act, observation))

    def _within(self, call: Callable[[], T]) -> T:
        try:
            self._running = True
            signal.setitimer(signal.ITIMER_REAL, self._limit)
            return call()
        finally:
            self._running = False
            signal.setitimer(signal.ITIMER_REAL, 0.0)

    def _interrupt(self, *_: object) -> None:
        if self._running:
            raise PolicyTimeout(f"it took more than {1e3 * self._limit:.1f} ms")


def _practise(time_: Array, counts: Array, move: Array) -> SelfTest:
    """Run a self-test on an artificial swing."""
    with np.errstate(all="ignore"):
        return self_test(
            time_,
            counts,
            time_,
            move,
            pendulum=PendulumParameters(70.2, 7.16, 0.15),
            counts_per_rev=8192,
            resting=0.0,
            delay=0.0,
        )


def _work(pipe: Any) -> None:
    """Run the worker's process: execute jobs until the loop ends."""
    _ignore_signals()
    while True:
        try:
            job = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            pipe.send(job())
        except Exception as error:  # the run stops on it
            pipe.send(RuntimeError(str(error)))


def _ignore_signals() -> None:
    """Ignore signals: a helper process ends with the run."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


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
        operator.attend(restart_instruction(request.robot))
        rig.sensor.samples()

    try:
        request: RunRequest = pickle.loads(data)
        worker = WorkerProcess()
        warm_up(request)  # before the connection, which needs attention once it is open
        rig = request.connect(
            tell=lambda text: operator.notify(OperatorMessage("waiting", text)),
            attend=attend,
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


def _write(
    memory: Path,
    joints: int,
    out: Path,
    conditions: RunConditions,
    done: Any,
    pipe: Any,
) -> None:
    """Run the writer's process."""
    _ignore_signals()
    parent = os.getppid()
    recorder = open_recorder(memory, joints)
    try:
        writer = RunWriter(out, conditions, time.monotonic())
    except OutsideError as error:
        pipe.send(str(error))
        return
    pipe.send(None)
    until = float("inf")
    while True:
        last = done.is_set() or time.monotonic() > until
        writer.drain(recorder)
        if last or writer.problem is not None:
            break
        if os.getppid() != parent:  # the loop brings the arm to rest, and then stops ticking
            rests = recorder.pulse[_TICKS] == 0.0
            until = min(until, time.monotonic() + (0.0 if rests else JOIN_TIMEOUT))
        time.sleep(DRAIN_PERIOD)
    end: RunEnd = _received(pipe) or RunEnd()
    writer.finish(time.monotonic(), end.model_copy(update={"lost_rows": recorder.lost}))
    if writer.problem is not None:
        _send(pipe, writer.problem)


def _send(pipe: Any, value: object) -> None:
    """Send an object to a process that may have ended."""
    with suppress(OSError):
        pipe.send(value)
