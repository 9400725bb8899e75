"""The course of a training: how long its episodes lasted, and what its greedy policies could do."""

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from equipoise.control.policy import TabularPolicy
from equipoise.report.style import BLUE, GREY, INK, ORANGE, drawn, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]

STRETCHES = 100
"""About so many means of the episodes' durations are drawn."""


@drawn
def learning_curve(policy: TabularPolicy) -> "Figure":
    """Draw the learning curve of a policy, and the moment at which it was taken.

    Args:
        policy: The policy, with the curve and the finalists of its selection.
    """
    curve, settings = policy.learning_curve, policy.settings
    tried = [point for point in curve if point.survival is not None]
    figure = new_figure(4.2 if tried else 2.4, "The course of the training")
    axes: Any = figure.subplots(2 if tried else 1, 1, sharex=True, squeeze=False)[:, 0]
    axes[0].stairs(*_mean_duration(policy), baseline=None, color=INK, linewidth=1.1)
    axes[0].set_ylabel("mean duration [s]")
    axes[0].set_ylim(0.0, 1.05 * settings.learning.episode_duration)
    axes[0].set_title(
        f"episodes while it learns, cut off after {settings.learning.episode_duration:g} s"
    )
    if tried:
        selection, panel = settings.selection, axes[1]
        percent = [100.0 * (p.survival or 0.0) for p in tried]
        panel.plot(
            [p.episodes for p in tried], percent, color=BLUE, linewidth=0.8, label="each candidate"
        )
        panel.set_ylabel("trials that lasted [%]")
        panel.set_ylim(-4.0, 107.0)
        panel.set_title(
            f"greedy policy of the moment, {selection.screening_trials} trials of "
            f"{selection.duration:g} s on plants that vary {selection.spread:g} times as much"
        )
        _finalists(panel, policy)
    axes[-1].set_xlabel("episodes")
    axes[-1].set_xlim(0, policy.episodes)
    return figure


def _mean_duration(policy: TabularPolicy) -> tuple[Array, Array]:
    """Return the mean duration of the episodes [s] in each stretch, and its ends in episodes."""
    # Not every point: episodes run side by side, and few of them end between two candidates.
    stride = max(1, len(policy.learning_curve) // STRETCHES)
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
    panel.plot(
        *place(chosen),
        "D",
        color=ORANGE,
        markeredgecolor=INK,
        markersize=7,
        clip_on=False,
        label=f"kept: episode {chosen:,}",
    )
    panel.figure.legend(loc="outside lower center", ncols=3)
