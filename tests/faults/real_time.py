"""Faults of processes, ports and the machine's load, in real time.

An emulated rig serves a port and a pseudo-terminal in this process. `equipoise deploy` runs in
another process, as on a real rig. Its messages are read from its output, and the motion of the arm
from the simulated rig.
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
from collections import deque
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from equipoise.errors import EquipoiseError
from equipoise.logs.run_log import RunLog
from equipoise.model.pendulum import shipped_pendulum
from equipoise.model.worlds import pendulum_on, read_world
from equipoise.rig.clocks import SystemClock
from equipoise.rig.config import RigSettings
from equipoise.robots.emulation import Emulation
from tests.faults import verdicts
from tests.faults.harness import WORLD

HOST: Final = "127.0.0.1"
BALANCE_TIME: Final = 6.0
"""Duration of the balancing [s]."""
RUN_TIMEOUT: Final = 100.0
"""Timeout of a run [s]."""
LOAD_TIME: Final = 3.0
"""Duration of the load on the machine [s]."""


class LiveRun(NamedTuple):
    """Run of `equipoise deploy` on an emulated rig."""

    process: subprocess.Popen[str]
    """Process of the run."""
    emulation: Emulation
    """Emulated rig."""
    port: int
    """Port of the robot."""
    log: Path
    """Log of the run."""
    lines: list[tuple[float, str]]
    """Output of the run: time [s] and line."""

    def wait_for(self, text: str, since: float = 0.0) -> float:
        """Wait until the run prints a text, and return the time of its line [s].

        Raises:
            TimeoutError: The text is not printed.
        """
        begin = time.monotonic()
        while (waited := time.monotonic() - begin) < RUN_TIMEOUT:
            for moment, line in list(self.lines):
                if text in line and moment >= since:
                    return moment
            if self.process.poll() is not None and waited > 1.0:
                break
            time.sleep(0.005)
        raise TimeoutError(f"the run did not print {text!r}; see the output of equipoise deploy")


@contextmanager
def live_run() -> Generator[LiveRun]:
    """Run `equipoise deploy` of the shipped policy in another process."""
    settings, world = RigSettings(), read_world(WORLD).settings
    over = threading.Event()
    ports: list[int] = []
    with tempfile.TemporaryDirectory(prefix="equipoise-") as folder:
        pendulum = pendulum_on(shipped_pendulum(), world)
        emulation = Emulation(settings.described_arm, pendulum, world, SystemClock())
        acts: deque[str] = deque()

        def stop() -> bool:
            while acts:
                emulation.acts[acts.popleft()]()
            return over.is_set()

        def serve() -> None:
            _raise_priority()
            emulation.run(HOST, 0, stop, listening=ports.append)

        rig = threading.Thread(target=serve, daemon=True)
        _raise_priority()
        rig.start()
        while not ports:
            time.sleep(0.01)
        log = Path(folder) / "run.mcap"
        command = [
            *(sys.executable, "-m", "equipoise", "deploy"),
            *("--robot", f"kst://{HOST}:{ports[0]}"),
            *("--encoder", f"serial://{emulation.terminal.path}"),
            *("--duration", str(BALANCE_TIME), "--out", str(log)),
        ]
        pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        environment = os.environ | {"PYTHONUNBUFFERED": "1", "COLUMNS": "400"}
        process = subprocess.Popen(
            command, stderr=subprocess.STDOUT, env=environment, start_new_session=True, **pipes
        )
        lines: list[tuple[float, str]] = []
        threading.Thread(target=_answer_prompts, args=(process, lines, acts), daemon=True).start()
        try:
            yield LiveRun(process, emulation, ports[0], log, lines)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            over.set()
            rig.join(5.0)
            with suppress(OSError, AttributeError):
                os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def _raise_priority() -> None:
    """Give this thread real-time priority, if allowed: a real cabinet has its own computer.

    All threads that share the interpreter's lock need it, so that its holder is not preempted.
    """
    with suppress(OSError, AttributeError):
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(40))


ANSWERS: Final = ((re.compile(r"Type (\w+)\."), None), (re.compile(r"y or n"), "y"))
"""Pattern of each prompt, and its answer; None if the first group of the match is the answer."""
ACTS: Final = {
    "steady it with a finger": ("steady",),
    "hangs still": ("release", "press"),
    "Lift the pendulum": ("lift",),
    "Armed. Let go": ("release",),
    "Hold the pendulum upright again": ("lift",),
    "nudge it": ("release", "push"),
}
"""Acts of the operator's hand, by the prompt that asks for them."""


def _answer_prompts(
    process: subprocess.Popen[str], lines: list[tuple[float, str]], acts: deque[str]
) -> None:
    """Record the output of the run, answer its prompts, and do with the hand what they ask for."""
    _raise_priority()
    for line in process.stdout:
        lines.append((time.monotonic(), line.rstrip()))
        for prompt, words in ACTS.items():
            if prompt in line:
                time.sleep(0.5)  # the reaction time
                acts.extend(words)
        for pattern, answer in ANSWERS:
            if (prompt := pattern.search(line)) is not None:
                with suppress(OSError):
                    process.stdin.write((answer or prompt.group(1)) + "\n")
                    process.stdin.flush()


