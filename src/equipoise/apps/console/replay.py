"""Replay of a run's log: 3-D view, gauges, plots, a time line, and events to jump to.

All browsers see the same position. Whatever a browser asks is done by the one thread of `play`.
"""

import time
from collections.abc import Callable
from functools import partial
from importlib import resources
from math import isfinite
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from equipoise.apps.console.gauges import note
from equipoise.apps.console.panel import RigPanel
from equipoise.apps.console.plots import Plots
from equipoise.apps.console.web import serving
from equipoise.apps.style import BLUE, typeset
from equipoise.logs.motion import Motion, Pose
from equipoise.logs.run_log import RunLog
from equipoise.printable import printable
from equipoise.rig.explanation import explain

if TYPE_CHECKING:
    import viser

PERIOD: Final = 0.04
"""Time between two pictures [s]."""
SPEEDS: Final = {"0.1×": 0.1, "0.25×": 0.25, "0.5×": 0.5, "1×": 1.0, "2×": 2.0, "4×": 4.0}
"""Speeds of a replay, by their labels [-]."""
STEPS: Final = {"start": None, "−1 tick": -1, "+1 tick": 1}
"""Ticks to step by, by the labels of their buttons."""
MARKED: Final = 4
"""Number of pictures between two motions of the dots in the plots."""
MAX_MARKS: Final = 60
"""Maximum number of events; causes come first."""


class Mark(NamedTuple):
    """An event to jump to."""

    time: float
    """Time [s]."""
    name: str
    """What happened, in a word or two."""
    text: str = ""
    """What happened, in a sentence."""
    cause: bool = False
    """Whether it is a cause of the end, as `equipoise log explain` names it."""


def marks_of(run: RunLog, motion: Motion) -> list[Mark]:
    """Return the causes of the end, the changes of the phase, warnings and faults, in time."""
    first, last = float(motion.time[0]), motion.end
    marks = [
        Mark(last if one.time is None else one.time, one.cause, one.evidence, cause=True)
        for one in explain(run)
    ]
    marks += [
        Mark(event.time - motion.began, event.name, event.text)
        for event in run.events
        if event.name in ("warning", "fault", "failed")
    ]
    phases = motion.phases or ("release",)
    changes = [i for i, phase in enumerate(phases) if i == 0 or phase != phases[i - 1]]
    marks += [Mark(float(motion.time[i]), phases[i]) for i in changes]
    marks = [mark for mark in marks if isfinite(mark.time)][:MAX_MARKS]
    inside = (mark._replace(time=min(max(mark.time, first), last)) for mark in marks)
    return sorted(inside, key=lambda mark: mark.time)


class Playback:
    """Position in a run that plays, pauses, steps and jumps."""

    def __init__(self, motion: Motion) -> None:
        """Begin shortly before the release, paused."""
        self._ticks, self.end = motion.time, motion.end
        self.time = motion.part()[0]
        """Position [s]."""
        self.speed = 1.0
        """Time of the run per real time [-]."""
        self.playing = False
        """Whether the position moves by itself."""

    def toggle(self) -> None:
        """Play or pause; play from the start if the position is at the end."""
        if not self.playing and self.time >= self.end:
            self.time = float(self._ticks[0])
        self.playing = not self.playing

    def advance(self, elapsed: float) -> None:
        """Move the position while playing, after a real time [s]; pause at the end."""
        if self.playing:
            self.time = min(self.time + self.speed * elapsed, self.end)
            self.playing = self.time < self.end

    def step(self, ticks: int) -> None:
        """Pause, and move by a number of ticks from the start of the one at the position."""
        now = int(np.searchsorted(self._ticks, self.time + 1e-9, side="right")) - 1
        self.jump(float(self._ticks[min(max(now + ticks, 0), len(self._ticks) - 1)]))

    def jump(self, time: float) -> None:
        """Pause, and move to a time, at most to the ends of the run [s]."""
        self.playing = False
        self.time = min(max(time, float(self._ticks[0])), self.end)


