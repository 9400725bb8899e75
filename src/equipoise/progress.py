"""Progress of a command's stages, and the compilation of kernels as a stage of its own."""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from threading import Lock
from typing import NamedTuple

from equipoise.control.bound_policy import bind_policy
from equipoise.control.policy import LearningPoint, TaskPolicy
from equipoise.jit import watching_compilation
from equipoise.learning.train import TrainingObserver, train
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import shipped_pendulum
from equipoise.model.worlds import MODEL, World
from equipoise.settings import Settings
from equipoise.worlds.evaluation import evaluate


class StageProgress(NamedTuple):
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

    @property
    def share(self) -> float:
        """Completed share, 0 to 1."""
        return min(self.completed / self.total, 1.0)


Show = Callable[[StageProgress], None]
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
            show(StageProgress(stage, min(completed, total), total, "trials"))

    return done


class TrainingProgress(TrainingObserver):
    """Progress of a training to a target: stages of episodes, race and test for each learner."""

    def __init__(self, settings: Settings, show: Show) -> None:
        """Begin with the episodes.

        Args:
            settings: Settings of the training.
            show: Called with the progress.
        """
        self._show, self._episodes = show, settings.learning.episodes
        show(StageProgress("train", 0, self._episodes, "episodes"))

    def report(self, learner: int, point: LearningPoint) -> None:
        """Show a point of a learning curve."""
        stage, text = _stage("train", learner), f"{point.duration:.1f} s an episode"
        self._show(StageProgress(stage, point.episodes, self._episodes, "episodes", text))

    def selecting(self, learner: int, done: int, of: int) -> None:
        """Show the trials of a race."""
        self._show(StageProgress(_stage("select", learner), done, of, "trials"))

    def testing(self, learner: int, done: int, of: int) -> None:
        """Show the trials of a test."""
        self._show(StageProgress(_stage("test", learner), done, of, "trials"))


def _stage(name: str, learner: int) -> str:
    return f"{name} {learner + 1}" if learner else name


@contextmanager
def compiling(show: Show, stage: str = "compile") -> Generator[None]:
    """Show the compilation in this context as a stage; kernels in the cache load within seconds.

    Args:
        show: Called with the progress.
        stage: Name of the stage.
    """
    count = 0

    def compiled() -> None:
        nonlocal count
        count += 1
        show(StageProgress(stage, text=f"{count} functions, once on this machine"))

    show(StageProgress(stage))
    with watching_compilation(compiled):
        yield
    text = f"{count} functions, once on this machine" if count else "done before, loaded"
    show(StageProgress(stage, 1.0, text=text))


def compile_training(arm: Arm, settings: Settings) -> None:
    """Compile the kernels of training and evaluation, for one arm."""
    tree = settings.model_dump()
    tree["learning"] |= {"episodes": 1, "episode_duration": 0.02}
    tree["selection"] |= {"every": 1, "rounds": 1, "duration": 0.02}
    tree["evaluation"] = {}
    train(shipped_pendulum(), arm, Settings.model_validate(tree))


def compile_trials(policy: TaskPolicy, world: str | World = MODEL) -> None:
    """Compile the kernels that run a policy in a world; a policy without a kernel is not called."""
    tree = policy.settings.model_dump()
    tree["evaluation"] |= {"trials": 1, "duration": 0.02}
    runs = policy if policy.kernel else bind_policy(lambda _: 0.0, arm=policy.arm)
    evaluate(runs, Settings.model_validate(tree), world=world, with_baselines=False)
