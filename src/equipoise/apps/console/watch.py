"""Observation of a run through its shared memory, and words to it.

Nothing here can delay the run: rows are read without taking them, and a word goes into a ring that
the run reads once per tick. One console at a time has that ring.
"""

import threading
import time
from math import isfinite, nan
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.logs import shared
from equipoise.logs.recorder import LoggedEvent, read_events
from equipoise.outcomes import Phase

Floats = npt.NDArray[np.float64]


class Observation(NamedTuple):
    """State of a run, and what is new since the last observation."""

    time: float
    """Time of the last tick [s]; NaN before the first."""
    silence: float
    """Time since the last tick [s]; 0 while the run does not tick."""
    phase: Phase | None
    """Phase; None before the first tick."""
    q: Floats | None
    """Measured joints [rad], shape (joints,); None while unknown."""
    phi: float
    """Angle of the pendulum from upright [rad]; NaN while unknown."""
    u: float
    """Commanded acceleration of the flange [m/s^2]; 0 while no policy acts."""
    late: float
    """Largest lateness of the new ticks [s]; NaN without any."""
    events: list[LoggedEvent]
    """New events, the oldest first."""
    question: LoggedEvent | None
    """Question that the run asks now."""
    ended: bool
    """Whether the process of the run has ended."""


class RunWatch:
    """Observer of one run, with the ring for words to it."""

    def __init__(self, folder: Path) -> None:
        """Attach to a run.

        Args:
            folder: Folder of the run, from `equipoise.logs.shared.live_runs`.

        Raises:
            OSError: The run has ended.
            ValueError: The run is one of another version of Equipoise.
            BlockingIOError: Another console is attached to this run.
        """
        self.info = shared.read_info(folder)
        """Description of the run."""
        self._folder = folder
        self._console = (folder / shared.CONSOLE).open("r+b")
        if not shared.lock(self._console):
            self._console.close()
            raise BlockingIOError("another console is attached to this run")
        self._recorder = shared.open_recorder(folder, len(self.info.arm.joints))
        self._seen: dict[str, int] = {}
        self._q: Floats | None = None
        self._speaking = threading.Lock()
        self._last: Any = None

    def observe(self) -> Observation:
        """Return the state of the run now."""
        ended = not shared.is_alive(self._folder)  # before the rows, so that the last ones are read
        recorder = self._recorder
        ticks, replies = self._new("tick"), self._new("reply")
        measured = replies["q"][np.isfinite(replies["q"]).all(axis=1)]
        if len(measured):
            self._q = measured[-1]
        if len(ticks):
            self._last = ticks[-1]
        last, streams = self._last, recorder.pulse["ticks"] > 0
        silence = time.monotonic() - float(recorder.pulse["time"]) if streams else 0.0
        question, events = recorder.question(), read_events(self._new("event"))
        if last is None:
            return Observation(
                *(nan, silence, None, self._q, nan, 0.0, nan, events, question, ended)
            )
        phases, state = self.info.phases, int(last["state"])
        return Observation(
            time=float(last["time"]),
            silence=silence,
            phase=phases[state] if 0 <= state < len(phases) else None,
            q=self._q,
            phi=float(last["estimated_phi"]),
            u=float(last["u"]) if isfinite(last["u"]) else 0.0,
            late=float(np.max(ticks["late"])) if len(ticks) else nan,
            events=events,
            question=question,
            ended=ended,
        )

    def say(self, word: str, question: float = 0.0) -> None:
        """Send a word to the run; any thread may call this.

        Args:
            word: `stop`, or an answer.
            question: Time of the question that it answers [s]; 0 for a stop.
        """
        with self._speaking:
            self._recorder.console.push(question, word.encode()[:64])

    def close(self) -> None:
        """Detach from the run."""
        self._console.close()

    def _new(self, table: str) -> npt.NDArray[Any]:
        rows, self._seen[table] = self._recorder.rings[table].peek(self._seen.get(table, 0))
        return rows
