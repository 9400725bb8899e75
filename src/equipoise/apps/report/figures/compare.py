"""Comparison of policies: share of the trials that lasted, with its interval, in each world."""

from typing import TYPE_CHECKING, Any, Final

from equipoise.apps.report import style
from equipoise.artefacts import shortened
from equipoise.outcomes import Outcome
from equipoise.studies.compare_results import Cell, Comparison

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROW: Final = 0.24
"""Height of a policy [inch]."""
MARGIN: Final = 1.15
"""Height of titles and axes [inch]."""
WIDEST: Final = 18
"""Length limit of a line of a name [characters]."""
LOOKS: Final[dict[str, dict[str, Any]]] = {
    "trained": {"color": style.BLUE, "marker": "o"},
    "solved": {"color": style.ORANGE, "marker": "v"},
    "searched": {"color": style.PURPLE, "marker": "D"},
    "built in": {"color": style.GREEN, "marker": "s"},
    "given": {"color": style.VERMILION, "marker": "^"},
}
"""Colour and mark of each kind of policy."""
KINDS: Final[dict[str, str]] = {
    "trained": "table, learned",
    "solved": "table, value iteration",
    "searched": "table, searched",
    "built in": "baseline",
    "given": "given",
}
"""Label of each kind of policy."""


@style.styled()
def compare_figure(comparison: Comparison) -> "Figure":
    """Draw a comparison."""
    rows, columns = comparison.rows, comparison.columns
    title = f"Share of {comparison.trials} trials that lasted {comparison.duration:g} s"
    figure = style.new_figure(ROW * len(rows) + MARGIN, title)
    panels: Any = figure.subplots(1, len(columns), sharey=True, squeeze=False)[0]
    for number, (panel, column) in enumerate(zip(panels, columns, strict=True)):
        for place, row in enumerate(rows):
            share, arms = _share(row.cells[number])
            look = LOOKS[row.kind] | {"linestyle": "none", "markersize": 4, "clip_on": False}
            panel.errorbar([share], [place], xerr=arms, capsize=2, elinewidth=1.1, **look)
        panel.set_title(_lines(column.name), fontsize=8.0)
        panel.set_xlim(0.0, 100.0)
        panel.set_xticks([0, 50, 100])
        panel.set_ylim(len(rows) - 0.4, -0.6)
        panel.set_xlabel("lasted [%]")
    panels[0].set_yticks(range(len(rows)), [_lines(row.name) for row in rows])
    for kind in (kind for kind in KINDS if kind in {row.kind for row in rows}):
        panels[0].plot([], [], linestyle="none", label=KINDS[kind], **LOOKS[kind])
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure


def _share(cell: Cell) -> tuple[float, list[list[float]]]:
    """Return the share that lasted and the lengths of its error bars [%]."""
    found = cell.results.summary()
    low, high = found.interval
    share = cell.results.outcomes.count(Outcome.LASTED) / found.trials
    return 100.0 * share, [[100.0 * (share - low)], [100.0 * (high - share)]]


def _lines(name: str) -> str:
    """Return a name in lines that fit above a panel."""
    return "\n".join(style.plain(shortened(part, WIDEST)) for part in name.split(", "))
