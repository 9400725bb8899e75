"""Live console of runs: the rig in 3-D, plots, messages, questions and their buttons.

All browsers see the same, and each can answer and stop the run. The console is a process of its
own: it finds runs on this computer, and shows one after the other. It cannot delay a run: rows of
the shared memory are read without taking them, and a word goes into a ring that the run reads once
per tick. One console at a time has that ring.
"""

import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import closing, suppress
from importlib import resources
from math import degrees, inf, isfinite, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from equipoise.arrays import Array
from equipoise.console.scene import PERIOD, PLOTS, SPAN, RigPage, card, messages_list, shown
from equipoise.console.web import serving
from equipoise.control.ticks import OK, OperatorMessage
from equipoise.files import lock
from equipoise.log.recorder import ENDED, is_alive, live_runs, open_recorder, read_events
from equipoise.outcomes import Phase
from equipoise.report.style import BLUE, GREEN, GREY, INK, ORANGE, VERMILION
from equipoise.rig.processes import HEARTBEAT_TIMEOUT

if TYPE_CHECKING:
    import viser

COLOURS: Final = {
    **{Phase.BALANCING: GREEN, Phase.ARMED: GREEN, Phase.STOPPING: VERMILION},
    **{"fault": VERMILION, "stopping": VERMILION, "warning": "#8a5a00"},
}
"""Colours of phases and of messages by the names of their events; others are blue and black."""


class RunWatch:
    """Observer of one run, with the ring for words to it; `observe` updates what it shows."""

    def __init__(self, folder: Path) -> None:
        """Attach to a run.

        Args:
            folder: Folder of the run, from `equipoise.log.recorder.live_runs`.

        Raises:
            OSError: The run has ended.
            ValueError: The run is one of another version of Equipoise.
            BlockingIOError: Another console is attached to this run.
        """
        self.conditions, self._recorder = open_recorder(folder)
        """Conditions of the run, and its rings."""
        self.time = nan
        """Time of the last tick [s]; NaN before the first."""
        self.phase: Phase | None = None
        """Phase; None before the first tick."""
        self.q: Array | None = None
        """Measured joints [rad], shape (joints,); None while unknown or too old."""
        self.phi, self.u = nan, 0.0
        """Angle of the pendulum from upright [rad], NaN while unknown or too old, and
        commanded acceleration of the flange [m/s^2], 0 while no policy acts."""
        self.ended = False
        """Whether the process of the run has ended."""
        self._folder = folder
        self._memory = (folder / "memory").open("rb")
        if not lock(self._memory):
            self._memory.close()
            raise BlockingIOError("another console is attached to this run")
        self._seen: dict[str, int] = {}
        self._measured = self._sampled = -inf  # times of the newest posture and encoder sample [s]
        self._speaking = threading.Lock()

    def observe(self) -> None:
        """Read the state of the run, and what is new since the last observation."""
        self.ended = not is_alive(self._folder)  # before the rows, so that the last ones are read
        now, pulse = time.monotonic(), self._recorder.pulse
        self.silence = now - float(pulse["time"]) if pulse["ticks"] > 0 else 0.0
        """Time since the last tick [s]; 0 while the run does not tick."""
        self.question = self._recorder.question()
        """Question that the run asks now; None without one."""
        self.events = read_events(self._new("event"))
        """New events, the oldest first."""
        ticks, replies, samples = self._new("tick"), self._new("reply"), self._new("encoder")
        self.late = float(np.max(ticks["late"], initial=-inf))
        """Largest lateness of the new ticks [s]; minus infinity without any."""
        measured = replies[np.isfinite(replies["q"]).all(axis=1)]
        if len(measured):
            self._measured, self.q = float(measured["time"][-1]), measured["q"][-1]
        if len(samples):
            self._sampled = float(samples["received"][-1])
        if len(ticks):
            last, phases = ticks[-1], self.conditions.phases
            self.time, self.phi = float(last["time"]), float(last["estimated_phi"])
            self.u = float(last["u"]) if isfinite(last["u"]) else 0.0
            self.phase = phases[last["state"]] if 0 <= last["state"] < len(phases) else None
        if now - self._measured > HEARTBEAT_TIMEOUT:
            self.q = None
        if now - self._sampled > HEARTBEAT_TIMEOUT:
            self.phi = nan

    def say(self, word: str, question: float = 0.0) -> None:
        """Send a word to the run; any thread may call this.

        Args:
            word: `stop`, or an answer.
            question: Time of the question that it answers [s]; 0 for a stop.
        """
        with self._speaking:
            self._recorder.console.push(question=question, word=word.encode())

    def close(self) -> None:
        """Detach from the run."""
        self._memory.close()

    def _new(self, table: str) -> npt.NDArray[Any]:
        rows, self._seen[table] = self._recorder.rings[table].peek(self._seen.get(table, 0))
        return rows


