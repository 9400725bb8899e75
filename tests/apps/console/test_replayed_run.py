"""What the replay shows of a log at a time, its events, and its plots."""

import re
from dataclasses import replace

import numpy as np
import pytest

from equipoise.apps.console.plots import Curve, cursor, plots
from equipoise.apps.console.replayed_run import MAX_MARKS, ReplayedRun
from equipoise.apps.report.pictures import moments
from equipoise.errors import RecordingError
from equipoise.logs.conditions import RunEnd
from equipoise.logs.run_log import RunLog
from equipoise.outcomes import Outcome, Phase
from equipoise.rig.explanation import explain
from equipoise.rig.run_controller import PHASES
from tests.logs.made_up import (
    balanced_on_a_rig,
    changed_table,
    made_up,
    phi_on_a_rig,
    x_on_a_rig,
)


@pytest.fixture(scope="module")
def rig_run():
    run = balanced_on_a_rig()
    q = np.tile(run.conditions.arm.home, (901, 1)) + np.linspace(0.0, 0.9, 901)[:, None]
    event = np.zeros(3, run.tables["event"].dtype)
    event["time"] = [6.5, 9.012, 9.5]
    event["name"] = [b"notice", b"stopping", b"warning"]
    event["text"] = [b"Steady.", b"It stood for 2 s.", b"The disk is nearly full."]
    run = changed_table(run, "tick", q=q, late=np.full(901, 2e-4))
    return replace(run, tables=dict(run.tables) | {"event": event})


def test_a_rig_is_shown_as_it_was_measured(rig_run):
    shown = ReplayedRun.of(rig_run)
    assert shown.whole == pytest.approx((-6.0, 3.0))
    assert shown.usual == pytest.approx((-2.0, 3.0))
    for time in (-3.0, 0.123, 1.5):
        now = shown.at(time)
        assert now.x == pytest.approx(x_on_a_rig(7.0 + time), abs=5e-5)
        assert now.phi == pytest.approx(phi_on_a_rig(7.0 + time), abs=6e-4)
        expected = moments(rig_run, rig_run.conditions.arm, [time])
        np.testing.assert_allclose(now.q, expected.q[0], atol=2e-4)
        assert (now.u, now.late) == (expected.u[0], 2e-4)
        # The command of a tick is for its end.
        row = (time + 6.0) / 0.01 - 1.0
        assert now.commanded[0] == pytest.approx(
            rig_run.conditions.arm.home[0] + 0.001 * row, abs=1e-9
        )
    assert [shown.at(time).phase for time in (-1.0, 1.0, 2.5)] == [
        "lifting",
        "balancing",
        "stopping",
    ]


def test_a_simulated_run_is_shown_as_it_was():
    run = made_up()
    shown = ReplayedRun.of(run)
    now = shown.at(0.105)
    np.testing.assert_allclose(now.q, 0.5 * (run.truth.q[10] + run.truth.q[11]))
    np.testing.assert_allclose(now.commanded, 0.5 * (run.q[9] + run.q[10]))
    assert (now.u, now.phase) == (run.u[10], "")
    assert np.isnan(now.late)
    assert shown.whole == (0.0, 0.4)


def test_a_hanging_pendulum_does_not_jump_between_pi_and_its_opposite():
    run = balanced_on_a_rig()
    time = run.tables["encoder"]["time"]
    swinging = np.pi * np.clip(7.0 - time, 0.0, 1.0)
    swinging += 0.1 * np.sin(3.0 * time) * np.clip(6.0 - time, 0.0, 1.0)
    theta = np.pi - swinging
    counts = np.round(123.0 + theta * 8192 / (2.0 * np.pi))
    shown = ReplayedRun.of(changed_table(run, "encoder", time=time, counts=counts))
    assert np.max(np.abs(np.diff(shown.phi))) < 0.05
    assert shown.at(0.0).phi == pytest.approx(0.0, abs=1e-3)
    assert abs(shown.at(-4.0).phi) > 3.0
    assert -np.pi <= shown.at(-4.0).phi <= np.pi


