"""Faults of processes, ports and the machine's load: the real course, in real time.

An emulated rig answers on a port and a pseudo-terminal in this process; `equipoise deploy` runs in
another one, and is not told. What it says is read from its output, what the arm does is seen on the
bench.
"""

import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from equipoise.devices.clocks import SystemClock
from equipoise.devices.emulation import Emulation
from equipoise.errors import EquipoiseError
from equipoise.logs.run_log import RunLog
from equipoise.model.pendulum import shipped_pendulum
from equipoise.model.sim_configs import pendulum_on, read_world
from equipoise.rigs import RigSettings
from equipoise.studies.rehearsal.fault_harness import WORLD
from equipoise.studies.rehearsal.verdicts import (
    REST_TOLERANCE,
    TOLD,
    Sent,
    came_to_rest,
    limits_kept,
)

HOST: Final = "127.0.0.1"
BALANCED: Final = 6.0
"""How long the run shall balance [s]."""
RUN_TIMEOUT: Final = 100.0
"""A run that has not ended after so long hangs [s]."""
LOAD: Final = 3.0
"""The machine is kept busy for so long [s]."""


class LiveFault(NamedTuple):
    """A line of the list that needs real time."""

    name: str
    """As the list calls it."""
    kind: str
    """What it is a fault of."""
    injected: str
    """What goes wrong, and when."""
    should: str
    """What has to happen."""
    play: Callable[[], tuple[str, list[str]]]
    """Makes it happen; returns what did, and what of that is not as it should be."""


class LiveRun(NamedTuple):
    """A run of `equipoise deploy` on an emulated rig, and what is seen of both."""

    process: subprocess.Popen[str]
    """The run."""
    emulation: Emulation
    """The rig."""
    port: int
    """The robot's."""
    log: Path
    """The run's."""
    lines: list[tuple[float, str]]
    """What the run says, and when [s]."""

    def wait_for(self, words: str, since: float = 0.0) -> float:
        """Wait until the run says something, and return when it did [s].

        Raises:
            TimeoutError: It does not.
        """
        until = time.monotonic() + RUN_TIMEOUT
        while time.monotonic() < until:
            for moment, line in list(self.lines):
                if words in line and moment >= since:
                    return moment
            if self.process.poll() is not None and time.monotonic() > until - RUN_TIMEOUT + 1.0:
                break
            time.sleep(0.005)
        raise TimeoutError(f"the run never said {words!r}")


@contextmanager
def course(*policy: str, duration: float = BALANCED) -> Generator[LiveRun]:
    """Run the whole course beside this process.

    Args:
        policy: Name of the policy; by default the table that ships.
        duration: Duration of the balancing [s].
    """
    settings, world = RigSettings(), read_world(WORLD).settings
    over = threading.Event()
    ready: list[int] = []
    with tempfile.TemporaryDirectory(prefix="equipoise-") as folder:
        emulation = Emulation(
            settings.described_arm,
            pendulum_on(shipped_pendulum(), world),
            world,
            SystemClock(),
        )

        def serve() -> None:
            _be_punctual()
            emulation.run(HOST, 0, over.is_set, listening=ready.append)

        rig = threading.Thread(target=serve, daemon=True)
        _be_punctual()
        rig.start()
        while not ready:
            time.sleep(0.01)
        log = Path(folder) / "run.mcap"
        command = [
            *(sys.executable, "-m", "equipoise", "deploy", *policy),
            *("--robot", f"kst://{HOST}:{ready[0]}"),
            *("--encoder", f"serial://{emulation.terminal}"),
            *("--duration", str(duration), "--out", str(log)),
        ]
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | {"PYTHONUNBUFFERED": "1", "COLUMNS": "400"},
            start_new_session=True,
        )
        lines: list[tuple[float, str]] = []
        threading.Thread(target=_attend, args=(process, lines), daemon=True).start()
        try:
            yield LiveRun(process, emulation, ready[0], log, lines)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            over.set()
            rig.join(5.0)
            _be_as_others()


def _be_punctual() -> None:
    """Let this thread come before others, where that is allowed: a cabinet has its own computer.

    Each thread that shares the interpreter's lock has to: whoever holds it must not be held up.
    """
    with suppress(OSError, AttributeError):
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(40))


def _be_as_others() -> None:
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


ANSWERS: Final = (
    (re.compile(r"Type (\w+)\."), None),
    (re.compile(r"y or n"), "y"),
)


def _attend(process: subprocess.Popen[str], lines: list[tuple[float, str]]) -> None:
    """Read what the run says, and answer as it asks."""
    _be_punctual()
    if process.stdout is None or process.stdin is None:
        return
    for line in process.stdout:
        lines.append((time.monotonic(), line.rstrip()))
        for pattern, answer in ANSWERS:
            if (asked := pattern.search(line)) is not None:
                with suppress(OSError):
                    process.stdin.write((answer or asked.group(1)) + "\n")
                    process.stdin.flush()


def _ended(run: LiveRun) -> int | None:
    try:
        return run.process.wait(RUN_TIMEOUT)
    except subprocess.TimeoutExpired:
        return None


