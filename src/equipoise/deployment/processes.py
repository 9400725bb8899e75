"""A run on a real rig, over three processes.

The *loop* has the links and the deadlines, and nothing else to do. The *writer* drains its rings
to the disk. The *parent* talks to the operator, and watches the loop's heartbeat: when it stops
beating while the servo runs, the operator is told at once that software does not command the arm
any more.

Signals that would end a program (SIGINT, SIGTERM) are words to the loop: it brings the arm to rest
inside the stream, whatever it was doing.
"""

import ctypes
import multiprocessing
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, Protocol

from equipoise.control.pilot import PHASES
from equipoise.control.states import STREAMING
from equipoise.control.ticks import Event, Job
from equipoise.deployment.rig import Outcome, Request, run_on_rig
from equipoise.devices import realtime
from equipoise.devices.loop import CANNOT_STOP
from equipoise.devices.operator import Operator
from equipoise.errors import EquipoiseError, OutsideError
from equipoise.rigs import connect
from equipoise.runwriter import PULSE, Recorder, RunWriter, push_event, take_events

SILENT: Final = 0.080
"""A loop that has not ticked for so long does not tick any more [s]; with the parent's own look
every 10 ms the operator knows within 100 ms."""
LOOK: Final = 0.010
"""Between two looks of the parent [s]."""
WRITE: Final = 0.050
"""Between two drains of the rings [s]."""
FAREWELL: Final = 5.0
"""So long a process may take to end by itself [s]."""
STOP: Final = "stop"
"""What a signal says to the loop."""

_STATE, _PHI, _TICKS = (PULSE.index(name) for name in ("state", "phi", "ticks"))


class Person(Operator, Protocol):
    """An operator at a screen."""

    def live(self, phase: str, phi: float) -> None:
        """Show where the run is and the angle from upright [rad], in passing."""
        ...


