"""Plots of a run as SVG, with a cursor that moves without drawing them again.

The cursor is a line whose place is a variable of the page's style: only `cursor` is sent anew.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.apps.report.style import GREY, INK, PALE, VERMILION, typeset

Floats = npt.NDArray[np.float64]

WIDTH: Final = 350.0
"""Width of the picture [px]."""
LEFT, RIGHT = 40.0, 14.0
"""Margins at the sides of the plots [px]."""
TITLE, HEIGHT, GAP = 15.0, 56.0, 6.0
"""Height of a title and of a plot, and distance between plots [px]."""
AXIS: Final = 20.0
"""Height of the axis of time [px]."""
POINTS: Final = 300
"""Number of columns of a curve; each shows its smallest and its largest value."""
TICKS: Final = 5
"""Approximate number of labels on the axis of time."""
CURSOR: Final = "--equipoise-cursor"
"""Variable with the place of the cursor."""


class Curve(NamedTuple):
    """A quantity over time."""

    title: str
    """Quantity and unit."""
    colour: str
    """Colour of its line."""
    values: Floats
    """Values, shape (n,); NaN while unknown."""


def plots(
    time: Floats, curves: Sequence[Curve], shown: tuple[float, float], marks: Mapping[float, bool]
) -> str:
    """Return the plots of a part of a run, one below the other.

    Args:
        time: Times [s], increasing, shape (n,).
        curves: The quantities.
        shown: Start and end of the part [s].
        marks: Times of events [s]; true for a cause of the end.
    """
    begin, end = shown
    rows = np.flatnonzero((time >= begin) & (time <= end))
    block = TITLE + HEIGHT + GAP
    bottom = block * len(curves) - GAP
    parts = [*_axis(begin, end, bottom)]
    for number, curve in enumerate(curves):
        parts += _plot(time[rows], curve._replace(values=curve.values[rows]), shown, number * block)
    for at, cause in marks.items():
        if begin <= at <= end:
            colour = VERMILION if cause else GREY
            parts.append(
                f'<path d="M{_across(at, begin, end):.1f} {TITLE}V{bottom:.1f}" stroke="{colour}" '
                'stroke-dasharray="3 3" stroke-width="0.8"/>'
            )
    return (
        '<div id="equipoise-plots" style="position:relative;padding:0 4px">'
        f'<svg viewBox="0 0 {WIDTH:g} {bottom + AXIS:g}" role="img" aria-label="Plots over time" '
        f'style="width:100%;display:block" font-family="system-ui,sans-serif" fill="{INK}">'
        f"{''.join(parts)}</svg>"
        '<div style="position:absolute;left:4px;right:4px;top:0;bottom:0;pointer-events:none">'
        f'<div style="position:absolute;left:var({CURSOR},-9px);top:14px;bottom:6%;width:2px;'
        f'margin-left:-1px;background:{INK}"></div></div></div>'
    )


def cursor(time: float, shown: tuple[float, float]) -> str:
    """Return a style that puts the cursor of the plots at a time [s]."""
    place = 100.0 * _across(time, *shown) / WIDTH
    return f"<style>:root{{{CURSOR}:{place:.3f}%}}</style>"


def _across(time: float, begin: float, end: float) -> float:
    """Return the place of a time from the left [px]."""
    share = (time - begin) / (end - begin) if end > begin else 0.0
    return LEFT + (WIDTH - LEFT - RIGHT) * min(max(share, 0.0), 1.0)


def _plot(time: Floats, curve: Curve, shown: tuple[float, float], top: float) -> Iterator[str]:
    yield f'<text x="{LEFT:g}" y="{top + 11:g}" font-size="11.5">{typeset(curve.title)}</text>'
    known = np.isfinite(curve.values)
    time, values = time[known], curve.values[known]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
    margin = 0.08 * (high - low) or max(abs(high), 1.0) * 0.5
    low, high, base = low - margin, high + margin, top + TITLE + HEIGHT
    yield (
        f'<rect x="{LEFT:g}" y="{top + TITLE:g}" width="{WIDTH - LEFT - RIGHT:g}" '
        f'height="{HEIGHT:g}" fill="none" stroke="{PALE}"/>'
    )

    def up(value: float) -> float:
        return base - HEIGHT * (value - low) / (high - low)

    for value in _round_values(low, high, 4):
        yield (
            f'<path d="M{LEFT:g} {up(value):.1f}H{WIDTH - RIGHT:g}" stroke="{PALE}"/>'
            f'<text x="{LEFT - 4:g}" y="{up(value) + 3.5:.1f}" font-size="10" text-anchor="end">'
            f"{typeset(f'{value:g}')}</text>"
        )
    if not len(values):
        yield (
            f'<text x="{0.5 * (LEFT + WIDTH - RIGHT):g}" y="{base - 0.4 * HEIGHT:g}" fill="{GREY}" '
            'font-size="11" text-anchor="middle">unknown</text>'
        )
        return
    points = " ".join(f"{_across(t, *shown):.1f},{up(v):.1f}" for t, v in _thinned(time, values))
    yield f'<polyline points="{points}" fill="none" stroke="{curve.colour}" stroke-width="1.3"/>'


def _thinned(time: Floats, values: Floats) -> Iterator[tuple[float, float]]:
    """Yield the points of a curve, of a long one the extremes of each column in their order."""
    if len(time) <= 2 * POINTS:
        yield from zip(time.tolist(), values.tolist(), strict=True)
        return
    for rows in np.array_split(np.arange(len(time)), POINTS):
        ends = sorted({int(rows[np.argmin(values[rows])]), int(rows[np.argmax(values[rows])])})
        yield from ((float(time[i]), float(values[i])) for i in ends)


def _axis(begin: float, end: float, bottom: float) -> Iterator[str]:
    for value in _round_values(begin, end, TICKS):
        across = _across(value, begin, end)
        yield f'<path d="M{across:.1f} {bottom:g}v4" stroke="{GREY}"/>'
        yield (
            f'<text x="{across:.1f}" y="{bottom + 15:g}" font-size="10.5" text-anchor="middle">'
            f"{typeset(f'{value:g}')} s</text>"
        )


def _round_values(low: float, high: float, count: int) -> list[float]:
    """Return about `count` round numbers from low to high.

    Example:
        >>> _round_values(-2.0, 6.5, 5)
        [-2.0, 0.0, 2.0, 4.0, 6.0]
    """
    if not high > low:
        return [round(low, 3)]
    rough = (high - low) / count
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(float(power * each) for each in (1, 2, 5, 10) if power * each >= 0.99 * rough)
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    return [round(step * number, 9) for number in range(first, last + 1)]
