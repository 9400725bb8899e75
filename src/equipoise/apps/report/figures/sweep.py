"""Trials of a sweep: the objective against each parameter, and its best value up to each trial."""

import json
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from equipoise.apps.report import style
from equipoise.studies.sweep_results import Sweep

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LABELS: Final = {"survival": "share of tests that last", "duration": "mean duration of a test [s]"}
COLUMNS: Final = 2
"""Number of panels side by side."""
LONGEST_LABEL: Final = 24
"""Length limit of the label of a choice [characters]; a longer one is its number in the study."""


@style.styled()
def sweep_figure(found: Sweep) -> "Figure":
    """Draw the trials of a sweep, the best one marked."""
    study, ranking = found.study, found.ranking
    names = list(study.ranges)
    rows = -(-(1 + len(names)) // COLUMNS)
    count = f"{len(found.trials)} trials, world {study.world}"
    figure = style.new_figure(0.6 + 2.4 * rows, f"Sweep: {count}")
    panels: list[Any] = list(figure.subplots(rows, COLUMNS, sharey=True, squeeze=False).flat)
    history, *others = panels
    index = [trial.index for trial in sorted(ranking, key=lambda trial: trial.index)]
    value = [found.value(found.trials[i]) for i in index]
    history.scatter(index, value, s=12, color=style.BLUE, label="trial")
    history.step(
        index, np.maximum.accumulate(value), where="post", color=style.INK, label="best so far"
    )
    history.set_xlabel("trial")
    history.legend(loc="lower right")
    for panel, name in zip(others, names, strict=False):
        _parameter(panel, found, name)
    for panel in others[len(names) :]:
        panel.set_visible(False)
    for panel in panels[::COLUMNS]:
        panel.set_ylabel(LABELS[study.objective])
    return figure


def _parameter(panel: Any, found: Sweep, name: str) -> None:
    parameter, ranking = found.study.ranges[name], found.ranking
    places: list[Any] = [trial.parameters[name] for trial in ranking]
    if (choices := parameter.choices) is not None:
        texts = [style.plain(json.dumps(choice)) for choice in choices]
        labels = [
            text if len(text) <= LONGEST_LABEL else f"choice {i}" for i, text in enumerate(texts, 1)
        ]
        panel.set_xticks(range(len(choices)), labels)
        places = [list(choices).index(place) for place in places]
    elif parameter.log:
        panel.set_xscale("log")
    values = [found.value(trial) for trial in ranking]
    panel.scatter(places, values, s=12, color=style.BLUE)
    panel.scatter(places[:1], values[:1], s=60, marker="x", color=style.VERMILION, zorder=3)
    panel.set_xlabel(style.plain(name))
