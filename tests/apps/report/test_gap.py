"""The figure of the gap: it shows the numbers, with units, and nothing covers or is cut off."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text

from equipoise.apps.report.figures.gap import LINES, gap_figure
from equipoise.studies.gap_results import LABELS, PAPER, mean, track_share
from tests.apps.report.made_up_gap import falls_early, measured, with_cures


def stands(call, i):
    return 60.0


def falls_at_once(call, i):
    return 0.01 + 0.01 * i


FORMS = {
    "full": (falls_early, {}),
    "short": (falls_early, {"quick": True}),
    "nothing fell": (stands, {}),
    "everything fell at once": (falls_at_once, {"quick": True, "trials": 2}),
    "ten minutes": (falls_early, {"duration": 600.0}),
}


@pytest.fixture(scope="module", params=FORMS)
def gap(small_policy, request):
    lasts, options = FORMS[request.param]
    return measured(with_cures(small_policy), lasts, **options)[0]


def texts(figure):
    return [t.get_text() for t in figure.findobj(Text) if t.get_visible() and t.get_text()]


def test_nothing_is_cut_off_or_covered(gap):
    figure = gap_figure(gap)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    page = figure.bbox.padded(3.0)
    legends = [legend for part in figure.subfigs for legend in part.legends]
    for part in (*figure.axes, *legends):
        box = part.get_tightbbox(renderer)
        assert page.contains(box.x0, box.y0), part
        assert page.contains(box.x1, box.y1), part
    boxes = [axes.get_tightbbox(renderer) for axes in figure.axes]
    legend_boxes = [legend.get_window_extent(renderer) for legend in legends]
    for n, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in legend_boxes)
        # A pixel: neighbours may touch.
        assert not any(box.padded(-1.0).overlaps(other.padded(-1.0)) for other in boxes[n + 1 :])


def test_it_says_what_it_shows_in_which_unit(gap):
    shown = texts(gap_figure(gap))
    for label in (
        "mean survival [s]",
        "transport delay [ms]",
        "error of the encoder's zero [°]",
        "track limit [%]",
        f"{gap.trials} trials of {gap.duration:g} s at each point, 95 % intervals",
        "twin:nominal",
        "switched on alone; clean twin: ",
        "removed alone; full twin: ",
        *LABELS.values(),
        *gap.names("alone"),
        *gap.names("named"),
    ):
        assert any(label in text for text in shown), label
    assert any("the short form" in text for text in shown) == gap.quick
    assert any("An open question" in text for text in shown) == bool(gap.names("named"))


def test_curves_and_rows_are_the_numbers(small_policy):
    gap = measured(with_cures(small_policy), falls_early)[0]
    figure = gap_figure(gap)
    above, zero, below = figure.axes[:3]
    for axes, part in ((above, "delay"), (zero, "zero")):
        curves = [gap.curve(part, *key) for key in LINES]
        expected = [[mean(p.results, 60.0).mean for p in curve] for curve in curves if curve]
        shown = [np.array(bars.lines[0].get_ydata(), float) for bars in axes.containers]
        assert len(shown) == len(expected)
        for line, values in zip(shown, expected, strict=True):
            np.testing.assert_allclose(line, values)
    fell = [p for p in gap.curve("delay", PAPER) if track_share(p.results) is not None]
    shares = [100.0 * track_share(p.results) for p in fell]
    assert any(
        line.get_ydata().tolist() == shares and line.get_color() == LINES[PAPER, False]["color"]
        for line in below.lines
    )
    alone = [gap.point("alone", PAPER, name).results for name in gap.names("alone")]
    panel = next(a for a in figure.axes if a.get_title(loc="left").startswith("switched on"))
    shown = np.array(panel.containers[0].lines[0].get_xdata(), float)
    np.testing.assert_allclose(shown, [mean(r, 60.0).mean for r in alone])


def test_curves_differ_in_more_than_colour():
    assert len({line["marker"] for line in LINES.values()}) == len(LINES)
    dashes = {(line["linestyle"], line.get("linewidth")) for line in LINES.values()}
    assert len(dashes) == len(LINES)
