"""A run on a real rig, over three processes.

The *loop* has the links and the deadlines, and nothing else to do. The *writer* drains its rings
to the disk; without it the run goes on, and the operator is warned. The *parent* talks to the
operator, and watches the loop's heartbeat: when it stops beating while the servo runs, the operator
is told at once that software does not command the arm any more. A loop whose parent is gone, or
whose operator cannot be told anything, brings the arm to rest.

Signals that would end a program (SIGINT, SIGTERM, SIGHUP) are words to the loop: it brings the arm
to rest inside the stream, whatever it was doing.
"""

import ctypes
import multiprocessing
import os
import pickle
import signal
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from equipoise.control.policy import Policy
from equipoise.control.run_controller import LATE, PHASES
from equipoise.control.self_test import SelfTest, self_test
from equipoise.control.states import STREAMING
from equipoise.control.ticks import Job, OperatorMessage
from equipoise.deployment.rig import ALONE, STOP, RunRequest, RunResult, run_on_rig, warm_up
from equipoise.devices import realtime
from equipoise.devices.loop import CANNOT_STOP
from equipoise.devices.operator import Operator
from equipoise.errors import EquipoiseError, InputError, OutsideError
from equipoise.logs.conditions import RunConditions, RunEnd
from equipoise.logs.recorder import PULSE, Recorder, push_event, take_events
from equipoise.logs.writer import RunWriter
from equipoise.model.pendulum import PendulumParameters
from equipoise.rigs import connect, restart_instruction

SILENT: Final = 0.080
"""A loop that has not ticked for so long does not tick any more [s]; with the parent's own look
every 10 ms the operator knows within 100 ms."""
LOOK: Final = 0.010
"""Between two looks of the parent [s]."""
WRITE: Final = 0.050
"""Between two drains of the rings [s]."""
FAREWELL: Final = 5.0
"""So long a process may take to end by itself [s]."""
SIGNALS: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""What would end a program: Ctrl-C, a wish of the system, a terminal that is closed."""

_TIME, _STATE, _PHI, _TICKS = (PULSE.index(name) for name in ("time", "state", "phi", "ticks"))


Array = npt.NDArray[np.float64]
T = TypeVar("T")


class LocalOperator(Operator, Protocol):
    """An operator at a screen."""

    def live(self, phase: str, phi: float) -> None:
        """Show where the run is and the angle from upright [rad], in passing."""
        ...


def run_in_processes(
    request: RunRequest, out: Path, person: LocalOperator, *, replace: bool = False
) -> RunResult:
    """Run a policy on a rig in real time, and write the log.

    Args:
        request: What is to run where.
        out: The log.
        person: Who is told and asked.
        replace: Whether an existing log is replaced, once this run is connected.

    Raises:
        EquipoiseError: What the loop's process raised; or it ended without a word.
    """
    _check_transfer(request)
    context = multiprocessing.get_context("spawn")
    joints = len(request.settings.described_arm.joints)
    memory = context.RawArray(ctypes.c_char, Recorder.room(joints))
    recorder = Recorder(joints, memoryview(memory).cast("B"))
    theirs, ours = context.Pipe()
    told, done = context.Pipe(), context.Event()
    writer = context.Process(
        target=_write,
        args=(memory, joints, out, replace, request.conditions(), done, told[0]),
        daemon=True,
    )
    loop = context.Process(target=_loop, args=(request, memory, joints, theirs), daemon=False)
    words: list[str] = []
    before = {number: signal.signal(number, lambda *_: words.append(STOP)) for number in SIGNALS}
    log = LogProcess(writer, told[1])
    try:
        with _unheard():
            writer.start()
        told[0].close()
        log.begin()
        with _unheard():
            loop.start()
        theirs.close()
        try:
            result = _attend(loop, recorder, person, words, ours, log)
        except BaseException:
            recorder.words.push(STOP.encode())  # nobody is left who could
            raise
        log.end(
            RunEnd(**result._asdict())
            if isinstance(result, RunResult)
            else RunEnd(fault=str(result))
        )
    finally:
        if loop.pid is not None:
            loop.join(FAREWELL)
        done.set()
        if writer.pid is not None:
            writer.join(FAREWELL)
        for number, handler in before.items():
            signal.signal(number, handler)
    log.mind(person)
    if isinstance(result, EquipoiseError):
        raise result
    return result


def _check_transfer(request: RunRequest) -> None:
    """Check that the loop's process can receive a request.

    Raises:
        InputError: The policy cannot be sent there.
    """
    try:
        pickle.dumps(request)
    except Exception as error:  # whatever the policy holds
        raise InputError(
            f"{request.policy.name} cannot be sent to the process of the run ({error}); give it as "
            "MODULE:NAME"
        ) from None


@contextmanager
def _unheard() -> Generator[None]:
    """Let a process that is started here hear of no signal before it is ready to."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class LogProcess:
    """The writer's process as the parent sees it."""

    def __init__(self, writer: Any, told: Any) -> None:
        self._writer, self._told = writer, told
        self._minded = False

    def begin(self) -> None:
        """Wait until the file is there."""
        try:
            problem = self._told.recv()
        except (EOFError, OSError):
            problem = "the process that writes the log has ended at its begin; try again"
        if problem is not None:
            raise OutsideError(problem)

    def mind(self, person: LocalOperator) -> None:
        """Warn once where the log is not written any more."""
        problem = None if self._minded else self._problem()
        if problem is not None:
            self._minded = True
            person.notify(OperatorMessage("warning", f"the log is incomplete: {problem}"))

    def end(self, outcome: RunEnd) -> None:
        """Say how the run ended."""
        with suppress(OSError):  # nobody writes any more; it was told
            self._told.send(outcome)

    def _problem(self) -> str | None:
        try:
            if self._told.poll():
                return str(self._told.recv())
        except (EOFError, OSError):
            pass
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
) -> RunResult | EquipoiseError:
    """Talk, and watch, until the loop's process has ended; return what it sent."""
    result: RunResult | EquipoiseError | None = None
    silent = False
    while True:
        alive = loop.is_alive()
        if result is None:
            result = _received(ours)
        # Before anything is printed: that may take its time.
        pulse = recorder.pulse
        streams = pulse[_TICKS] > 0 and result is None
        beats = alive and time.monotonic() - float(pulse[_TIME]) < SILENT
        if streams and not beats and not silent:
            person.notify(OperatorMessage("fault", f"the loop does not answer: {CANNOT_STOP}"))
        silent = streams and not beats
        for event in take_events(recorder.told):
            person.notify(OperatorMessage(event.name, event.text, event.answers))
        log.mind(person)
        said = [*person.read_input(), *words]
        words.clear()
        for word in said:
            recorder.words.push(word.encode()[:64])
        if streams and alive:
            phase = PHASES[int(pulse[_STATE])]
            if phase in STREAMING:
                person.live(phase.value, float(pulse[_PHI]))
        if not alive:
            break
        time.sleep(LOOK)
    if result is None:
        code = loop.exitcode
        return OutsideError(
            f"the process that moves the arm has ended with {code}; press the E-stop, look at the "
            "arm, and start the robot's application again"
        )
    return result


