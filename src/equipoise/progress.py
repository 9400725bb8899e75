"""Progress of a command's stages."""

from collections.abc import Callable
from threading import Lock

from equipoise.control.policy import LearningPoint
from equipoise.learning.train import TrainingObserver
from equipoise.settings import Settings

Show = Callable[[str, float | None, str], None]
"""Callback for the progress of a stage, also from other threads: its name, the completed share from
0 to 1 (None while it is unknown), and its state in a few words."""


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
            show(stage, min(completed / total, 1.0), f"{completed:,} of {total:,} trials")

    return done


class TrainingProgress(TrainingObserver):
    """Progress of a training: each learner has stages for its episodes, its race and its test."""

    def __init__(self, settings: Settings, show: Show) -> None:
        """Create the observer of a training.

        Args:
            settings: Settings of the training.
            show: Called with the progress.
        """
        self._show, self._episodes = show, settings.learning.episodes

    def report(self, learner: int, point: LearningPoint) -> None:
        """Show a point of a learning curve."""
        text = f"{point.duration:.1f} s an episode"
        self._show(_stage("train", learner), point.episodes / self._episodes, text)

    def selecting(self, learner: int, done: int, of: int) -> None:
        """Show the trials of a race."""
        self._show(_stage("select", learner), done / of, f"{done:,} trials")

    def testing(self, learner: int, done: int, of: int) -> None:
        """Show the trials of a test."""
        self._show(_stage("test", learner), done / of, f"{done:,} trials")


def _stage(name: str, learner: int) -> str:
    return f"{name} {learner + 1}" if learner else name
