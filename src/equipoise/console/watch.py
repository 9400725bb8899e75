"""Observation of a run through its shared memory, and words to it.

Nothing here can delay the run: rows are read without taking them, and a word goes into a ring that
the run reads once per tick. One console at a time has that ring.
"""

import threading
import time
from math import inf, isfinite, nan
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from equipoise.arrays import Array
from equipoise.files import lock
from equipoise.log.recorder import (
    CONSOLE,
    LoggedEvent,
    is_alive,
    open_recorder,
    read_events,
    read_info,
)
from equipoise.outcomes import Phase
from equipoise.rig.processes import HEARTBEAT_TIMEOUT


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
        self.info = read_info(folder)
        """Description of the run."""
        self.time = nan
        """Time of the last tick [s]; NaN before the first."""
        self.silence = 0.0
        """Time since the last tick [s]; 0 while the run does not tick."""
        self.phase: Phase | None = None
        """Phase; None before the first tick."""
        self.q: Array | None = None
        """Measured joints [rad], shape (joints,); None while unknown or too old."""
        self.phi, self.u = nan, 0.0
        """Angle of the pendulum from upright [rad], NaN while unknown or too old, and
        commanded acceleration of the flange [m/s^2], 0 while no policy acts."""
        self.late = nan
        """Largest lateness of the new ticks [s]; NaN without any."""
        self.events: list[LoggedEvent] = []
        """New events, the oldest first."""
        self.question: LoggedEvent | None = None
        """Question that the run asks now."""
        self.ended = False
        """Whether the process of the run has ended."""
        self._folder = folder
        self._console = (folder / CONSOLE).open("r+b")
        if not lock(self._console):
            self._console.close()
            raise BlockingIOError("another console is attached to this run")
        self._recorder = open_recorder(folder, len(self.info.arm.joints))
        self._seen: dict[str, int] = {}
        self._measured = self._sampled = -inf  # times of the newest posture and encoder sample [s]
        self._speaking = threading.Lock()

    def observe(self) -> None:
        """Read the state of the run, and what is new since the last observation."""
        # Before the rows, so that the last ones are read.
        self.ended, now = not is_alive(self._folder), time.monotonic()
        ticks, replies, samples = self._new("tick"), self._new("reply"), self._new("encoder")
        self.events, self.question = read_events(self._new("event")), self._recorder.question()
        pulse = self._recorder.pulse
        self.silence = now - float(pulse["time"]) if pulse["ticks"] > 0 else 0.0
        measured = replies[np.isfinite(replies["q"]).all(axis=1)]
        if len(measured):
            self._measured, self.q = float(measured["time"][-1]), measured["q"][-1]
        if len(samples):
            self._sampled = float(samples["received"][-1])
        self.late = float(np.max(ticks["late"])) if len(ticks) else nan
        if len(ticks):
            last, phases = ticks[-1], self.info.phases
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
        self._console.close()

    def _new(self, table: str) -> npt.NDArray[Any]:
        rows, self._seen[table] = self._recorder.rings[table].peek(self._seen.get(table, 0))
        return rows
