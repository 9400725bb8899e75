"""Progress reports of a study's stages."""

import time
from collections.abc import Callable
from functools import partial
from threading import Lock
from typing import Any, NamedTuple

from equipoise.control.policy import LearningPoint, format_share
from equipoise.learning.checkpoint import LearnerResult
from equipoise.settings import Settings
from equipoise.training import TargetProgress


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


class TrainingProgress(TargetProgress):
    """Progress of a training to a target.

    The first learner has a stage each for its episodes, its race and its test; all further learners
    are one stage.
    """

    def __init__(self, settings: Settings, show: Show, learners: int = 1, of: str = "") -> None:
        """Begin with the episodes.

        Args:
            settings: Settings of the training.
            show: Called with the progress.
            learners: Maximum number of learners.
            of: Suffix of the stages' names, in a study with two trainings.
        """
        self._show, self._learners, self._of = show, learners, of
        self._episodes = settings.learning.episodes
        self._points: dict[int, LearningPoint] = {}
        self._results: dict[int, LearnerResult] = {}
        self._begin: tuple[float, int] | None = None
        self._lock = Lock()
        self.speed = 0.0
        """Control steps per second of all learners, since the first report."""
        show(self._stage("train", 0, self._episodes, "episodes"))

    def of_learner(self) -> dict[str, Any]:
        """Return the callbacks `report` and `selecting` of a training of one learner."""
        return {"report": partial(self.report, 0), "selecting": partial(self.selecting, 0)}

    def report(self, learner: int, point: LearningPoint) -> None:
        """Add a point of a learning curve."""
        with self._lock:
            self._points[learner] = point
            now, steps = time.perf_counter(), sum(p.steps for p in self._points.values())
            if self._begin is None:
                self._begin = now, steps
            elapsed = now - self._begin[0]
            self.speed = (steps - self._begin[1]) / elapsed if elapsed > 0.0 else 0.0
            text = f"{point.duration:.1f} s an episode"
            if learner == 0:
                stage = self._stage("train", point.episodes, self._episodes, "episodes")
                self._show(stage._replace(text=text))
            else:
                self._show_learners()

    def selecting(self, learner: int, done: int, of: int) -> None:
        """Show the trials of a race."""
        if learner == 0:
            self._show(self._stage("select", done, of, "trials"))
        else:
            self._show_learners()

    def testing(self, learner: int, done: int, of: int) -> None:
        """Show the trials of a test."""
        if learner == 0:
            self._show(self._stage("test", done, of, "trials"))
        else:
            self._show_learners()

    def finished(self, result: LearnerResult) -> None:
        """Count a tested learner."""
        with self._lock:
            self._results[result.learner] = result
            if result.learner > 0 or not result.test.met:
                self._show_learners()

    def _show_learners(self) -> None:
        """Show the learners after the first one, with the best share up to now."""
        if self._learners == 1:
            return
        results = self._results.values()
        met, total = any(result.test.met for result in results), self._learners - 1
        later = [n for n in self._points if n > 0]
        begun = sum(self._points[n].episodes for n in later if n not in self._results)
        done = sum(n > 0 for n in self._results) + 0.8 * begun / self._episodes
        best = max((result.test.interval[0] for result in results), default=0.0)
        text = f"best: {format_share(best)} or more"
        self._show(self._stage("retry", total if met else done, total, "learners", text))

    def _stage(
        self, name: str, completed: float, total: float, unit: str, text: str = ""
    ) -> ProgressReporter:
        return ProgressReporter(f"{name} {self._of}".strip(), completed, total, unit, text)
