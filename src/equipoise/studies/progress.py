"""Progress: what the stages of a study report while they run, with an expected end for each."""

import time
from collections.abc import Callable
from threading import Lock
from typing import NamedTuple

from equipoise.control.policy import LearningPoint
from equipoise.settings import Settings


class ProgressReporter(NamedTuple):
    """State of one stage."""

    stage: str
    """Name of the stage."""
    completed: float = 0.0
    """Amount that is completed."""
    total: float = 1.0
    """The whole amount; a stage that has completed it is done."""
    unit: str = ""
    """Unit of these amounts, in the plural; empty for a share."""
    text: str = ""
    """State of the stage, in a few words."""
    expected: float | None = None
    """Expected duration [s], where the completed amount is not known before the end."""

    @property
    def share(self) -> float:
        """Share that is completed, 0 to 1."""
        return min(self.completed / self.total, 1.0)


Show = Callable[[ProgressReporter], None]
"""Called as the work goes on, also from other threads."""


def counted(stage: str, total: int, show: Show) -> Callable[[int], None]:
    """Return a callback that adds up finished trials.

    Args:
        stage: Name of the stage.
        total: Number of all trials.
        show: Called with the progress.
    """
    lock, so_far = Lock(), [0]

    def done(finished: int) -> None:
        with lock:
            so_far[0] += finished
            show(ProgressReporter(stage, min(so_far[0], total), total, "trials"))

    return done


class TrainingProgress:
    """Adds up the learners of a training: their episodes, and the trials of the final selection.

    Both can be under way at once, as one learner may finish its episodes before another.
    """

    def __init__(self, settings: Settings, learners: int, show: Show, of: str = "") -> None:
        """Begin with the episodes.

        Args:
            settings: Settings of the training.
            learners: Number of learners.
            show: Called with the progress.
            of: Word after the names of the stages, where a study trains twice.
        """
        selection = settings.selection
        self._show, self._learners = show, learners
        self._train, self._select = f"train {of}".strip(), f"select {of}".strip()
        self._episodes = learners * settings.learning.episodes
        self._trials = selection.finalists * selection.final_trials
        self._points: dict[int, LearningPoint] = {}
        self._finals: dict[int, tuple[int, int]] = {}
        self._begin: tuple[float, int] | None = None
        self._lock = Lock()
        self.speed = 0.0
        """Control steps per second of all learners, since the first report."""
        show(self.first)

    @property
    def first(self) -> ProgressReporter:
        """Progress of the training when it begins."""
        return ProgressReporter(self._train, 0, self._episodes, "episodes")

    def report(self, learner: int, point: LearningPoint) -> None:
        """Take in a point of a learning curve."""
        with self._lock:
            self._points[learner] = point
            points = list(self._points.values())
            now, steps = time.perf_counter(), sum(p.steps for p in points)
            if self._begin is None:
                self._begin = now, steps
            elapsed = now - self._begin[0]
            self.speed = (steps - self._begin[1]) / elapsed if elapsed > 0.0 else 0.0
            screened = [p.survival for p in points if p.survival is not None]
            text = (
                f"{100.0 * sum(screened) / len(screened):.0f} % stand"
                if screened
                else f"{sum(p.duration for p in points) / len(points):.1f} s an episode"
            )
            episodes = sum(p.episodes for p in points)
            self._show(self.first._replace(completed=episodes, text=text))

    def selecting(self, learner: int, done: int, of: int) -> None:
        """Take in the number of trials of a learner's final selection that are done, of all."""
        with self._lock:
            self._finals[learner] = done, of
            others = self._learners - len(self._finals)
            total = sum(of for _, of in self._finals.values()) + others * self._trials
            completed = sum(done for done, _ in self._finals.values())
            self._show(ProgressReporter(self._select, completed, total, "trials"))