def _received(pipe: Any) -> Any:
    """Return what a process has sent; none where nothing came, or never will."""
    try:
        return pipe.recv() if pipe.poll() else None
    except (EOFError, OSError):
        return None


class OperatorProxy:
    """The operator as the loop's process sees it: on the other side of two rings."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._parent = os.getppid()
        self.signalled = False

    def notify(self, event: OperatorMessage) -> None:
        """Send a message to the operator in the parent process; never blocks."""
        now = time.monotonic()
        push_event(self._recorder.told, now, event.name, event.answers, event.text)

    def read_input(self) -> list[str]:
        """Return the words that the parent process has received, the oldest first."""
        words = [word.decode("utf-8", "ignore") for word in self._recorder.words.take()["word"]]
        if self.signalled:
            self.signalled = False
            words.append(STOP)
        if os.getppid() != self._parent:
            self._parent = os.getppid()
            words.append(ALONE)
        return words

    def attend(self, restart: str) -> None:
        """End the wait for a robot once the operator stops it.

        Args:
            restart: What the operator does before the robot can be connected again.

        Raises:
            OutsideError: The wait was stopped.
        """
        if {STOP, ALONE} & set(self.read_input()):
            raise OutsideError(
                "stopped while the robot was waited for; nothing has moved. To deploy again, "
                f"{restart or 'repeat the command'}"
            )


class WorkerProcess:
    """A process for jobs that take longer than a tick; it is started before the stream is."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        # As a daemon it ends with this process, whatever becomes of that.
        self._process = context.Process(target=_work, args=(theirs,), daemon=True)
        with _unheard():
            self._process.start()
        theirs.close()
        self._practise()

    def begin(self, job: Job) -> None:
        """Send a job to the worker."""
        with suppress(OSError):  # where it is gone, `result` says so
            self._pipe.send(job)

    def result(self) -> Any:
        """Return the result of the job, once; an exception where the worker failed."""
        try:
            return self._pipe.recv() if self._pipe.poll() else None
        except (EOFError, OSError) as error:
            return error

    def close(self) -> None:
        """End the worker."""
        self._pipe.close()
        self._process.join(FAREWELL)
        if self._process.is_alive():
            self._process.kill()

    def _practise(self) -> None:
        """Send a self-test there and take its verdict, so that in the stream both are old hat."""
        time_ = np.linspace(0.0, 6.0, 1200)
        move = 0.04 / (1.0 + np.exp(-12.0 * (time_ - 0.7)))
        self.begin(partial(_judge_nothing, time_, np.round(200.0 * np.sin(8.4 * time_)), move))
        while (result := self.result()) is None:
            time.sleep(LOOK)
        if isinstance(result, Exception):
            self.close()
            raise OutsideError(f"the process for the self-test does not work ({result})")


