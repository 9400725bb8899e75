"""Progress reports of a study's stages."""

import time
from collections.abc import Callable
from threading import Lock
from typing import Final, NamedTuple

from equipoise.control.policy import LearningPoint, format_share
from equipoise.learning.target import LearnerResult, TargetObserver
from equipoise.settings import Settings

LEARNING_SHARE: Final = 0.7
"""Share of the episodes in the time of a learner; the rest are the trials of its race and test."""


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


class TrainingProgress(TargetObserver):
    """Progress of a training to a target.

    The first learner has a stage each for its episodes, its race and its test; all further learners
    are one stage.
    """

    def __init__(
        self,
        settings: Settings,
        show: Show,
        learners: int = 1,
        *,
        of: str = "",
    ) -> None:
        """Begin with the episodes.

        Args:
            settings: Settings of the training.
            show: Called with the progress.
            learners: Maximum number of learners.
            of: Suffix of the stages' names, in a study with two trainings.
        """
        self._show, self._of = show, of
        self._learners = learners - 1
        self._episodes, self._steps = settings.learning.episodes, 0
        self._points: dict[int, LearningPoint] = {}
        self._finished, self._best = 0, 0.0
        self._begin: tuple[float, int] | None = None
        self._lock = Lock()
        self.speed = 0.0
        """Control steps per second of all learners, since the first report."""
        show(self._stage("train", 0, self._episodes, "episodes"))

    def report(self, learner: int, point: LearningPoint) -> None:
        """Add a point of a learning curve."""
        with self._lock:
            self._points[learner] = point
            now = time.perf_counter()
            steps = self._steps + sum(p.steps for p in self._points.values())
            if self._begin is None:
                self._begin = now, steps
            elapsed = now - self._begin[0]
            self.speed = (steps - self._begin[1]) / elapsed if elapsed > 0.0 else 0.0
            if self._is_single(learner):
                stage = self._stage("train", point.episodes, self._episodes, "episodes")
                self._show(stage._replace(text=f"{point.duration:.1f} s an episode"))
            else:
                self._show_learners()

    def selecting(self, learner: int, done: int, of: int) -> None:
        """Show the trials of a race."""
        with self._lock:
            if self._is_single(learner):
                self._show(self._stage("select", done, of, "trials"))
            else:
                self._show_learners()

    def testing(self, learner: int, done: int, of: int) -> None:
        """Show the trials of a test."""
        with self._lock:
            if self._is_single(learner):
                self._show(self._stage("test", done, of, "trials"))
            else:
                self._show_learners()

    def finished(self, result: LearnerResult) -> None:
        """Count a tested learner."""
        with self._lock:
            self._points.pop(result.learner, None)
            self._steps += result.steps
            self._finished += not self._is_single(result.learner)
            self._best = max(self._best, result.test.interval[0])
            if self._learners and not (self._is_single(result.learner) and result.test.met):
                self._show_learners()

    def ended(self) -> None:
        """End the common stage, with the number of learners that were needed."""
        with self._lock:
            if self._finished:
                total = self._finished
                self._show(self._stage("learners", total, total, "learners"))

    def _is_single(self, learner: int) -> bool:
        return learner == 0

    def _show_learners(self) -> None:
        """Show the learners of the common stage, with the best share up to now."""
        begun = sum(p.episodes for n, p in self._points.items() if not self._is_single(n))
        done = self._finished + LEARNING_SHARE * begun / self._episodes
        done = min(done, self._learners - 0.01)
        text = f"best share {format_share(self._best)} or more"
        self._show(self._stage("learners", done, self._learners, "learners")._replace(text=text))

    def _stage(self, name: str, completed: float, total: float, unit: str) -> ProgressReporter:
        return ProgressReporter(f"{name} {self._of}".strip(), completed, total, unit)
