"""Figures: they show the values, name them with units, and nothing covers or is cut off."""

import dataclasses

import numpy as np
import pytest
from matplotlib import rcParams
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text
from scipy.integrate import solve_ivp

from equipoise.apps.report import figures
from equipoise.apps.report.style import render, save
from equipoise.errors import RecordingError
from equipoise.identification.fitted import fitted_curve
from equipoise.model.worlds import MODEL
from tests.apps.report import made_up


@pytest.fixture(scope="module")
def results():
    return made_up.results()


DRAW = {
    "figure 2": lambda r: figures.free_swing(r.swing, r.pendulum),
    "learning": lambda r: figures.learning_curve(r.policy),
    "policy": lambda r: figures.policy_picture(r.policy, r.run),
    "survival": lambda r: figures.survival(r.evaluation),
    "figure 4": lambda r: figures.commands(r.run),
    "figure 5": lambda r: figures.joints(r.run),
    "figure 6": lambda r: figures.pendulum(r.run),
    "figure 7": lambda r: figures.flange(r.run),
    "zero": lambda r: figures.encoder_zero(r.run),
}
LABELS = {
    "figure 2": ["(the paper's figure 2)", "angle from hanging θ [°]", "time [s]", "0.50 s"],
    "learning": ["mean duration [s]", "trials that lasted [%]", "episodes", "kept: episode 9,000"],
    "policy": [
        "φ [°]",
        "dφ/dt [°/s]",
        "[m/s²]",
        "left: −0.22 < x ≤ −0.08 m",
        "right: 0.08 ≤ x < 0.22 m",
        "moving right:\ndx/dt ≥ 0.5 m/s",
        "moving left:\ndx/dt ≤ −0.5 m/s",
        "never visited in training",
        "12 boxes visited by the recorded run",
    ],
    "survival": [
        "time since the release [s]",
        "trials still standing [%]",
        "90 %",
        "the paper's run on the real arm, 5 s",
        "LQR",
        "random",
    ],
    "figure 4": ["(the paper's figure 4)", "u [m/s²]", "time [s]", "share [%]", "commanded"],
    "figure 5": ["(the paper's figure 5)", "joint position [°]", "A3 (held)", "A7"],
    "figure 6": ["(the paper's figure 6)", "φ [°]", "dφ/dt [°/s]", "failure at ±11°"],
    "figure 7": ["(the paper's figure 7)", "x [m]", "dx/dt [m/s]", "failure at ±0.22 m"],
    "zero": ["error of φ [°]", "time [s]", "true error", "estimate"],
}
ON_THE_TWIN = {
    "figure 4": ["response of the flange", "acceleration [m/s²]", "the first 1 s"],
    "figure 5": ["commanded − real [°]"],
    "figure 6": ["true state", "observation"],
    "figure 7": ["true state", "observation"],
}


def texts(figure):
    return [t.get_text() for t in figure.findobj(Text) if t.get_visible() and t.get_text()]


def in_the_open(artist):
    """Titles, labels and remarks; labels of ticks out of view are texts that nobody sees."""
    return isinstance(artist, Text) and bool(artist.axes) and artist in artist.axes.texts


@pytest.mark.parametrize("name", DRAW)
def test_a_figure_says_what_it_shows_in_which_unit(results, name):
    shown = texts(DRAW[name](results))
    for label in LABELS[name]:
        assert any(label in text for text in shown), label


def test_where_the_truth_is_known_it_stands_beside_what_was_seen(results):
    for name, labels in ON_THE_TWIN.items():
        there, not_there = texts(DRAW[name](results)), texts(DRAW[name](on_the_model()))
        for label in labels:
            assert any(label in text for text in there), label
            assert not any(label in text for text in not_there), label


def on_the_model():
    return made_up.results(world=MODEL)


def test_a_run_without_delay_tracks_its_command():
    run = on_the_model().run
    reached = np.append(np.diff(run.x_dot) / run.conditions.h, 0.0)
    error = np.sqrt(np.mean((reached - run.u) ** 2))
    assert any(f"{error:.2g} m/s² RMS" in text for text in texts(figures.commands(run)))


