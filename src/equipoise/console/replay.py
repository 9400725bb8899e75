"""Replay of a run's log: 3-D view, plots, a time line, and events to jump to.

All browsers see the same position, and each may move it.
"""

import time
from collections.abc import Callable
from math import isfinite
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from equipoise.console.scene import PERIOD, SPAN, RigPage
from equipoise.log.motion import Motion
from equipoise.log.run_log import RunLog
from equipoise.printable import printable
from equipoise.report.style import BLUE, typeset
from equipoise.rig.explanation import explain

if TYPE_CHECKING:
    import viser

SPEEDS: Final = {"0.1×": 0.1, "0.25×": 0.25, "0.5×": 0.5, "1×": 1.0, "2×": 2.0, "4×": 4.0}
"""Speeds of a replay, by their labels [-]."""


def marks_of(run: RunLog, motion: Motion) -> list[tuple[float, str]]:
    """Return times [s] and names of causes of the end, changes of the phase, warnings and faults.

    They are in the order of time.
    """
    first, last = float(motion.time[0]), motion.end
    marks = [
        (last if cause.time is None else cause.time, f"{cause.cause} (a cause of the end)")
        for cause in explain(run)
    ]
    marks += [
        (event.time - motion.began, f"{event.name}: {event.text}")
        for event in run.events
        if event.name in ("warning", "fault", "failed")
    ]
    phases = motion.phases
    changes = [i for i, phase in enumerate(phases) if i == 0 or phase != phases[i - 1]]
    marks += [(float(motion.time[i]), phases[i]) for i in changes]
    inside = [(min(max(time, first), last), name) for time, name in marks if isfinite(time)]
    return sorted(inside, key=lambda mark: mark[0])


class ReplayPage:
    """Content of all browsers, and the position in the run."""

    def __init__(self, server: "viser.ViserServer", run: RunLog, title: str) -> None:
        """Fill a server's page; it plays from the first browser on, while `play` is called.

        Args:
            server: The viser server.
            run: The run.
            title: Name of the log.

        Raises:
            RecordingError: The log has nothing to show.
        """
        self._server, self._run, self._title = server, run, title
        self._motion = motion = Motion.of(run)
        self.time = motion.part()[0]
        """Position [s]; at first shortly before the release."""
        self.playing = False
        """Whether the position moves by itself."""
        rows = [np.degrees(motion.phi), 1e3 * motion.x, motion.u]
        rows += [1e3 * np.maximum(motion.late, 0.0)] if np.isfinite(motion.late).any() else []
        self._rows = np.array(rows)
        self._page = RigPage(server, "Replay of a run", len(rows))
        self._page.show_arm(run.conditions.arm)
        gui, first = server.gui, round(float(motion.time[0]), 2)
        ends: Any = {"min": first, "max": max(round(motion.end, 2), first + 0.01), "step": 0.01}
        self._slider = gui.add_slider("time [s]", initial_value=first, order=41, **ends)
        user = self._page.on_user_event
        self._slider.on_update(user(lambda _: self.jump(self._slider.value)))
        self._button = gui.add_button("Play", color="blue", order=42)
        self._button.on_click(user(lambda _: self.toggle()))
        steps = gui.add_button_group("step", ("−1 tick", "+1 tick"), order=43)
        steps.on_click(user(lambda _: self.step(1 if "+" in steps.value else -1)))
        self._speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1×", order=44)
        marks = {
            f"{n}  {typeset(f'{time:+.2f}')} s  {printable(name)}": time
            for n, (time, name) in enumerate(marks_of(run, motion), start=1)
        }
        events = gui.add_dropdown("event", tuple(marks), order=45)
        events.on_update(user(lambda _: self.jump(marks[events.value])))
        server.on_client_connect(user(lambda _: self.begin()))
        self.show()

    def begin(self) -> None:
        """Play, unless a browser has already moved the position."""
        self.playing = self.playing or self.time == self._motion.part()[0]
        self.show()

    def toggle(self) -> None:
        """Play or pause; play from the start if the position is at the end."""
        if not self.playing and self.time >= self._motion.end:
            self.time = float(self._motion.time[0])
        self.playing = not self.playing
        self.show()

    def step(self, ticks: int) -> None:
        """Pause, and move by a number of ticks from the start of the one at the position."""
        times = self._motion.time
        now = int(np.searchsorted(times, self.time + 1e-9, side="right")) - 1
        self.jump(float(times[min(max(now + ticks, 0), len(times) - 1)]))

    def jump(self, time: float) -> None:
        """Pause, and move to a time, at most to the ends of the run [s]."""
        self.playing = False
        self.time = min(max(time, float(self._motion.time[0])), self._motion.end)
        self.show()

    def advance(self, elapsed: float) -> None:
        """Move the position while playing, after a real time [s]; pause at the end."""
        if self.playing:
            moved = self.time + SPEEDS[self._speed.value] * elapsed
            self.time = min(moved, self._motion.end)
            self.playing = self.time < self._motion.end
            self.show()

    def play(self, stopped: Callable[[], bool]) -> None:
        """Move the position in real time, and show the run, until stopped."""
        last = time.monotonic()
        while not stopped():
            time.sleep(PERIOD)
            now = time.monotonic()
            with self._page.lock:
                self.advance(now - last)
            last = now

    def show(self) -> None:
        """Show the run at the position."""
        run, conditions = self._run, self._run.conditions
        now = self._motion.at(self.time)
        late = f", late by {1e3 * max(now.late, 0.0):.2f} ms" if isfinite(now.late) else ""
        lines = (
            typeset(f"t = {self.time:.3f} s, u = {now.u:+.2f} m/s²{late}"),
            f"{self._title}: {conditions.arm.name}, {conditions.world}; ended: {run.outcome}",
            run.damage,
        )
        with self._server.atomic():
            self._page.show(now.q, now.phi, now.u)
            self._page.describe(now.phase, BLUE, lines)
            self._slider.value = round(self.time, 2)
            begin, end = np.searchsorted(self._motion.time, (self.time - SPAN, self.time + 1e-9))
            self._page.draw(self._motion.time[begin:end], self._rows[:, begin:end])
            self._button.label = "Pause" if self.playing else "Play"
