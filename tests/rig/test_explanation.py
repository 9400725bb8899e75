"""Explain names what was done to a run: its measurements are altered as a cause alters them."""

import dataclasses

import numpy as np
import pytest

from equipoise import RunLog, shipped_policy, simulate_run
from equipoise.identification.refine import read_motion
from equipoise.log.conditions import RunEnd
from equipoise.outcomes import Outcome, Phase
from equipoise.rig.explanation import RootCause, explain, root_causes, unexplained_rate
from equipoise.settings import changed
from tests.log.made_up import changed_table

PER_RADIAN = 8192 / (2.0 * np.pi)


@pytest.fixture(scope="module")
def run():
    """Five seconds on the twin, in which nothing goes wrong."""
    return simulate_run(shipped_policy(), world="twin:nominal", duration=5.0)


def fallen(run, turn):
    """The same, its encoder turned by an angle [rad] as a function of time; then it fell."""
    rows = run.tables["encoder"]
    counts = rows["counts"] + np.round(turn(rows["time"]) * PER_RADIAN).astype(int)
    end = run.end.model_copy(update={"outcome": Outcome.ANGLE})
    return dataclasses.replace(changed_table(run, "encoder", counts=counts), end=end)


def motion(run):
    return read_motion(run, run.conditions.arm)


def test_a_run_in_which_nothing_goes_wrong_raises_no_suspicion(run):
    assert [cause.cause for cause in explain(run)] == [Outcome.SURVIVED]
    # Nor would it if it had ended: the unexplained rate stays where it is, to 1 deg/s over 80 ms.
    assert root_causes(run) == []
    rate = unexplained_rate(run, motion(run))[1]
    assert np.rad2deg(np.std(rate[16:] - rate[:-16])) < 3.0


@pytest.mark.parametrize("size", [1.2, -1.2])
def test_a_push_is_named_and_measured(run, size):
    # The rate changes at once, beside what gravity makes of the angle.
    pushed = fallen(run, lambda time: size * np.clip(time - 4.8, 0.0, None))
    time, rate = unexplained_rate(pushed, motion(pushed))
    i = int(np.searchsorted(time, 4.8))
    assert abs(rate[i + 6] - rate[i - 6]) == pytest.approx(abs(size), rel=0.15)
    first = explain(pushed)[0]
    assert (first.cause, first.time) == (RootCause.PUSH, pytest.approx(4.8, abs=0.05))


def test_a_pause_of_the_setpoints_is_named(run):
    x_dot = run.tables["tick"]["x_dot"].copy()
    i = 300
    x_dot[: i + 1] = 0.2
    x_dot[i + 1 :] = 0.0
    paused = changed_table(fallen(run, lambda time: 0.0 * time), "tick", x_dot=x_dot)
    first = explain(paused)[0]
    assert (first.cause, first.time) == (RootCause.PAUSE, pytest.approx(0.01 * (i + 1)))
    assert f"{abs(x_dot[i]):.2f} m/s" in first.evidence


def test_a_wrong_zero_is_named_and_measured(run):
    error = np.deg2rad(3.0)
    wrong = fallen(run, lambda time: error + 0.0 * time)
    slope = np.polyfit(*unexplained_rate(wrong, motion(wrong)), 1)[0]
    assert abs(slope) / shipped_policy().pendulum.w2.value == pytest.approx(error, rel=0.15)
    assert explain(wrong)[0].cause is RootCause.ZERO


PRESENT = changed(shipped_policy().settings, {"controller.predict": False})
"""Settings of a controller that observes the present state."""


@pytest.mark.parametrize(("world", "settings"), [("twin:harsh", PRESENT), ("twin:smart60", None)])
def test_a_fall_behind_a_delay_is_explained_by_it(world, settings):
    # The shipped table predicts the delay of nominal, 30 ms less than that of smart60.
    fell = simulate_run(shipped_policy(), world=world, settings=settings, seed=1, duration=20.0)
    assert fell.outcome in (Outcome.ANGLE, Outcome.TRACK)
    assert explain(fell)[0].cause is RootCause.DELAY


@pytest.mark.parametrize(
    ("since", "cause"), [(0.0, RootCause.OUTSIDE), (4.5, RootCause.SATURATION)]
)
def test_what_no_command_can_turn_back_is_named_with_its_time(run, since, cause):
    tick = run.tables["tick"]
    phi = tick["phi"] + np.deg2rad(30.0) * (tick["time"] >= since)
    away = changed_table(fallen(run, np.zeros_like), "tick", phi=phi)
    first = explain(away)[0]
    assert (first.cause, first.time) == (cause, pytest.approx(since, abs=0.011))


DELAY = {"value": 0.083, "limit": 0.070}


@pytest.mark.parametrize("outcome", [Outcome.ENCODER_STALE, Outcome.LINK, Outcome.LINK_LOST])
@pytest.mark.full
def test_a_late_loop_explains_a_late_device_and_a_punctual_one_does_not(rig_log, outcome):
    whole = RunLog.load(rig_log)
    end = RunEnd(outcome=outcome, evidence=DELAY | {"text": "no reply"})
    ended = dataclasses.replace(whole, end=end)
    assert explain(ended)[0].cause is outcome
    stop, late = whole.phase_ticks(Phase.STOPPING)[0], whole.tables["tick"]["late"].copy()
    late[stop - 50], late[stop - 20] = 0.012, 0.064
    found = explain(changed_table(ended, "tick", late=late))
    assert [one.cause for one in found[:1]] == [RootCause.BUSY]
    assert found[0].evidence == "the loop missed 2 of the last 250 ticks, by up to 64 ms"
    assert "cable" not in found[0].cause.advice
    late[:] = 0.0
    late[stop - 1000], late[stop - 20] = 0.064, 0.012  # long before the stop, and too little
    assert explain(changed_table(ended, "tick", late=late))[0].cause is outcome


def test_every_outcome_of_a_log_is_explained_with_advice(rig_log):
    whole = RunLog.load(rig_log, damaged=True)
    for outcome in Outcome:
        end = None if outcome is Outcome.BROKEN_OFF else RunEnd(outcome=outcome)
        found = explain(dataclasses.replace(whole, end=end))
        assert outcome in [one.cause for one in found]
        assert all(one.cause.advice for one in found)
