"""The figure of a comparison: it shows the shares with their intervals, and nothing is cut off."""

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from equipoise.apps.report.figures.compare import KINDS, compare_figure
from equipoise.outcomes import Outcome
from equipoise.settings import EvaluationSettings
from equipoise.studies.compare import ROWS
from equipoise.studies.compare_results import Cell, Column, Comparison, PolicyRow
from equipoise.worlds.evaluation import TrialResults, exact_interval

WORLDS = ("ideal", "model", "twin:nominal", "twin:nominal", "twin:harsh", "twin:harsh")


def made_up(names, worlds, trials=40):
    """A comparison whose trials nobody ran: policy i lasts in trials - i of them."""

    def row(i, name):
        lasted = trials - i
        results = TrialResults(
            name=name,
            survival=(60.0,) * lasted + (1.0,) * i,
            outcomes=(Outcome.LASTED,) * lasted + (Outcome.ANGLE,) * i,
        )
        cells = (Cell(actuators=("sha256:0",), results=results, rms_x=0.01),) * len(worlds)
        costs = dict.fromkeys(("episodes", "steps", "selection_steps", "train_s", "size"))
        kind = tuple(KINDS)[i % len(KINDS)]
        given = {"recipe": "", "policy": "sha256:0", "decision_s": 1e-6, **costs}
        return PolicyRow(name=name, kind=kind, cells=cells, **given)

    columns = tuple(
        Column(world=world, told=world in worlds[:i], world_settings=None)
        for i, world in enumerate(worlds)
    )
    return Comparison(
        quick=False,
        arm="iiwa7",
        pendulum="sha256:0",
        actuator="sha256:0",
        evaluation=EvaluationSettings(trials=trials, duration=60.0),
        seed=0,
        columns=columns,
        rows=tuple(row(i, name) for i, name in enumerate(names)),
    )


@pytest.mark.parametrize(
    ("names", "worlds"),
    [((*ROWS, "dqn.onnx", "a_rather_long_module:my_law"), WORLDS), (("lqr",), ("model",))],
    ids=["all", "one"],
)
def test_nothing_is_cut_off_or_covered(names, worlds):
    figure = compare_figure(made_up(names, worlds))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    page = figure.bbox.padded(3.0)
    boxes = [axes.get_tightbbox(renderer) for axes in figure.axes]
    assert len(boxes) == len(worlds)
    (legend,) = figure.legends
    for n, box in enumerate([*boxes, legend.get_window_extent(renderer)]):
        assert page.contains(box.x0, box.y0)
        assert page.contains(box.x1, box.y1)
        # A pixel: neighbours may touch.
        assert not any(box.padded(-1.0).overlaps(other.padded(-1.0)) for other in boxes[n + 1 :])


def test_it_shows_each_share_with_its_interval():
    names = ("one", "two", "three $x$")
    figure = compare_figure(made_up(names, ("model", "twin:harsh")))
    for axes in figure.axes:
        assert axes.get_xlabel() == "lasted [%]"
        for i, bars in enumerate(axes.containers):
            share, place = bars.lines[0].get_xydata()[0]
            assert (share, place) == (pytest.approx(100.0 * (40 - i) / 40), i)
            (segment,) = bars.lines[2][0].get_segments()
            low, high = exact_interval(40 - i, 40)
            assert [end[0] for end in segment] == pytest.approx([100.0 * low, 100.0 * high])
    labels = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    assert labels == ["one", "two", r"three \$x\$"]
    assert "40 trials that lasted 60 s" in figure.get_suptitle()