class PolicyTimeout(BaseException):
    """The time of a policy is over; no handler of `Exception` in the policy catches this."""


class InterruptedPolicy:
    """A policy that a timer of the system interrupts: an endless loop in Python ends in time.

    The timer's signal reaches the main thread of a process, and waits for compiled code to return.
    """

    def __init__(self, policy: Policy, limit: float) -> None:
        """Limit the time of each call of `policy` to `limit` [s]."""
        self._policy, self._limit, self._running = policy, limit, False
        if hasattr(signal, "setitimer"):
            signal.signal(signal.SIGALRM, self._interrupt)

    def reset(self) -> None:
        """Begin a run."""
        self._within(self._policy.reset)

    def act(self, observation: Array) -> float:
        """Return u [m/s^2] for the observation, shape (4,).

        Raises:
            PolicyTimeout: The policy takes too long.
        """
        return self._within(partial(self._policy.act, observation))

    def _within(self, call: Callable[[], T]) -> T:
        if not hasattr(signal, "setitimer"):
            return call()
        try:
            self._running = True
            signal.setitimer(signal.ITIMER_REAL, self._limit)
            return call()
        finally:
            self._running = False
            signal.setitimer(signal.ITIMER_REAL, 0.0)

    def _interrupt(self, *_: object) -> None:
        if self._running:
            raise PolicyTimeout(f"{LATE} more than {1e3 * self._limit:.1f} ms")


def _judge_nothing(time_: Array, counts: Array, move: Array) -> SelfTest:
    """Judge a swing that no pendulum makes."""
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
    """Be the process beside the loop's: do one job after the other until the loop is gone."""
    _be_deaf()
    while True:
        try:
            job = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            pipe.send(job())
        except Exception as error:  # it is the heart's, to stop on
            pipe.send(RuntimeError(str(error)))


def _be_deaf() -> None:
    """Leave signals to the others: this process ends when it is not needed any more."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _loop(request: RunRequest, memory: Any, joints: int, pipe: Any) -> None:
    """Be the loop's process."""
    recorder = Recorder(joints, memoryview(memory).cast("B"))
    across = OperatorProxy(recorder)

    def stop(*_: object) -> None:
        across.signalled = True

    for number in SIGNALS:
        signal.signal(number, stop)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    aside: WorkerProcess | None = None
    result: RunResult | EquipoiseError
    try:
        aside = WorkerProcess()
        warm_up(request)  # before a link is there that could not be listened to meanwhile
        rig = connect(
            request.robot,
            request.encoder,
            request.settings,
            request.policy.pendulum,
            tell=lambda text: across.notify(OperatorMessage("waiting", text)),
            period=request.policy.h / 2.0,
            attend=lambda: across.attend(restart_instruction(request.robot)),
        )
        result = run_on_rig(
            request,
            rig,
            [across],
            recorder,
            measures=realtime.prepare,
            workshop=aside,
            supervise=InterruptedPolicy,
        )
    except EquipoiseError as error:
        result = type(error)(str(error))
    except Exception as error:  # the parent shall say it in one sentence
        result = OutsideError(f"the run failed ({type(error).__name__}: {error}); please report it")
    with suppress(OSError):  # nobody is there to take it
        pipe.send(result)
    if aside is not None:
        aside.close()


def _write(
    memory: Any,
    joints: int,
    out: Path,
    replace: bool,
    conditions: RunConditions,
    done: Any,
    told: Any,
) -> None:
    """Be the writer's process."""
    _be_deaf()
    parent = os.getppid()
    recorder = Recorder(joints, memoryview(memory).cast("B"))
    try:
        writer = RunWriter(out, conditions, time.monotonic(), replace=replace)
    except OutsideError as error:
        told.send(str(error))
        return
    told.send(None)
    said = False
    until = float("inf")
    ended: Callable[[], bool] = done.is_set
    while True:
        last = ended() or time.monotonic() > until
        writer.drain(recorder)
        if last:
            break
        if writer.problem is not None and not said:
            _report(told, writer.problem)
            said = True
        if os.getppid() != parent:  # the loop brings the arm to rest, and then beats no more
            rests = recorder.pulse[_TICKS] == 0.0
            until = min(until, time.monotonic() + (0.0 if rests else FAREWELL))
        time.sleep(WRITE)
    end: RunEnd = _received(told) or RunEnd()
    writer.finish(time.monotonic(), end.model_copy(update={"lost_rows": recorder.lost}))
    if writer.problem is not None and not said:
        _report(told, writer.problem)


def _report(pipe: Any, problem: str) -> None:
    with suppress(OSError):  # nobody is there to be told
        pipe.send(problem)