def _judged(run: LiveRun, codes: Sequence[int]) -> list[str]:
    """Return what is wrong with the end of a run that software stopped."""
    code = _ended(run)
    if code is None:
        return ["the run did not end"]
    problems = [] if code in codes else [f"exit code {code}: {run.lines[-8:]}"]
    problems += _rests(run.emulation)
    try:
        log = RunLog.load(run.log, damaged=True)
    except EquipoiseError as error:
        return [*problems, str(error)]
    stream = log.tables["stream"]
    sent = [Sent(float(row["time"]), tuple(row["q"].tolist())) for row in stream]
    arm = RigSettings().described_arm
    problems += limits_kept(arm, sent)
    stops = [event.time for event in log.events if event.name in ("stopping", "fault")]
    return problems + (came_to_rest(arm, sent, stops[0]) if stops else ["no stop was logged"])


def _rests(emulation: Emulation) -> list[str]:
    bench = emulation.bench
    time.sleep(0.5)
    places: list[Any] = []
    for _ in range(30):
        places.append(np.array(bench.twin.kernel.bodies.qpos[: bench.joints]))
        time.sleep(0.01)
    moved = float(np.ptp(np.array(places), axis=0).max())
    return [f"at the end a joint moves by {moved:.3f} rad"] if moved > REST_TOLERANCE else []


def _last_words(run: LiveRun) -> str:
    told = [line.strip() for _, line in run.lines if line.strip()]
    return next((line for line in reversed(told) if "ended" in line), told[-1] if told else "")


def _signalled(number: signal.Signals, words: str, after: float) -> LiveFault:
    def play() -> tuple[str, list[str]]:
        with course() as run:
            run.wait_for(words)
            time.sleep(after)
            if number is signal.SIGINT:  # Ctrl-C reaches each process of the terminal
                os.killpg(run.process.pid, number)
            else:
                os.kill(run.process.pid, number)
            problems = _judged(run, (130,))
            return _last_words(run), problems

    return LiveFault(
        f"{number.name}: {words.lower()}",
        "process",
        f"{number.name}, {after:g} s after the run says {words!r}",
        "a latched stop inside the stream, rest, exit code 130",
        play,
    )


def _descendants(pid: int) -> list[int]:
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in task.read_text().split():
            found += [int(child), *_descendants(int(child))]
    return found


def _holds(pid: int, port: int) -> bool:
    """Return whether a process has a connection to a port of this machine."""
    inodes = {
        fields[9]
        for fields in map(str.split, Path("/proc/net/tcp").read_text().splitlines()[1:])
        if fields[2].endswith(f":{port:04X}")
    }
    for link in Path(f"/proc/{pid}/fd").glob("*"):
        with suppress(OSError):
            target = os.readlink(link)
            if target.startswith("socket:") and target[8:-1] in inodes:
                return True
    return False


def _killed() -> tuple[str, list[str]]:
    with course() as run:
        run.wait_for("Balancing")
        time.sleep(1.0)
        loop = [pid for pid in _descendants(run.process.pid) if _holds(pid, run.port)]
        if not loop:
            return "", ["the loop's process was not found"]
        os.kill(loop[0], signal.SIGKILL)
        killed = time.monotonic()
        told = run.wait_for("software cannot stop", killed)
        late = told - killed
        problems = [] if late <= TOLD else [f"the operator was told after {1e3 * late:.0f} ms"]
        code = _ended(run)
        if code != 3:
            problems.append(f"exit code {code}, expected 3")
        problems += _rests(run.emulation)
        return f"told after {1e3 * late:.0f} ms to press the E-stop; the arm rests", problems


def _second_client() -> tuple[str, list[str]]:
    with course() as run:
        run.wait_for("Balancing")
        answered = b""
        with suppress(OSError), socket.create_connection((HOST, run.port), 1.0) as second:
            second.settimeout(1.0)
            second.sendall(b"getJointsPositions\nend\n")
            answered = second.recv(100)
        problems = _judged(run, (0, 1))
        if answered:
            problems.append(f"the server answered {answered!r}")
        return _last_words(run), problems


def _busy() -> tuple[str, list[str]]:
    with course() as run:
        run.wait_for("Balancing")
        spin = f"import time\nend = time.monotonic() + {LOAD}\nwhile time.monotonic() < end: pass"
        load = [
            subprocess.Popen([sys.executable, "-c", spin]) for _ in range(2 * (os.cpu_count() or 1))
        ]
        try:
            problems = _judged(run, (0, 1))
            return _last_words(run), problems
        finally:
            for process in load:
                process.wait()


REAL_TIME: Final = (
    LiveFault(
        "CPU load",
        "process",
        f"twice as many busy processes as cores for {LOAD:g} s, while balancing",
        "it balances, or a late tick stops it; the arm rests",
        _busy,
    ),
    LiveFault(
        "second client",
        "process",
        "another program connects to the robot, while balancing",
        "it is not answered, and the run goes on",
        _second_client,
    ),
    LiveFault(
        "control process killed",
        "process",
        "SIGKILL to the process that moves the arm, while balancing",
        "told within 100 ms that software cannot stop the robot; it rests at its last target",
        _killed,
    ),
    *(
        _signalled(number, words, after)
        for number, words, after in (
            (signal.SIGINT, "Moving to home", 0.4),
            (signal.SIGTERM, "Self-test: the arm moves", 0.6),
            (signal.SIGINT, "Armed", 0.1),
            (signal.SIGINT, "Balancing", 1.0),
            (signal.SIGTERM, "Balancing", 1.5),
        )
    ),
)
"""Those that need real processes and ports."""
