"""Gap between training plant and twin: survival against delay and zero error, and by effect."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, Literal

from equipoise.apps.report import style
from equipoise.outcomes import Outcome
from equipoise.studies import gap_results as study
from equipoise.studies.gap_results import Gap, GapPoint

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LINES: Final[dict[tuple[study.Controller, bool], dict[str, Any]]] = {
    (study.CURED, False): {"color": style.BLUE, "linestyle": "-", "linewidth": 3.2, "marker": "o"},
    (study.UNTUNED, False): {"color": style.SKY, "linestyle": style.DASHES, "marker": "s"},
    (study.NO_PREDICTION, False): {
        "color": style.ORANGE,
        "linestyle": style.DASH_DOTS,
        "marker": "^",
    },
    (study.NO_BIAS, False): {"color": style.GREEN, "linestyle": style.DOTS, "marker": "D"},
    (study.PAPER, False): {"color": style.VERMILION, "linestyle": "-", "marker": "v"},
    (study.PAPER, True): {"color": style.INK, "linestyle": (0, (3, 1.5)), "marker": "x"},
}
"""Line styles; the first line is wide, so that lines on top of it leave its edges visible."""
SHIFT: Final = 0.008
"""Horizontal offset between curves at a shared point [share of the axis]: separates intervals."""
ROW: Final = 0.21
"""Height of a row of effects [inch]."""
SECONDS_TICKS: Final = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60, 120, 300, 600)
MIN_SECONDS: Final = 1e-3
"""Replacement for zero on logarithmic axes [s]."""
BARS: Final[dict[str, Any]] = {"markersize": 4, "capsize": 2}


@style.styled()
def gap_figure(gap: Gap) -> "Figure":
    """Draw a gap study."""
    effects, worlds = len(gap.names("alone")), len(gap.names("named"))
    rows = [*(effects for _ in gap.by_effect), *([worlds] if worlds else [])]
    heights = [3.8, *(ROW * count + 0.75 for count in rows)]
    title = f"Gap between training plant and the twin {gap.world}"
    figure = style.new_figure(sum(heights) + 0.5, title)
    parts: Any = figure.subfigures(len(heights), 1, height_ratios=heights)
    top, *rest = parts
    _curves(top, gap)
    for part, controller in zip(rest, gap.by_effect, strict=False):
        _effects(part, gap, controller)
    if worlds:
        _named(rest[-1], gap)
    return figure


def _curves(part: Any, gap: Gap) -> None:
    axes: Any = part.subplots(2, 2, sharex="col", sharey="row", height_ratios=(2.3, 0.9))
    _against(axes[:, 0], gap, "delay")
    _against(axes[:, 1], gap, "zero")
    axes[0, 0].set_ylabel("mean survival [s]")
    axes[1, 0].set_ylabel("falls on the\ntrack limit [%]")
    axes[1, 0].set_xlabel("transport delay [ms]")
    axes[1, 1].set_xlabel("error of the encoder's zero [°]")
    short = "; the short form" if gap.quick else ""
    _title(part, f"{gap.trials} trials of {gap.duration:g} s at each point, 95 % intervals{short}")
    # The left panels hold all curves.
    handles, labels = axes[0, 0].get_legend_handles_labels()
    part.legend(handles, labels, loc="outside lower center", ncols=3)


def _against(axes: Any, gap: Gap, what: Literal["delay", "zero"]) -> None:
    above, below = axes
    curves = {key: gap.curve(what, *key) for key in gap.curves}
    places = [p.axis_value for curve in curves.values() for p in curve]
    shift = SHIFT * (max(places) - min(places))
    _seconds_axis(above, "y", gap)
    for number, (key, curve) in enumerate(curves.items()):
        if not curve:
            continue
        line = LINES[key]
        x = [p.axis_value + (number - 2.5) * shift for p in curve]
        label = study.LABELS[key[0]] + (", rest of the twin clean" if key[1] else "")
        above.errorbar(x, *_intervals(gap, curve), label=label, elinewidth=1.1, **BARS, **line)
        shares = [(at, study.track_share(p.results)) for at, p in zip(x, curve, strict=True)]
        if fell := [(at, 100.0 * share) for at, share in shares if share is not None]:
            below.plot(*zip(*fell, strict=True), markersize=4, **line)
    below.set_ylim(-8.0, 108.0)
    below.set_yticks([0, 50, 100])
    ticks = sorted(set(places))
    below.set_xticks(ticks, [f"{tick:g}" for tick in ticks])


def _effects(part: Any, gap: Gap, controller: study.Controller) -> None:
    left, right = part.subplots(1, 2, sharey=True)
    names = gap.names("alone")
    plant, clean, world = (gap.point(p, controller) for p in ("plant", "clean", "world"))
    own, at_best, as_is = (study.mean(p.results, gap.duration).mean for p in (plant, clean, world))
    label = study.LABELS[controller]
    trained = f"{label[0].upper()}{label[1:]}: {own:.1f} s on its own training plant"
    _title(part, f"{trained}; change of the mean beside each effect")
    alone = [gap.point("alone", controller, name) for name in names]
    without = [gap.point("without", controller, name) for name in names]
    for panel, reference, points, title in (
        (left, clean, alone, f"switched on alone; clean twin: {at_best:.1f} s"),
        (right, world, without, f"removed alone; full twin: {as_is:.1f} s"),
    ):
        _rows(panel, gap, points, style.VERMILION if controller == study.PAPER else style.BLUE)
        found = study.mean(reference.results, gap.duration)
        low = max(found.low, MIN_SECONDS)
        panel.axvspan(low, found.high, color=style.PALE, linewidth=0.0, zorder=0.5)
        dashed: Any = {"linewidth": 1.0, "linestyle": (0, (4, 2)), "zorder": 0.9}
        panel.axvline(found.mean, color=style.GREY, **dashed)
        for row, point in enumerate(points):
            _remark(panel, row, _change(study.difference(point.results, reference.results)))
        panel.set_title(title)
    left.set_yticks(range(len(names)), names)


def _named(part: Any, gap: Gap) -> None:
    names = gap.names("named")
    panels = part.subplots(1, 2, sharey=True)
    sides: tuple[tuple[study.Controller, str, str], ...] = (
        (study.CURED, style.BLUE, "actuator identified there"),
        (study.UNTUNED, style.SKY, "actuator of the training"),
    )
    for panel, (controller, colour, title) in zip(panels, sides, strict=True):
        points = [gap.point("named", controller, name) for name in names]
        _rows(panel, gap, points, colour)
        for row, point in enumerate(points):
            lasted = point.results.outcomes.count(Outcome.LASTED)
            _remark(panel, row, f"{lasted} of {gap.trials} lasted")
        panel.set_title(title)
    panels[0].set_yticks(range(len(names)), names)
    _title(part, "An open question: named worlds, each a guess about the cabinet")


def _rows(panel: Any, gap: Gap, points: list[GapPoint], colour: str) -> None:
    means, arms = _intervals(gap, points)
    _seconds_axis(panel, "x", gap)
    line: Any = BARS | {"color": colour, "markeredgecolor": style.INK}
    panel.errorbar(means, range(len(points)), xerr=arms, fmt="o", **line)
    panel.set_ylim(len(points) - 0.4, -0.6)
    panel.grid(visible=False, axis="y")
    panel.set_xlabel("mean survival [s]")


def _remark(panel: Any, row: int, text: str) -> None:
    look: Any = {"fontsize": 7.0, "va": "center", "annotation_clip": False}
    panel.annotate(text, (1.0, row), (3, 0), **style.BESIDE, **look)


def _seconds_axis(panel: Any, axis: Literal["x", "y"], gap: Gap) -> None:
    """Make an axis of seconds logarithmic, for short and long survival."""
    shortest = min(study.mean(p.results, gap.duration).mean for p in gap.points)
    low, high = 0.6 * shortest, 1.15 * gap.duration
    ticks = [t for t in SECONDS_TICKS if low <= t < 0.7 * gap.duration] + [gap.duration]
    getattr(panel, f"set_{axis}scale")("log")
    getattr(panel, f"set_{axis}lim")(low, high)
    getattr(panel, f"set_{axis}ticks")(ticks, [f"{t:g}" for t in ticks])
    panel.minorticks_off()


def _intervals(gap: Gap, points: Sequence[GapPoint]) -> tuple[list[float], list[list[float]]]:
    """Return mean survival and the lengths of its error bars; their ends are positive [s]."""
    found = [study.mean(p.results, gap.duration) for p in points]
    lower = [s.mean - max(s.low, MIN_SECONDS) for s in found]
    return [s.mean for s in found], [lower, [s.high - s.mean for s in found]]


def _change(found: study.Seconds) -> str:
    change = f"{found.mean:+.1f} s [{found.low:+.1f}, {found.high:+.1f}]"
    return style.typeset(change) if any(found) else "no difference"


def _title(part: Any, text: str) -> None:
    part.suptitle(text, x=0.01, ha="left", fontsize=8.5, fontweight="normal")