RUNS = {
    "of a minute": {},
    "on the model": {"world": MODEL},
    "that fell early": {"lasted": 1.3, "cause": "track"},
    "of one step": {"lasted": 0.01, "cause": "angle"},
    "that fell late": {"lasted": 20.0, "cause": "joint limit"},
}
FALLS = {
    "some fell": {},
    "nothing fell": {"falls": ()},
    "everything fell": {"falls": tuple(np.linspace(1.0, 9.0, 20))},
}
CASES = [
    *[("figure 2", "", {}), ("learning", "", {}), ("policy", "", {})],
    *[("survival", case, changes) for case, changes in FALLS.items()],
    *[
        (f"figure {n}", f"a run {case}", changes)
        for case, changes in RUNS.items()
        for n in range(4, 8)
    ],
    *[("zero", f"a run {case}", RUNS[case]) for case in ("of a minute", "of one step")],
]


@pytest.mark.parametrize(
    ("name", "changes"),
    [pytest.param(name, changes, id=f"{name} {case}".strip()) for name, case, changes in CASES],
)
@pytest.mark.slow
def test_nothing_is_cut_off_and_legends_cover_nothing(name, changes):
    results = made_up.results(**changes)
    figure = DRAW[name](results)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    # A few pixels: what a letter's own box may stick out.
    page = figure.bbox.padded(3.0)
    for part in (*figure.axes, *figure.legends, *figure.findobj(in_the_open)):
        box = part.get_tightbbox(renderer)
        assert page.contains(box.x0, box.y0), part
        assert page.contains(box.x1, box.y1), part
    for legend in figure.legends:
        box = legend.get_window_extent(renderer)
        for axes in figure.axes:
            assert not box.overlaps(axes.get_tightbbox(renderer))
    assert not any(axes.get_legend() for axes in figure.axes)


def test_equal_values_give_equal_files(results, tmp_path, monkeypatch):
    monkeypatch.setattr("equipoise.apps.report.style.DPI", 40)
    first, second = (DRAW["figure 6"](results) for _ in range(2))
    svg, png = save(first, tmp_path / "deep" / "figure")
    assert svg.read_text(encoding="utf-8") == render(second, "svg").decode()
    assert png.read_bytes() == render(second, "png")
    assert svg.read_text(encoding="utf-8").startswith("<?xml")
    assert png.read_bytes().startswith(b"\x89PNG")


def test_our_style_is_nobody_elses(results):
    before = dict(rcParams)
    render(figures.pendulum(results.run), "svg")
    assert dict(rcParams) == before


def test_the_fitted_curve_solves_the_equation_of_the_swing(results):
    curve = fitted_curve(results.swing, results.pendulum)
    time = results.swing.time
    inside = time >= made_up.RELEASE - 1e-9
    assert np.all(np.isnan(curve[~inside]))
    witness = solve_ivp(
        lambda _, y: [y[1], -made_up.W2 * np.sin(y[0]) - made_up.C * y[1]],
        (made_up.RELEASE, time[-1]),
        [0.05, 0.0],
        t_eval=time[inside],
        rtol=1e-10,
        atol=1e-12,
    )
    np.testing.assert_allclose(curve[inside], witness.y[0], atol=1e-6)


def test_a_gyros_recording_is_drawn_as_a_rate():
    trajectory = made_up.swing(rate=True)
    shown = texts(figures.free_swing(trajectory, made_up.pendulum(trajectory)))
    assert "angular velocity dθ/dt [°/s]" in shown
    assert any("°/s RMS" in text for text in shown)


def test_a_recording_that_was_told_where_to_start_shows_no_release():
    trajectory = made_up.swing()
    shown = texts(figures.free_swing(trajectory, made_up.pendulum(trajectory, release=None)))
    assert not any("release detected" in text for text in shown)


def test_a_fit_of_another_recording_is_refused(results):
    with pytest.raises(RecordingError, match="give the recording that it came from"):
        figures.free_swing(made_up.swing(rate=True), results.pendulum)


def test_a_training_without_selection_has_one_panel():
    figure = figures.learning_curve(made_up.results(recipe="paper").policy)
    assert len(figure.axes) == 1
    assert not figure.legends


def test_the_learning_curve_is_the_mean_between_its_points(results):
    means, edges, _ = figures.learning_curve(results.policy).axes[0].patches[0].get_data()
    # The training of `made_up` takes 40 steps of 0.01 s in every episode.
    np.testing.assert_allclose(means, 0.4)
    np.testing.assert_array_equal(edges, 1000 * np.arange(11))


