"""Progress reports of a study's stages."""

import time
from collections.abc import Callable
from functools import partial
from statistics import fmean
from threading import Lock
from typing import Any, NamedTuple

from equipoise.control.policy import LearningPoint
from equipoise.settings import Settings


class ProgressReporter(NamedTuple):
    """State of one stage."""

    stage: str
    """Name of the stage."""
    completed: float = 0.0
    """Completed amount."""
    total: float = 1.0
    """Total amount; a stage is done when it has completed the total."""
    unit: str = ""
    """Unit of both amounts, in the plural; empty for a share."""
    text: str = ""
    """State of the stage, in a few words."""
    expected: float = 0.0
    """Expected duration of a stage without intermediate amounts [s]; 0 if unknown."""

    @property
    def share(self) -> float:
        """Completed share, 0 to 1."""
        return min(self.completed / self.total, 1.0)


Show = Callable[[ProgressReporter], None]
"""Callback for progress, also from other threads."""


def counted(stage: str, total: int, show: Show) -> Callable[[int], None]:
    """Return a callback that counts finished trials.

    Args:
        stage: Name of the stage.
        total: Number of all trials.
        show: Called with the progress.
    """
    lock, completed = Lock(), 0

    def done(finished: int) -> None:
        nonlocal completed
        with lock:
            completed += finished
            show(ProgressReporter(stage, min(completed, total), total, "trials"))

    return done


class TrainingProgress:
    """Sum of the learners' progress: episodes, and trials of the final selection.

    Both may run at once, since one learner may finish its episodes before another.
    """

    def __init__(self, settings: Settings, learners: int, show: Show, of: str = "") -> None:
        """Begin with the episodes.

        Args:
            settings: Settings of the training.
            learners: Number of learners.
            show: Called with the progress.
            of: Suffix of the stages' names, in a study with two trainings.
        """
        selection = settings.selection
        self._show, self._learners = show, learners
        self._select, episodes = f"select {of}".strip(), learners * settings.learning.episodes
        self._first = ProgressReporter(f"train {of}".strip(), 0, episodes, "episodes")
        self._trials = selection.finalists * selection.final_trials
        self._points: dict[int, LearningPoint] = {}
        self._finals: dict[int, tuple[int, int]] = {}
        self._begin: tuple[float, int] | None = None
        self._lock = Lock()
        self.speed = 0.0
        """Control steps per second of all learners, since the first report."""
        show(self._first)

    def of_learner(self, learner: int = 0) -> dict[str, Any]:
        """Return the callbacks `report` and `selecting` of a training with one learner."""
        report, selecting = partial(self.report, learner), partial(self.selecting, learner)
        return {"report": report, "selecting": selecting}

    def report(self, learner: int, point: LearningPoint) -> None:
        """Add a point of a learning curve."""
        with self._lock:
            self._points[learner] = point
            points = list(self._points.values())
            now, steps = time.perf_counter(), sum(p.steps for p in points)
            if self._begin is None:
                self._begin = now, steps
            elapsed = now - self._begin[0]
            self.speed = (steps - self._begin[1]) / elapsed if elapsed > 0.0 else 0.0
            screened = [p.survival for p in points if p.survival is not None]
            text = f"{fmean(p.duration for p in points):.1f} s an episode"
            if screened:
                text = f"{100.0 * fmean(screened):.0f} % stand"
            episodes = sum(p.episodes for p in points)
            self._show(self._first._replace(completed=episodes, text=text))

    def selecting(self, learner: int, done: int, of: int) -> None:
        """Add the finished and the total number of trials of a learner's final selection."""
        with self._lock:
            self._finals[learner] = done, of
            others = self._learners - len(self._finals)
            total = sum(of for _, of in self._finals.values()) + others * self._trials
            completed = sum(done for done, _ in self._finals.values())
            self._show(ProgressReporter(self._select, completed, total, "trials"))