class ReplayPage:
    """Content of all browsers."""

    def __init__(self, server: "viser.ViserServer", run: RunLog, title: str) -> None:
        """Fill a server's page; nothing plays before `play` is called.

        Args:
            server: The viser server.
            run: The run.
            title: Name of the log.

        Raises:
            RecordingError: The log has nothing to show.
        """
        self._server, self._run, self._title = server, run, title
        self._motion = motion = Motion.of(run)
        self.playback = Playback(motion)
        """Position in the run."""
        self._asked: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._panel = RigPanel(server, "Replay of a run", run.conditions.arm)
        gui, first = server.gui, round(float(motion.time[0]), 2)
        ends: Any = {"min": first, "max": max(round(motion.end, 2), first + 0.01), "step": 0.01}
        self._slider = gui.add_slider("time [s]", initial_value=first, order=41, **ends)
        self._slider.on_update(self._asking(lambda: self.playback.jump(self._slider.value)))
        self._button = gui.add_button("Play", color="blue", hint="or the space bar", order=42)
        self._button.on_click(self._asking(self.playback.toggle))
        steps = gui.add_button_group("step", tuple(STEPS), hint="or the keys , and .", order=43)
        steps.on_click(lambda event: self.ask(event.target.value))
        self._speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1×", order=44)
        self._speed.on_update(self._asking(self._set_speed))
        tabs = gui.add_tab_group(order=50)
        with tabs.add_tab("Plots"):
            rows = [np.degrees(motion.phi), 1e3 * motion.x, motion.u]
            rows += [1e3 * np.maximum(motion.late, 0.0)] if motion.phases else []
            self._plots, self._pictures = Plots(gui, len(rows)), 0
            self._plots.draw(motion.time, np.array(rows))
        with tabs.add_tab("Events"):
            self._sentence = gui.add_html(note("Jump to an event:"))
            for mark in marks_of(run, motion):
                label = typeset(f"{mark.time:+.2f} s  ") + printable(mark.name)
                button = gui.add_button(label, color="red" if mark.cause else "gray")
                button.on_click(self._asking(partial(self._jump_to, mark)))
        self.show()

    def ask(self, name: str) -> None:
        """Do at the next picture what a key or button asks for: `toggle` or one of `STEPS`."""
        ticks = STEPS.get(name, 0)
        start = partial(self.playback.jump, float(self._motion.time[0]))
        step = start if ticks is None else partial(self.playback.step, ticks)
        self._asked.put(self.playback.toggle if name == "toggle" else step)

    def play(self, stopped: Callable[[], bool]) -> None:
        """Do what the browsers ask, and show the run, until stopped."""
        last = time.monotonic()
        while not stopped():
            changed = False
            try:
                while (left := last + PERIOD - time.monotonic()) > 0.0:
                    self._asked.get(timeout=left)()
                    changed = True
            except Empty:
                pass
            now = time.monotonic()
            if self.playback.playing or changed:
                self.playback.advance(now - last)
                self.show()
            last = now

    def show(self) -> None:
        """Show the run at the position."""
        now = self._motion.at(self.playback.time)
        with self._server.atomic():
            self._panel.show(now.q, now.phi, x=now.x, commanded=now.commanded, u=now.u)
            self._panel.say(now.phase or "simulation", BLUE, self._lines(now))
            self._slider.value = round(now.time, 2)
            if self._pictures % MARKED == 0 or not self.playback.playing:
                self._plots.mark(now.time)
            self._pictures += 1
            label = "Pause" if self.playback.playing else "Play"
            if self._button.label != label:
                self._button.label = label

    def _lines(self, now: Pose) -> tuple[str, ...]:
        run, conditions = self._run, self._run.conditions
        late = f", late by {1e3 * max(now.late, 0.0):.2f} ms" if isfinite(now.late) else ""
        return (
            typeset(f"t = {now.time:.3f} s, u = {now.u:+.2f} m/s²{late}"),
            f"{self._title}: {conditions.arm.name}, {conditions.world}; ended: {run.outcome}",
            run.damage,
        )

    def _asking(self, todo: Callable[[], None]) -> Callable[[Any], None]:
        """Return a callback that asks for `todo`, if a browser caused the event."""

        def callback(event: Any) -> None:
            if event.client_id is not None:
                self._asked.put(todo)

        return callback

    def _set_speed(self) -> None:
        self.playback.speed = SPEEDS[self._speed.value]

    def _jump_to(self, mark: Mark) -> None:
        self.playback.jump(mark.time)
        kind = " (a cause of the end)" if mark.cause else ""
        self._sentence.content = note(f"{mark.name}{kind}{': ' * bool(mark.text)}{mark.text}")


def show_run(
    run: RunLog,
    title: str,
    address: str,
    port: int,
    ready: Callable[[str], None],
    stopped: Callable[[], bool],
) -> None:
    """Serve the replay of a run until stopped.

    Args:
        run: The run.
        title: Name of the log.
        address: Address of this computer to listen on.
        port: Port; 0 selects a free one.
        ready: Receives the address of the page with its token.
        stopped: Returns whether to end; called for each picture.

    Raises:
        MissingExtraError: viser is not installed.
        InputError: The address is invalid.
        OutsideError: The port is not available.
        RecordingError: The log has nothing to show.
    """
    page: ReplayPage | None = None

    def ask(name: str) -> str:
        if page is not None:
            page.ask(name)
        return ""

    keys = {"/toggle": "toggle", "/back": "−1 tick", "/forward": "+1 tick"}
    actions = {path: partial(ask, name) for path, name in keys.items()}
    overlay = resources.files("equipoise.apps.console").joinpath("replay.html").read_bytes()
    with serving(address, port, actions=actions, overlay=overlay) as (server, url):
        page = ReplayPage(server, run, title)
        ready(url)
        page.play(stopped)