def run_for_real(request: Request, out: Path, person: Person) -> Outcome:
    """Run a policy on a rig in real time, and write the log.

    Args:
        request: What is to run where.
        out: The log.
        person: Who is told and asked.

    Raises:
        EquipoiseError: What the loop's process raised; or it ended without a word.
    """
    context = multiprocessing.get_context("spawn")
    joints = len(request.settings.described_arm.joints)
    memory = context.RawArray(ctypes.c_char, Recorder.room(joints))
    recorder = Recorder(joints, memoryview(memory).cast("B"))
    theirs, ours = context.Pipe()
    told, done = context.Pipe(), context.Event()
    writer = context.Process(
        target=_write, args=(memory, joints, out, request.conditions(), done, told[0]), daemon=True
    )
    loop = context.Process(target=_loop, args=(request, memory, joints, theirs), daemon=False)
    words: list[str] = []
    before = {
        number: signal.signal(number, lambda *_: words.append(STOP))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        writer.start()
        problem = told[1].recv()
        if problem is not None:
            raise OutsideError(problem)
        loop.start()
        theirs.close()
        result = _attend(loop, recorder, person, words, ours)
        told[1].send(result._asdict() if isinstance(result, Outcome) else {"fault": str(result)})
    finally:
        if loop.pid is not None:
            loop.join(FAREWELL)
        done.set()
        writer.join(FAREWELL)
        for number, handler in before.items():
            signal.signal(number, handler)
    while told[1].poll():
        person.tell(Event("warning", f"the log is incomplete: {told[1].recv()}"))
    if isinstance(result, EquipoiseError):
        raise result
    return result


def _attend(
    loop: Any, recorder: Recorder, person: Person, words: list[str], ours: Any
) -> Outcome | EquipoiseError:
    """Talk, and watch, until the loop's process has ended; return what it sent."""
    result: Outcome | EquipoiseError | None = None
    silent = False
    while True:
        alive = loop.is_alive()
        for event in take_events(recorder.told):
            person.tell(event)
        said = [*person.words(), *words]
        words.clear()
        for word in said:
            recorder.words.push(word.encode()[:64])
        if result is None and ours.poll():
            try:
                result = ours.recv()
            except EOFError:
                alive = False
        pulse = recorder.pulse
        streams = pulse[_TICKS] > 0 and result is None
        if streams:
            phase = PHASES[int(pulse[_STATE])]
            if phase in STREAMING:
                person.live(phase.value, float(pulse[_PHI]))
            beats = time.monotonic() - float(pulse[0]) < SILENT
            if not silent and (not beats or not alive):
                person.tell(Event("fault", f"the loop does not answer: {CANNOT_STOP}"))
            silent = not beats or not alive
        if not alive:
            break
        time.sleep(LOOK)
    if result is None and ours.poll():
        try:
            result = ours.recv()
        except EOFError:
            result = None
    for event in take_events(recorder.told):
        person.tell(event)
    if result is None:
        code = loop.exitcode
        return OutsideError(
            f"the process that moves the arm has ended with {code}; press the E-stop, look at the "
            "arm, and start the robot's application again"
        )
    return result


class _Across:
    """The operator as the loop's process sees it: on the other side of two rings."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self.signalled = False

    def tell(self, event: Any) -> None:
        now = time.monotonic()
        push_event(self._recorder.told, now, event.name, event.answers, event.text)

    def words(self) -> list[str]:
        words = [word.decode("utf-8", "ignore") for word in self._recorder.words.take()["word"]]
        if self.signalled:
            self.signalled = False
            words.append(STOP)
        return words


class _Aside:
    """A process for jobs that take longer than a tick; it is started before the stream is."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        # As a daemon it ends with this process, whatever becomes of that.
        self._process = context.Process(target=_work, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()
        self._pipe.recv()

    def begin(self, job: Job) -> None:
        self._pipe.send(job)

    def result(self) -> Any:
        try:
            return self._pipe.recv() if self._pipe.poll() else None
        except (EOFError, OSError) as error:
            return error

    def close(self) -> None:
        self._pipe.close()
        self._process.join(FAREWELL)
        if self._process.is_alive():
            self._process.kill()


def _work(pipe: Any) -> None:
    """Be the process beside the loop's: do one job after the other until the loop is gone."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    _warm()
    pipe.send(None)
    while True:
        try:
            job = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            pipe.send(job())
        except Exception as error:  # it is the heart's, to stop on
            pipe.send(RuntimeError(str(error)))


def _warm() -> None:
    """Import and compile what a self-test needs."""
    import numpy as np

    from equipoise.control.self_test import self_test
    from equipoise.model.pendulum import PendulumParameters

    time_ = np.linspace(0.0, 6.0, 1200)
    move = 0.04 / (1.0 + np.exp(-12.0 * (time_ - 0.7)))
    with np.errstate(all="ignore"):  # no pendulum answers like this
        self_test(
            time_,
            np.round(200.0 * np.sin(8.4 * time_)),
            time_,
            move,
            pendulum=PendulumParameters(70.2, 7.16, 0.15),
            counts_per_rev=8192,
            resting=0.0,
            delay=0.0,
        )


def _loop(request: Request, memory: Any, joints: int, pipe: Any) -> None:
    """Be the loop's process."""
    recorder = Recorder(joints, memoryview(memory).cast("B"))
    across = _Across(recorder)

    def stop(*_: object) -> None:
        across.signalled = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    aside: _Aside | None = None
    result: Outcome | EquipoiseError
    try:
        aside = _Aside()
        rig = connect(
            request.robot,
            request.encoder,
            request.settings,
            request.policy.pendulum.parameters(),
            tell=lambda text: across.tell(Event("waiting", text)),
        )
        result = run_on_rig(
            request, rig, across, recorder, measures=realtime.prepare, workshop=aside
        )
    except EquipoiseError as error:
        result = type(error)(str(error))
    except Exception as error:  # the parent shall say it in one sentence
        result = OutsideError(f"the run failed ({type(error).__name__}: {error}); please report it")
    pipe.send(result)
    if aside is not None:
        aside.close()


def _write(
    memory: Any, joints: int, out: Path, conditions: dict[str, Any], done: Any, told: Any
) -> None:
    """Be the writer's process."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    recorder = Recorder(joints, memoryview(memory).cast("B"))
    try:
        writer = RunWriter(out, joints, conditions, time.monotonic())
    except OutsideError as error:
        told.send(str(error))
        return
    told.send(None)
    said = False
    ended: Callable[[], bool] = done.is_set
    while True:
        last = ended()
        writer.drain(recorder)
        if writer.problem is not None and not said:
            told.send(writer.problem)
            said = True
        if last:
            break
        time.sleep(WRITE)
    outcome = told.recv() if told.poll() else {}
    writer.finish(time.monotonic(), {**outcome, "lost_rows": recorder.lost})