class LivePage:
    """Content of all browsers."""

    def __init__(self, server: "viser.ViserServer") -> None:
        """Fill a server's page.

        Args:
            server: The viser server.
        """
        self._server = server
        self._watch: RunWatch | None = None
        self._question: OperatorMessage | None = None
        self._buttons: list[Any] = []
        self._page = RigPage(server, "Equipoise console", len(PLOTS))
        self._asked = server.gui.add_html("", order=10, visible=False)
        self._folder = server.gui.add_folder("Messages", order=60, visible=False)
        with self._folder:
            self._listed = server.gui.add_html("")
        self._page.describe(
            "waiting for a run",
            GREY,
            [
                "Start one on this computer: equipoise deploy --robot ADDRESS. It appears here.",
                "A run in virtual time does not appear: equipoise log show replays it.",
            ],
        )

    def begin(self, watch: RunWatch) -> None:
        """Show another run from its begin."""
        self._watch = watch
        self._page.show_arm(watch.conditions.arm)
        self._page.draw(np.zeros(0), np.zeros((len(PLOTS), 0)))
        self._history: deque[tuple[float, ...]] = deque(maxlen=round(SPAN / PERIOD))
        self._messages: deque[OperatorMessage] = deque(maxlen=40)
        self._began = self._ended = nan

    def show(self, run: RunWatch) -> None:
        """Show the state of the run."""
        with self._server.atomic():
            self._messages.extend(run.events)
            self._listed.content = messages_list(
                (event.text or event.name, COLOURS.get(event.name, INK)) for event in self._messages
            )
            self._folder.visible = bool(self._messages)
            x = self._page.show(run.q, run.phi, run.u)
            if isfinite(run.late):
                late = 1e3 * max(run.late, 0.0)
                self._history.append((run.time, degrees(run.phi), 1e3 * x, run.u, late))
                rows = np.array(self._history).T
                moment, phi, *others = rows[:, rows[0] >= run.time - SPAN]
                known = np.isfinite(phi)  # the newest one stays, the others are continuous
                phi[known] = np.unwrap(phi[known][::-1], period=360.0)[::-1]
                self._page.draw(moment - run.time, np.array([phi, *others]))
            if any(event.name == "run" for event in run.events):  # the next one of a series
                self._began = nan
            if run.phase is Phase.BALANCING:
                self._began = self._began if isfinite(self._began) else run.time
                self._ended = run.time
            self._describe(run)
            self._ask(run)

    def end(self) -> None:
        """Detach from a run that has ended; its last picture stays."""
        self._watch = None
        self._ask(None)

    def stop(self) -> str:
        """Send a stop to the run; return a text for the STOP button. Never blocks."""
        watch = self._watch
        if watch is None:
            return "no run to stop"
        watch.say("stop")
        return "stop sent"

    def _describe(self, run: RunWatch) -> None:
        """Show the state in words."""
        conditions = run.conditions
        title = f"{conditions.policy_name} on {conditions.world}"
        name, colour, lines = "before the motion", BLUE, [title]
        if run.phase is not None:
            name, colour = run.phase.value, COLOURS.get(run.phase, BLUE)
        lines += [event.text for event in self._messages if event.name == "run"][-1:]
        if isfinite(self._began):
            balanced = self._ended - self._began
            lines.append(f"balanced {balanced:.1f} s of {conditions.duration:g} s")
        if run.silence > HEARTBEAT_TIMEOUT:
            name, colour = "the loop does not answer", VERMILION
            lines.append(f"no tick for {run.silence:.2f} s; press the E-stop if the arm moves")
        if run.ended:
            name, colour = "ended", INK
            ends = [event.text for event in self._messages if event.name == ENDED]
            lines += ends or ["its process ended without a result"]
            lines.append("The next run appears here.")
        self._page.describe(name, colour, lines)

    def _ask(self, run: RunWatch | None) -> None:
        """Show the question of a run with its buttons; the run takes the first answer to it."""
        question = run and run.question
        if question == self._question:
            return
        self._question = question
        for button in self._buttons:
            button.remove()
        self._buttons, self._asked.visible = [], question is not None
        if run is None or question is None:
            return
        look = f"font-size:16px;font-weight:600;border-left:5px solid {ORANGE};background:#fff7e6"
        self._asked.content = card("question", shown(question.text), look)
        labels = {"y": "Yes", "n": "No", OK: "OK"}
        # A word that is typed to acknowledge a question has a denial as well.
        words = (*question.answers, "n") if question.name == "checklist" else question.answers
        for place, word in enumerate(words, start=11):
            label = labels.get(word, f"Yes: {word}")
            button = self._server.gui.add_button(label, order=float(place))
            button.on_click(lambda _, word=word: run.say(word, question.time))
            self._buttons.append(button)


def serve(
    address: str, port: int, ready: Callable[[str], None], stopped: Callable[[], bool]
) -> None:
    """Serve the console until stopped: it shows the newest run without a console to its end.

    Args:
        address: Address of this computer to listen on.
        port: Port; 0 selects a free one.
        ready: Receives the address of the page with its token.
        stopped: Returns whether to end; called for each picture.

    Raises:
        MissingExtraError: viser is not installed.
        OutsideError: The address or the port is not available.
    """
    stay_aside()
    actions: dict[str, Callable[[], str]] = {"/alive": lambda: "alive"}
    overlay = resources.files("equipoise.console").joinpath("overlay.html").read_bytes()
    with serving(address, port, actions=actions, overlay=overlay) as (server, url):
        page = LivePage(server)
        actions["/stop"] = page.stop
        ready(url)
        while not stopped():
            watch = _next_run()
            if watch is None:
                time.sleep(PERIOD)
                continue
            page.begin(watch)
            with closing(watch):
                while not (watch.ended or stopped()):
                    watch.observe()
                    page.show(watch)
                    time.sleep(PERIOD)
            page.end()


def _next_run() -> RunWatch | None:
    """Attach to the newest run without a console; None without one."""
    for folder in live_runs():
        with suppress(OSError, ValueError):
            return RunWatch(folder)
    return None


def stay_aside() -> None:
    """Give way to a loop: other cores than its own, the last one, and a low priority."""
    if sys.platform == "linux":
        os.nice(10)
        allowed = sorted(os.sched_getaffinity(0))
        if len(allowed) > 1:
            os.sched_setaffinity(0, set(allowed[:-1]))
