"""Plots over time in the panel of a page, one below the other."""

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.apps.style import BLUE, GREEN, INK, PURPLE, VERMILION

if TYPE_CHECKING:
    import viser

Floats = npt.NDArray[np.float64]


class Quantity(NamedTuple):
    """A plotted quantity."""

    title: str
    """Name and unit."""
    colour: str
    """Colour of its line."""
    low: float
    """Largest lower end of the axis."""
    high: float
    """Smallest upper end of the axis."""


QUANTITIES: Final = (
    Quantity("φ [deg]", BLUE, -2.0, 2.0),
    Quantity("x [mm]", GREEN, -20.0, 20.0),
    Quantity("u [m/s²]", PURPLE, -2.0, 2.0),
    Quantity("lateness of the ticks [ms]", VERMILION, 0.0, 1.0),
)
"""Quantities of a run: angle, displacement, command, and on a rig the lateness."""


class Plots:
    """Plots of quantities over the same time."""

    def __init__(self, gui: "viser.GuiApi", count: int, order: float | None = None) -> None:
        """Add empty plots.

        Args:
            gui: Controls of the page.
            count: Number of plots, the first of `QUANTITIES`.
            order: Place of the first one in the panel; by default at the end.
        """
        self._plots = [
            self._add(gui, each, n == count - 1, None if order is None else order + n)
            for n, each in enumerate(QUANTITIES[:count])
        ]
        self._curves: list[tuple[Floats, Floats]] = []

    def _add(self, gui: Any, quantity: Quantity, last: bool, order: float | None) -> Any:
        line = {"stroke": quantity.colour, "width": 1.5, "points": {"show": False}}
        mark = {"stroke": INK, "width": 1.0, "points": {"show": False}}
        soft: Any = {"pad": 0.1, "mode": 1}
        low, high = soft | {"soft": quantity.low}, soft | {"soft": quantity.high}
        return gui.add_uplot(
            (np.array([-1.0, 0.0]), np.zeros(2), np.zeros(2)),
            ({}, mark, line),
            title=quantity.title,
            scales={"x": {"time": False}, "y": {"range": {"min": low, "max": high}}},
            axes=(
                {"size": 24, "stroke": INK, "show": last},
                {"size": 44, "space": 18, "stroke": INK},
            ),
            legend={"show": False},
            cursor={"show": False},
            height=84 + 24 * last,
            padding=(6, 16, 6, 0),
            order=order,
        )

    def draw(self, time: Floats, rows: Floats) -> None:
        """Draw quantities over time.

        Args:
            time: Times [s], increasing, shape (n,).
            rows: The quantities in the units of their titles, shape (plots, n); NaN is not drawn.
        """
        self._curves = [_thinned(time, values) for values in rows]
        self.mark(None)

    def mark(self, time: float | None) -> None:
        """Mark a time [s] by an upright line on a base line; None marks none."""
        for plot, (times, values) in zip(self._plots, self._curves, strict=True):
            if len(times) < 2:
                continue
            marks = values  # hidden below the curve: uPlot draws nothing beside a series of NaN
            if time is not None:
                marks = np.full(len(times), np.min(values))
                marks[int(np.argmin(np.abs(times - time)))] = np.max(values)
            plot.data = (times, marks, values)


def _thinned(time: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return the known points of a curve, of a long one the extremes of each of 150 columns."""
    known = np.isfinite(values)
    time, values = time[known], values[known]
    if len(time) > 1000:
        columns = np.array_split(np.arange(len(time)), 150)
        kept = [{int(c[np.argmin(values[c])]), int(c[np.argmax(values[c])])} for c in columns]
        rows = sorted(set[int]().union(*kept))
        time, values = time[rows], values[rows]
    return time, values
