"""Figures: they show the values, name them with units, and nothing is cut off."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib import rcParams
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text

from equipoise.errors import RecordingError
from equipoise.identification.recording import fitted_curve
from equipoise.outcomes import Outcome
from equipoise.report.figures import free_swing, swing_up
from equipoise.report.page import FIGURES
from equipoise.report.style import render, save
from tests.reference import pendulum as reference
from tests.report import made_up

LABELS = {
    "swing": ["(the paper's figure 2)", "angle from hanging θ [°]", "time [s]", "RMS"],
    "learning-curve": ["mean duration [s]", "episodes", "kept: episode"],
    "policy": ["φ [°]", "dφ/dt [°/s]", "x from −0.22 to −0.08 m"],
    "survival": ["time since the release [s]", "trials surviving [%]", "90 %", "LQR"],
    "swing-up": ["handed over after 3.00 s", "dφ/dt [°/s]", "x [m]", "u [m/s²]", "time [s]"],
    "literal-run": ["Literal recipe: angle after 1.5 s", "observation", "A7"],
    "run": ["u [m/s²]", "joints, change [°]", "φ [°]", "x [m]", "dx/dt [m/s]", "observation", "A7"],
}


@pytest.fixture(scope="module")
def results():
    return made_up.results()


@pytest.fixture(scope="module")
def drawn(results):
    return {name: draw(results) for name, draw in FIGURES.items()}


def texts(figure):
    return [t.get_text() for t in figure.findobj(Text) if t.get_visible() and t.get_text()]


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_names_what_it_shows_with_units_and_cuts_nothing_off(drawn, name):
    figure = drawn[name]
    shown = texts(figure)
    for label in LABELS[name]:
        assert any(label in text for text in shown), label
    artist = FigureCanvasAgg(figure)
    artist.draw()
    page = figure.bbox.padded(3.0)
    for panel in figure.axes:
        box = panel.get_tightbbox(artist.get_renderer())
        assert page.contains(box.x0, box.y0), name
        assert page.contains(box.x1, box.y1), name


def test_equal_values_give_equal_files_whatever_the_settings_of_matplotlib(results, monkeypatch):
    first = [path.read_bytes() for path in save(FIGURES["swing"](results), Path("swing"))]
    monkeypatch.setitem(rcParams, "font.size", 30.0)
    again = FIGURES["swing"](results)
    assert first == [render(again, "svg"), render(again, "png")]


def test_the_fitted_curve_solves_the_pendulums_equation(results):
    swing, pendulum = results.swing, results.pendulum
    inside = swing.time >= made_up.RELEASE
    witness, _ = reference.swing(swing.time[inside], 0.05, 0.0, w2=made_up.W2, c=made_up.C)
    np.testing.assert_allclose(fitted_curve(swing, pendulum)[inside], witness, atol=1e-6)
    with pytest.raises(RecordingError):
        free_swing(made_up.swing(rate=True), pendulum)


def test_a_gyros_recording_is_drawn_as_a_rate():
    trajectory = made_up.swing(rate=True)
    shown = texts(free_swing(trajectory, made_up.pendulum(trajectory)))
    assert "angular velocity dθ/dt [°/s]" in shown


def test_the_learning_curve_is_the_mean_between_its_points(drawn):
    means, edges, _ = drawn["learning-curve"].axes[0].patches[0].get_data()
    # The training of `made_up` takes 40 steps of 0.01 s in every episode.
    np.testing.assert_allclose(means, 0.4)
    np.testing.assert_array_equal(edges, 1000 * np.arange(11))


def test_the_picture_of_the_policy_has_its_commands_where_the_boxes_are(drawn):
    # The table of `made_up` depends on the sign of phi alone: left -2, right +2. Its first seven
    # boxes, of the lowest phi and phi_dot, were never visited. Rows count from the top.
    numbers = 0
    for panel in drawn["policy"].axes[:9]:
        place = panel.get_subplotspec()
        for text in panel.texts:
            x, y = text.get_position()
            if text.get_text()[0] in "+−":
                numbers += 1
                assert text.get_text() == ("−2" if x < 3.0 else "+2")
                box = (0, 0, place.colspan.start, 2 - place.rowspan.start)
                assert (x, y) != (0.5, 0.5) or np.ravel_multi_index(box, (6, 5, 3, 3)) >= 7
    assert numbers == 270 - 7


def test_the_survival_curve_counts_the_trials_that_still_stand(drawn):
    left = drawn["survival"].axes[0]
    policy = next(line for line in left.lines if line.get_label() == "policy")
    time, standing = policy.get_data()

    def at(t):
        return standing[np.flatnonzero(np.asarray(time) <= t)[-1]]

    assert [at(2.99), at(3.0), at(19.9), at(20.0), at(60.0)] == [100.0, 95.0, 95.0, 90.0, 90.0]


@pytest.mark.parametrize(("name", "until"), [("run", 500), ("literal-run", 150)])
def test_a_run_is_drawn_as_observed_and_as_it_was(results, drawn, name, until):
    run = results.default.run if name == "run" else results.literal.run
    axes = drawn[name].axes
    values, edges, _ = axes[0].patches[0].get_data()
    np.testing.assert_array_equal(values, run.ticks.u[:until])
    np.testing.assert_allclose(edges, 0.01 * np.arange(until + 1), atol=1e-12)
    units = {"phi": np.degrees(1.0), "phi_dot": np.degrees(1.0), "x": 1.0, "x_dot": 1.0}
    for panel, (curve, unit) in zip(axes[2:], units.items(), strict=True):
        seen, was = run.ticks[curve], run.truth[curve]
        drawn_lines = [line.get_ydata() for line in panel.lines if len(line.get_xdata()) > 2]
        np.testing.assert_allclose(drawn_lines, unit * np.array([was[:until], seen[:until]]))
    limits = {line.get_ydata()[0] for line in axes[2].lines if len(line.get_ydata()) == 2}
    assert {-11.0, 11.0, -5.0, -1.0, 0.0, 1.0, 5.0} <= limits


def test_the_runs_of_both_recipes_have_the_same_axes(drawn):
    for one, other in zip(drawn["run"].axes, drawn["literal-run"].axes, strict=True):
        assert one.get_xlim() == other.get_xlim() == (0.0, 5.0)
        np.testing.assert_allclose(one.get_ylim(), other.get_ylim())


def test_a_swing_up_is_drawn_from_hanging_with_its_hand_over(drawn):
    plane, angle, _, command = drawn["swing-up"].axes
    up, policy, dot = plane.lines[2:]
    ends = up.get_xydata()[[0, -1]]
    np.testing.assert_allclose(ends, [[180.0, -60.0], [0.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(dot.get_xydata(), [[0.0, 0.0]], atol=1e-9)
    assert len(policy.get_xdata()) == 200
    assert {float(line.get_xdata()[0]) for line in (angle.lines[-1], command.lines[-1])} == {3.0}
    # The dotted lines: the energy of rest upright, per m g l, is zero.
    phi, rate = np.radians(plane.lines[1].get_data())
    np.testing.assert_allclose(rate**2 / (2.0 * 68.0) + np.cos(phi), 1.0)


def test_a_pendulum_that_never_came_up_has_no_hand_over():
    of = made_up.policy(made_up.pendulum(made_up.swing()))
    figure = swing_up(made_up.swung_up(of, 0.0, Outcome.NOT_UPRIGHT))
    assert "Swing-up: not upright" in texts(figure)
    assert not len(figure.axes[0].lines[-1].get_xdata())
