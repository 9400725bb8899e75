"""Learning curve: duration of the training episodes, and survival of the greedy policies."""

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from equipoise.control.policy import TabularPolicy
from equipoise.report.style import BLUE, GREY, INK, ORANGE, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]

MAX_MEANS = 100
"""Approximate maximum number of plotted means of the episode duration."""


@styled()
def learning_curve(policy: TabularPolicy) -> "Figure":
    """Draw the learning curve of a policy, and the checkpoint that was kept.

    Args:
        policy: The policy, with the curve and the finalists of its selection.
    """
    curve, settings = policy.learning_curve, policy.settings
    tried = [point for point in curve if point.survival is not None]
    figure = new_figure(4.2 if tried else 2.4, "Learning curve")
    axes: Any = figure.subplots(2 if tried else 1, 1, sharex=True, squeeze=False)[:, 0]
    axes[0].stairs(*_mean_duration(policy), baseline=None, color=INK, linewidth=1.1)
    axes[0].set_ylabel("mean duration [s]")
    axes[0].set_ylim(0.0, 1.05 * settings.learning.episode_duration)
    limit = f"{settings.learning.episode_duration:g} s"
    axes[0].set_title(f"training episodes, truncated after {limit}")
    if tried:
        selection, panel = settings.selection, axes[1]
        episodes = [point.episodes for point in tried]
        percent = [100.0 * (point.survival or 0.0) for point in tried]
        panel.plot(episodes, percent, color=BLUE, linewidth=0.8, label="each candidate")
        panel.set_ylabel("trials that lasted [%]")
        panel.set_ylim(-4.0, 107.0)
        panel.set_title(
            f"greedy policy at each checkpoint, {selection.screening_trials} trials of "
            f"{selection.duration:g} s, {selection.spread:g} times the variation of the training"
        )
        _finalists(panel, policy)
    axes[-1].set_xlabel("episodes")
    axes[-1].set_xlim(0, policy.episodes)
    return figure


def _mean_duration(policy: TabularPolicy) -> tuple[Array, Array]:
    """Return the mean duration of the episodes [s] per interval, and the edges in episodes."""
    # Episodes run in parallel, and few of them end between two points: average over several.
    stride = max(1, len(policy.learning_curve) // MAX_MEANS)
    points = policy.learning_curve[stride - 1 :: stride]
    episodes = np.array([0, *(point.episodes for point in points)], dtype=np.float64)
    seconds = policy.h * np.array([0, *(point.steps for point in points)])
    return np.diff(seconds) / np.diff(episodes), episodes


def _finalists(panel: Any, policy: TabularPolicy) -> None:
    survival = {point.episodes: point.survival for point in policy.learning_curve}

    def place(*numbers: int) -> tuple[list[int], list[float]]:
        return list(numbers), [100.0 * (survival.get(n) or 0.0) for n in numbers]

    chosen, *others = (candidate.episodes for candidate in policy.checkpoints)
    panel.plot(*place(*others), "o", color=GREY, markersize=3.5, label="finalist")
    diamond: Any = {"marker": "D", "markeredgecolor": INK, "markersize": 7, "clip_on": False}
    label = f"kept: episode {chosen:,}"
    panel.plot(*place(chosen), color=ORANGE, linestyle="", label=label, **diamond)
    panel.figure.legend(loc="outside lower center", ncols=3)
