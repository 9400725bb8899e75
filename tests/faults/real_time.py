"""Faults of processes, ports and the machine's load, in real time.

An emulated rig serves a port and a pseudo-terminal in this process. `equipoise deploy` runs in
another process, as on a real rig. Its messages are read from its output, and the motion of the arm
from the simulated rig.
"""

import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from equipoise.errors import EquipoiseError
from equipoise.logs.run_log import RunLog
from equipoise.model.pendulum import shipped_pendulum
from equipoise.model.worlds import pendulum_on, read_world
from equipoise.rig.clocks import SystemClock
from equipoise.rig.config import RigSettings
from equipoise.robots.emulation import Emulation
from tests.faults import verdicts
from tests.faults.harness import WORLD

HOST = "127.0.0.1"
ARM = RigSettings().described_arm
TIMEOUT = 100.0
"""Timeout of a run [s]."""
ANSWERS = ((re.compile(r"Type (\w+)\."), None), (re.compile(r"y or n"), "y"))
"""Pattern of each prompt, and its answer; None if the first group of the match is the answer."""
ACTS = {
    "steady it with a finger": ("steady",),
    "hangs still": ("release", "press"),
    "Lift the pendulum": ("lift",),
    "Armed. Let go": ("release",),
    "Hold the pendulum upright again": ("lift",),
    "nudge it": ("release", "push"),
}
"""Acts of the operator's hand, by the prompt that asks for them."""


class LiveRun(NamedTuple):
    """Run of `equipoise deploy` on an emulated rig."""

    process: Any
    emulation: Emulation
    port: int  # of the robot
    log: Path
    lines: list[tuple[float, str]]  # its output: time [s] and line

    def wait_for(self, text, since=0.0):
        """Wait until the run prints a text, and return the time of its line [s]."""
        begin = time.monotonic()
        while (waited := time.monotonic() - begin) < TIMEOUT:
            for moment, line in list(self.lines):
                if text in line and moment >= since:
                    return moment
            if self.process.poll() is not None and waited > 1.0:
                break
            time.sleep(0.005)
        raise TimeoutError(f"the run did not print {text!r}; see the output of equipoise deploy")

    def exit_code(self):
        with suppress(subprocess.TimeoutExpired):
            return self.process.wait(TIMEOUT)

    def problems(self, *codes):
        """Return the problems of the end of a run that software stopped."""
        code = self.exit_code()
        if code is None:
            return ["the run did not end"]
        problems = [] if code in codes else [f"exit code {code}: {self.lines[-8:]}"]
        problems += self.motion()
        try:
            log = RunLog.load(self.log, damaged=True)
        except EquipoiseError as error:
            return [*problems, str(error)]
        stream = log.tables["stream"]
        sent = [verdicts.Sent(float(row["time"]), tuple(row["q"].tolist())) for row in stream]
        problems += verdicts.check_limits(ARM, sent)
        stops = [event.time for event in log.events if event.name in ("stopping", "fault")]
        if not stops:
            return [*problems, "no stop was logged"]
        return problems + verdicts.check_stop(ARM, sent, stops[0])

    def motion(self):
        """Return the problem of an arm that moves."""
        bench, postures = self.emulation.bench, []
        time.sleep(0.5)
        for _ in range(30):
            postures.append(bench.twin.kernel.bodies.qpos[: bench.joints].tolist())
            time.sleep(0.01)
        return verdicts.check_still(postures)

    def final_line(self):
        lines = [line.strip() for _, line in self.lines if line.strip()]
        return next((line for line in reversed(lines) if "ended" in line), "")


@contextmanager
def live_run():
    """Run `equipoise deploy` of the shipped policy in another process."""
    world, over = read_world(WORLD).settings, threading.Event()
    ports, acts, lines = [], deque(), []
    with tempfile.TemporaryDirectory(prefix="equipoise-") as folder:
        pendulum = pendulum_on(shipped_pendulum(), world)
        emulation = Emulation(ARM, pendulum, world, SystemClock())

        def stop():
            while acts:
                emulation.acts[acts.popleft()]()
            return over.is_set()

        def serve():
            _raise_priority()
            emulation.run(HOST, 0, stop, listening=ports.append)

        rig = threading.Thread(target=serve, daemon=True)
        _raise_priority()
        rig.start()
        while not ports:
            time.sleep(0.01)
        log = Path(folder) / "run.mcap"
        command = [
            *(sys.executable, "-m", "equipoise", "deploy", "--duration", "6", "--out", str(log)),
            *("--robot", f"kst://{HOST}:{ports[0]}"),
            *("--encoder", f"serial://{emulation.terminal.path}"),
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


def _raise_priority():
    """Give this thread real-time priority, if allowed: a real cabinet has its own computer.

    All threads that share the interpreter's lock need it, so that its holder is not preempted.
    """
    with suppress(OSError, AttributeError):
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(40))


def _answer_prompts(process, lines, acts):
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


def _play_signal(number, text, after):
    def play():
        with live_run() as run:
            run.wait_for(text)
            time.sleep(after)
            # Ctrl-C reaches each process of the terminal.
            send = os.killpg if number is signal.SIGINT else os.kill
            send(run.process.pid, number)
            problems = run.problems(130)
            return run.final_line(), problems

    return play


def _play_kill():
    with live_run() as run:
        run.wait_for("Balancing")
        time.sleep(1.0)
        # The loop is the process that talks to the robot.
        loop = next(
            child
            for child in psutil.Process(run.process.pid).children(recursive=True)
            for link in child.net_connections()
            if link.raddr and link.raddr.port == run.port
        )
        loop.kill()
        killed = time.monotonic()
        late = run.wait_for("software cannot stop", killed) - killed
        on_time = late <= verdicts.MAX_NOTICE
        problems = [] if on_time else [f"the warning came after {1e3 * late:.0f} ms"]
        if (code := run.exit_code()) != 3:
            problems.append(f"exit code {code}, expected 3")
        return f"warned after {1e3 * late:.0f} ms to press the E-stop", problems + run.motion()


SIGNALS = ((signal.SIGINT, "Moving to home", 0.4), (signal.SIGTERM, "Balancing", 1.5))
"""Signals that end a run, each with a line of its output and the time after it [s]."""
REAL_TIME = {
    "control process killed": _play_kill,
    **{f"{one[0].name}: {one[1].lower()}": _play_signal(*one) for one in SIGNALS},
}
"""Faults that need real processes and ports: functions that return the end and its problems."""