def test_the_events_are_phases_warnings_and_the_causes_that_explain_names(rig_run):
    marks = ReplayedRun.of(rig_run).marks
    assert [mark.time for mark in marks] == sorted(mark.time for mark in marks)
    others = [(round(mark.time, 2), mark.name, mark.text) for mark in marks if not mark.cause]
    assert others == [
        (-6.0, "lifting", ""),
        (0.0, "balancing", ""),
        (2.01, "stopping", "It stood for 2 s."),
        (2.5, "warning", "The disk is nearly full."),
    ]
    causes = {(mark.name, mark.text) for mark in marks if mark.cause}
    assert causes == {(one.cause, one.evidence) for one in explain(rig_run).causes}


def test_the_cause_of_a_run_that_did_not_balance_is_at_its_end(rig_run):
    lifting = np.full(901, PHASES.index(Phase.LIFTING))
    ended = replace(
        changed_table(rig_run, "tick", state=lifting),
        end=RunEnd(outcome=Outcome.OPERATOR, evidence={"typed": "enough"}),
    )
    shown = ReplayedRun.of(ended)
    (cause,) = [mark for mark in shown.marks if mark.cause]
    assert (cause.name, cause.text) == ("operator", "Enough.")
    assert cause.time == pytest.approx(9.0)
    assert np.isnan(shown.at(1.0).phi)


def test_a_log_with_events_without_end_shows_a_few_with_the_causes(rig_run):
    state = np.resize([PHASES.index(Phase.LIFTING), PHASES.index(Phase.BALANCING)], 901)
    marks = ReplayedRun.of(changed_table(rig_run, "tick", state=state)).marks
    assert len(marks) == MAX_MARKS
    assert any(mark.cause for mark in marks)


@pytest.mark.parametrize("wrong", [np.nan, 3.0])
def test_ticks_whose_times_do_not_increase_are_refused(rig_run, wrong):
    time = rig_run.tables["tick"]["time"].copy()
    time[300] = wrong
    with pytest.raises(RecordingError, match="do not increase"):
        ReplayedRun.of(changed_table(rig_run, "tick", time=time))


def test_an_excitation_has_no_balancing_to_show():
    run = made_up()
    still = RunLog.simulated(run.conditions, RunEnd(outcome=Outcome.EXCITED), {})
    with pytest.raises(RecordingError, match="no policy ran"):
        ReplayedRun.of(still)


# The plots.


def line_of(svg, number):
    points = re.findall(r'<polyline points="([^"]*)"', svg)[number]
    return np.array([[float(part) for part in point.split(",")] for point in points.split()])


def test_a_plot_shows_the_extremes_of_the_shown_part_where_they_are():
    time = np.arange(0.0, 60.0, 0.01)
    values = np.sin(time)
    values[3000] = 5.0  # one tick of 6000, at 30 s
    values[-1] = 99.0
    svg = plots(time, [Curve("a", "red", values)], (20.0, 40.0), {})
    line = line_of(svg, 0)
    assert len(line) <= 2 * 300
    highest = line[np.argmin(line[:, 1]), 0]
    place = float(re.search(r":([\d.]+)%", cursor(30.0, (20.0, 40.0)))[1])
    assert highest == pytest.approx(3.5 * place, abs=0.1)  # of 350 px
    assert line[0, 0] < line[-1, 0]


def test_the_cursor_goes_from_one_side_of_the_curves_to_the_other():
    time = np.linspace(0.0, 1.0, 50)
    line = line_of(plots(time, [Curve("a", "red", time)], (0.0, 1.0), {}), 0)
    for moment, end in ((0.0, 0), (1.0, -1)):
        place = float(re.search(r":([\d.]+)%", cursor(moment, (0.0, 1.0)))[1])
        assert 3.5 * place == pytest.approx(line[end, 0], abs=0.06)


def test_an_unknown_quantity_and_a_single_moment_are_drawn():
    time = np.linspace(0.0, 1.0, 50)
    assert "unknown" in plots(time, [Curve("a", "red", np.full(50, np.nan))], (0.0, 1.0), {})
    svg = plots(time, [Curve("a", "red", np.ones(50))], (0.0, 0.0), {0.0: True})
    assert "nan" not in svg
    assert "stroke-dasharray" in svg