def test_the_picture_writes_the_table_where_the_boxes_are(results):
    figure = figures.policy_picture(results.policy)
    panels = figure.axes[:9]
    # The table of `made_up` depends on the sign of phi alone: left -2, right +2.
    for panel in panels:
        for text in panel.texts:
            x, y = text.get_position()
            if 0.0 < x < 6.0 and 0.0 < y < 5.0 and text.get_text()[0] in "+−":
                assert text.get_text() == ("−2" if x < 3.0 else "+2")
    assert sum(t[0] in "+−" and len(t) == 2 for t in texts(figure)) >= 270


def test_the_picture_hatches_the_boxes_that_were_never_visited(results):
    figure = figures.policy_picture(results.policy)
    hatched = [
        (
            patch.get_xy(),
            panel.get_subplotspec().rowspan.start,
            panel.get_subplotspec().colspan.start,
        )
        for panel in figure.axes[:9]
        for patch in panel.patches
        if patch.get_hatch()
    ]
    # Grid 0 to 6: lowest phi and phi_dot; x low (three of x_dot), middle (three), high (one).
    # Rows count from the top, where x_dot is high.
    expected = [((0.0, 0.0), 2 - m, k) for k in range(3) for m in range(3)][:7]
    assert sorted(hatched) == sorted(expected)
    # A frame says that the run was there; these have none.
    widths = {p.get_linewidth() for a in figure.axes[:9] for p in a.patches if p.get_hatch()}
    assert widths == {0.0}


def test_the_colours_of_the_picture_diverge_from_zero(results):
    mesh = figures.policy_picture(results.policy).axes[0].collections[0]
    left, right = (np.reshape(mesh.get_array(), (5, 6, -1))[0, i] for i in (0, 5))
    # u is -2 on the left and +2 on the right: blue and red, equally far from white.
    assert left[2] > left[0] + 0.4
    assert right[0] > right[2] + 0.4
    assert left[:3].mean() == pytest.approx(right[:3].mean(), abs=0.1)


def test_the_survival_curve_counts_the_trials_that_still_stand(results):
    left = figures.survival(results.evaluation).axes[0]
    policy = next(line for line in left.lines if line.get_label() == "policy")
    time, standing = policy.get_data()

    def at(t):
        return standing[np.flatnonzero(np.asarray(time) <= t)[-1]]

    assert [at(2.99), at(3.0), at(19.9), at(20.0), at(60.0)] == [100.0, 95.0, 95.0, 90.0, 90.0]


def test_the_commands_are_steps_that_hold_for_a_tick(results):
    steps = figures.commands(results.run).axes[0].patches[0]
    values, edges, _ = steps.get_data()
    np.testing.assert_array_equal(values, results.run.u[:500])
    np.testing.assert_allclose(edges, 0.01 * np.arange(501), atol=1e-12)


def test_angles_of_the_run_are_drawn_in_degrees_as_seen_and_as_they_were(results):
    run = results.run
    top, all_of_it, bottom, _ = figures.pendulum(run).axes
    for axes, was, seen in (
        (top, run.truth.phi, run.phi),
        (bottom, run.truth.phi_dot, run.phi_dot),
    ):
        drawn = [line.get_ydata() for line in axes.lines if len(line.get_xdata()) > 2]
        np.testing.assert_allclose(drawn, np.degrees([was[:500], seen[:500]]))
    (whole,) = [line.get_ydata() for line in all_of_it.lines if len(line.get_xdata()) > 2]
    np.testing.assert_allclose(whole, np.degrees(run.truth.phi))
    limits = {line.get_ydata()[0] for line in top.lines if len(line.get_ydata()) == 2}
    assert {-11.0, 11.0, -5.0, -1.0, 0.0, 1.0, 5.0} <= limits


def test_the_arm_is_behind_by_the_command_of_a_tick_less_the_truth_at_its_end(results):
    run = results.run
    behind = figures.joints(run).axes[-1]
    first = behind.lines[0].get_ydata()
    np.testing.assert_allclose(first[1:], np.degrees(run.q[:499, 0] - run.truth.q[1:500, 0]))


def test_the_zero_and_its_estimate_are_drawn_in_degrees(results):
    left = figures.encoder_zero(results.run).axes[0]
    error, estimate = (line.get_ydata() for line in left.lines)
    np.testing.assert_allclose(error, np.degrees(made_up.ZERO))
    np.testing.assert_allclose(estimate, np.degrees(results.run.bias[:500]))


def test_a_zero_that_nobody_knows_is_not_drawn(results):
    unknown = results.run.conditions.model_copy(update={"zero_error": None})
    shown = texts(figures.encoder_zero(dataclasses.replace(results.run, conditions=unknown)))
    assert "true error" not in shown