def _exit_code(run: LiveRun) -> int | None:
    with suppress(subprocess.TimeoutExpired):
        return run.process.wait(RUN_TIMEOUT)
    return None


def _check_run(run: LiveRun, codes: Sequence[int]) -> list[str]:
    """Return the problems of the end of a run that software stopped."""
    code = _exit_code(run)
    if code is None:
        return ["the run did not end"]
    problems = [] if code in codes else [f"exit code {code}: {run.lines[-8:]}"]
    problems += _check_rest(run.emulation)
    try:
        log = RunLog.load(run.log, damaged=True)
    except EquipoiseError as error:
        return [*problems, str(error)]
    stream = log.tables["stream"]
    sent = [verdicts.Sent(float(row["time"]), tuple(row["q"].tolist())) for row in stream]
    arm = RigSettings().described_arm
    problems += verdicts.check_limits(arm, sent)
    stops = [event.time for event in log.events if event.name in ("stopping", "fault")]
    if not stops:
        return [*problems, "no stop was logged"]
    return problems + verdicts.check_stop(arm, sent, stops[0])


def _check_rest(emulation: Emulation) -> list[str]:
    bench, postures = emulation.bench, list[list[float]]()
    time.sleep(0.5)
    for _ in range(30):
        postures.append(bench.twin.kernel.bodies.qpos[: bench.joints].tolist())
        time.sleep(0.01)
    return verdicts.check_still(postures)


def _final_line(run: LiveRun) -> str:
    lines = [line.strip() for _, line in run.lines if line.strip()]
    return next((line for line in reversed(lines) if "ended" in line), lines[-1] if lines else "")


def _play_signal(
    number: signal.Signals, text: str, after: float
) -> Callable[[], tuple[str, list[str]]]:
    def play() -> tuple[str, list[str]]:
        with live_run() as run:
            run.wait_for(text)
            time.sleep(after)
            # Ctrl-C reaches each process of the terminal.
            send = os.killpg if number is signal.SIGINT else os.kill
            send(run.process.pid, number)
            problems = _check_run(run, (130,))
            return _final_line(run), problems

    return play


def _descendants(pid: int) -> list[int]:
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in task.read_text().split():
            found += [int(child), *_descendants(int(child))]
    return found


def _connected(pid: int, port: int) -> bool:
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


def _play_kill() -> tuple[str, list[str]]:
    with live_run() as run:
        run.wait_for("Balancing")
        time.sleep(1.0)
        loop = [pid for pid in _descendants(run.process.pid) if _connected(pid, run.port)]
        if not loop:
            return "", ["the loop's process was not found"]
        os.kill(loop[0], signal.SIGKILL)
        killed = time.monotonic()
        late = run.wait_for("software cannot stop", killed) - killed
        on_time = late <= verdicts.MAX_NOTICE
        problems = [] if on_time else [f"the warning came after {1e3 * late:.0f} ms"]
        code = _exit_code(run)
        if code != 3:
            problems.append(f"exit code {code}, expected 3")
        problems += _check_rest(run.emulation)
        return f"warned after {1e3 * late:.0f} ms to press the E-stop; the arm rests", problems


def _play_second_client() -> tuple[str, list[str]]:
    with live_run() as run:
        run.wait_for("Balancing")
        reply = b""
        with suppress(OSError), socket.create_connection((HOST, run.port), 1.0) as second:
            second.settimeout(1.0)
            second.sendall(b"getJointsPositions\nend\n")
            reply = second.recv(100)
        problems = _check_run(run, (0, 1))
        if reply:
            problems.append(f"the server answered {reply!r}")
        return _final_line(run), problems


def _play_load() -> tuple[str, list[str]]:
    spin = f"import time\nend = time.monotonic() + {LOAD_TIME}\nwhile time.monotonic() < end: pass"
    with live_run() as run:
        run.wait_for("Balancing")
        cores = os.cpu_count() or 1
        load = [subprocess.Popen([sys.executable, "-c", spin]) for _ in range(2 * cores)]
        try:
            problems = _check_run(run, (0, 1))
            return _final_line(run), problems
        finally:
            for process in load:
                process.wait()


SIGNALS: Final = (
    (signal.SIGINT, "Moving to home", 0.4),
    (signal.SIGTERM, "Self-test: the arm moves", 0.6),
    (signal.SIGINT, "Armed", 0.1),
    (signal.SIGINT, "Balancing", 1.0),
    (signal.SIGTERM, "Balancing", 1.5),
)
"""Signals that end a run, each with a line of its output and the time after it [s]."""
REAL_TIME: Final = {
    "CPU load": _play_load,
    "second client": _play_second_client,
    "control process killed": _play_kill,
    **{
        f"{number.name}: {text.lower()}": _play_signal(number, text, t)
        for number, text, t in SIGNALS
    },
}
"""Faults that need real processes and ports: functions that return the end and its problems."""
