"""Survival curves of the policy and the baselines."""

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.apps.report import style
from equipoise.apps.report.style import new_figure, plain, styled
from equipoise.outcomes import Outcome
from equipoise.worlds.evaluation import Evaluation, TrialResults

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LINES: tuple[dict[str, Any], ...] = (
    {"color": style.BLUE, "linewidth": 3.2, "linestyle": "-"},
    {"color": style.INK, "linewidth": 1.3, "linestyle": style.DASHES},
    {"color": style.ORANGE, "linewidth": 1.6, "linestyle": style.DOTS},
    {"color": style.VERMILION, "linewidth": 1.3, "linestyle": style.DASH_DOTS},
    {"color": style.GREEN, "linewidth": 1.0, "linestyle": "-"},
    {"color": style.PURPLE, "linewidth": 1.3, "linestyle": (0, (3, 1, 1, 1, 1, 1))},
)
"""Line styles; the policy's line, the first, is wide, so that lines on top leave it visible."""


@styled()
def survival(evaluation: Evaluation) -> "Figure":
    """Draw survival against time, and the final survival rates with their intervals.

    Args:
        evaluation: Trials of a policy, and of the baselines under the same conditions.
    """
    all_results = [evaluation.results, *evaluation.baselines]
    figure = new_figure(3.6, "Survival of the policy and the baselines")
    axes: Any = figure.subplots(1, 2, width_ratios=(5, 3))
    left, right = axes
    shortest = min(min(results.survival) for results in all_results)
    for results, line in zip(all_results, LINES, strict=False):
        curve = _curve(results, shortest, evaluation.duration)
        left.plot(*curve, drawstyle="steps-post", label=plain(results.name), **line)
    left.set_xscale("log")
    begin, end = left.set_xlim(0.8 * shortest, evaluation.duration)
    ticks = [t for t in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60) if begin <= t <= end]
    left.set_xticks(ticks, [f"{t:g}" for t in ticks])
    left.minorticks_off()
    left.set_ylim(-4.0, 104.0)
    left.set_xlabel("time since the release [s]")
    left.set_ylabel("trials still standing [%]")
    left.set_title(f"{len(evaluation.results.survival)} trials each, the same conditions for all")
    label = f"the paper's run on the real arm, {paper.SECONDS_BALANCED:g} s"
    grey: Any = {"color": style.GREY, "linewidth": 1.4, "zorder": 0.9}
    left.axvline(paper.SECONDS_BALANCED, label=label, **grey)
    _shares(right, all_results, evaluation.duration)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def _curve(
    results: TrialResults, shortest: float, duration: float
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the times [s] and the share of trials that stand from each time on [%]."""
    trials = zip(results.survival, results.outcomes, strict=True)
    falls = np.sort([survival for survival, cause in trials if cause != Outcome.LASTED])
    standing = 100.0 * (1.0 - np.arange(len(falls) + 1) / len(results.survival))
    time = np.concatenate(([0.5 * shortest], falls, [duration]))
    return time, np.append(standing, standing[-1])


def _shares(panel: Any, all_results: list[TrialResults], duration: float) -> None:
    for row, (results, line) in enumerate(zip(all_results, LINES, strict=False)):
        summary = results.summary()
        rate, (low, high) = 100.0 * summary.rate, (100.0 * end for end in summary.interval)
        colour = line["color"]
        panel.plot([low, high], [row, row], color=colour, linewidth=2.2, solid_capstyle="butt")
        panel.plot(rate, row, "o", color=colour, markeredgecolor=style.INK, markersize=5.5)
        text, middle = f"{rate:.3g} %  [{low:.3g}, {high:.3g}]", (0.5 * (low + high), row)
        look: Any = {"ha": "left" if rate < 50.0 else "right", "fontsize": 7.5}
        panel.annotate(text, middle, (0, 6), textcoords="offset points", **look)
    panel.set_yticks(range(len(all_results)), [plain(results.name) for results in all_results])
    panel.set_ylim(len(all_results) - 0.5, -0.7)
    panel.set_xlim(-4.0, 104.0)
    panel.grid(visible=False, axis="y")
    panel.set_xlabel("share [%] with 95 % interval")
    panel.set_title(f"lasted {duration:g} s")
