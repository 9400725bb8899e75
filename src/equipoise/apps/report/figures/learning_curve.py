"""Learning curve: duration of the training episodes, and survival of the candidates."""

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from equipoise.apps.report.style import BLUE, INK, ORANGE, new_figure, styled
from equipoise.control.policy import TabularPolicy

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]

MAX_MEANS = 100
"""Approximate maximum number of plotted means of the episode duration."""
MAX_AREA = 30.0
"""Area of the mark of a candidate with as many trials as the winner [points^2]."""


@styled()
def learning_curve(policy: TabularPolicy) -> "Figure":
    """Draw the learning curve of a policy, and the candidates of its selection.

    Args:
        policy: The policy, with its learning curve and the results of its race.
    """
    tried, settings = policy.checkpoints, policy.settings
    figure = new_figure(4.2 if tried else 2.4, "Learning curve")
    axes: Any = figure.subplots(2 if tried else 1, 1, sharex=True, squeeze=False)[:, 0]
    axes[0].stairs(*_mean_duration(policy), baseline=None, color=INK, linewidth=1.1)
    axes[0].set_ylabel("mean duration [s]")
    axes[0].set_ylim(0.0, 1.05 * settings.learning.episode_duration)
    limit = f"{settings.learning.episode_duration:g} s"
    axes[0].set_title(f"training episodes, truncated after {limit}")
    if tried:
        selection, panel = settings.selection, axes[1]
        panel.set_ylabel("trials that lasted [%]")
        panel.set_ylim(-4.0, 107.0)
        panel.set_title(
            f"candidates in trials of {selection.duration:g} s, {selection.spread:g} times the "
            "variation of the training"
        )
        _candidates(panel, policy)
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


def _candidates(panel: Any, policy: TabularPolicy) -> None:
    episodes = [candidate.episodes for candidate in policy.checkpoints]
    percent = [100.0 * candidate.survived / candidate.trials for candidate in policy.checkpoints]
    trials = np.array([candidate.trials for candidate in policy.checkpoints])
    area = MAX_AREA * trials[1:] / trials[0]
    panel.scatter(episodes[1:], percent[1:], area, color=BLUE, linewidth=0, label="candidate")
    diamond: Any = {"marker": "D", "markeredgecolor": INK, "markersize": 7, "clip_on": False}
    label = f"kept: episode {episodes[0]:,}"
    panel.plot(episodes[:1], percent[:1], color=ORANGE, linestyle="", label=label, **diamond)
    panel.figure.legend(loc="outside lower center", ncols=2)
