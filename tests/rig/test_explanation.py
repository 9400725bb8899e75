"""Explain names what was done to a run; each fault is injected on the twin."""

import dataclasses

import numpy as np
import pytest

from equipoise.control.policy import shipped_policy
from equipoise.control.ticks import OperatorMessage
from equipoise.logs.conditions import RunEnd
from equipoise.logs.recorder import Recorder, push_event
from equipoise.logs.run_log import RunLog
from equipoise.logs.writer import RunWriter
from equipoise.model.worlds import World, read_world
from equipoise.outcomes import Outcome
from equipoise.rig.explanation import _JOINTS, ADVICE, DETECTORS, RootCause, _timeline, explain
from equipoise.rig.simulate import simulate_run
from tests.rig.faulted import KINDS, Fault, draw_fault, run_with

pytestmark = pytest.mark.compiled_only  # the twin takes minutes otherwise

SEEDS = 14
"""Runs of each kind in the full statistics: 210 in all."""
SHARE = 0.95
"""So many are named rightly."""


def why(kind, seed, folder):
    """What explain names for a drawn fault, and what it should."""
    fault, path = draw_fault(kind, seed), folder / f"{kind}-{seed}.mcap"
    outcome = run_with(fault, seed, path)
    assert outcome.outcome != "lasted", f"{kind} {seed} did not end the run"
    found = explain(RunLog.load(path, damaged=True))
    path.unlink()
    return found, fault.name


@pytest.mark.parametrize("kind", KINDS)
def test_the_fault_that_was_injected_is_named(kind, tmp_path):
    found, name = why(kind, 1, tmp_path)
    assert found.causes[0].advice == ADVICE.get(name, _JOINTS), found.causes
    assert found.causes[0].evidence
    scores = [cause.score for cause in found.causes]
    assert scores == sorted(scores, reverse=True)


@pytest.mark.slow
def test_95_of_100_faults_are_named(tmp_path):
    wrong = [
        (kind, seed)
        for kind in KINDS
        for seed in range(100, 100 + SEEDS)
        if (found := why(kind, seed, tmp_path))[0].causes[0].advice != ADVICE.get(found[1], _JOINTS)
    ]
    assert len(wrong) <= (1.0 - SHARE) * len(KINDS) * SEEDS, wrong


@pytest.mark.parametrize("seed", [0, 1])
def test_a_run_that_lasts_raises_no_suspicion(seed, tmp_path):
    fault = Fault(Outcome.LASTED, start=draw_fault("push", seed).start)
    path = tmp_path / "run.mcap"
    assert run_with(fault, seed, path).outcome == "lasted"
    run = RunLog.load(path, damaged=True)
    assert [each.cause for each in explain(run).causes] == [Outcome.LASTED]
    # Nor would it if it had ended: no look finds anything.
    timeline = _timeline(run)
    assert [found for detect in DETECTORS if (found := detect(timeline))] == []
    # The unexplained rate stays where it is: to 1 deg/s over 80 ms.
    steps = timeline.rate[16:] - timeline.rate[:-16]
    assert np.rad2deg(np.std(steps)) < 3.0


def test_a_push_is_measured(tmp_path):
    rate, at = 2.6, 1.2
    fault = draw_fault("push", 0)._replace(at=at, once=lambda stage: stage.bench.push(rate))
    run_with(fault, 0, tmp_path / "run.mcap")
    run = RunLog.load(tmp_path / "run.mcap", damaged=True)
    timeline = _timeline(run)
    i = int(np.searchsorted(timeline.time, at))
    assert timeline.rate[i + 10] - timeline.rate[i - 10] == pytest.approx(rate, rel=0.15)
    push = explain(run).causes[0]
    assert push.time == pytest.approx(at, abs=0.05)


def test_a_wrong_zero_is_measured(tmp_path):
    error = np.deg2rad(3.0)
    fault = draw_fault("zero", 0)._replace(zero=error)
    run_with(fault, 0, tmp_path / "run.mcap")
    run = RunLog.load(tmp_path / "run.mcap", damaged=True)
    timeline = _timeline(run)
    slope = np.polyfit(timeline.time, timeline.rate, 1)[0]
    assert -slope / timeline.pendulum.w2 == pytest.approx(error, rel=0.15)


def test_a_log_that_breaks_off_is_explained_as_far_as_it_goes(tmp_path, rig_log, broken_off):
    found = explain(RunLog.load(broken_off, damaged=True))
    assert found.causes[0].cause is found.end.outcome is Outcome.BROKEN_OFF
    # A push is seen in what is there, whether or not the log says how the run ended.
    path = tmp_path / "run.mcap"
    run_with(draw_fault("push", 5), 5, path)
    whole = RunLog.load(path, damaged=True)
    end = whole.end.model_copy(update={"outcome": Outcome.ERROR})
    cut = dataclasses.replace(whole, end=end)
    assert explain(cut).causes[0].cause is RootCause.PUSH


def test_a_run_that_never_balanced_is_explained_by_its_reason(tmp_path, rig_log):
    path = tmp_path / "run.mcap"
    writer = RunWriter(path, RunLog.load(rig_log, damaged=True).conditions, 0.0)
    recorder = Recorder(7)
    push_event(recorder.event, 0.5, OperatorMessage("homing", "Moving to home."))
    writer.drain(recorder)
    reason = "the encoder turns the wrong way round"
    writer.finish(1.0, RunEnd(outcome=Outcome.SELF_TEST, evidence={"text": reason}))
    found = explain(RunLog.load(path, damaged=True))
    assert found.log is None
    assert found.causes[0].cause is Outcome.SELF_TEST
    assert found.causes[0].evidence == reason


def on_twin(seed=0, **numbers):
    world = read_world("twin:nominal")
    there = World("twin:other", world.settings.model_copy(update=numbers))
    return simulate_run(shipped_policy(), world=there, seed=seed, duration=5.0)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_zero_error_is_named_in_a_log_of_a_twin(seed):
    sign = (-1.0) ** seed
    log = on_twin(seed, zero_offset=sign * np.deg2rad(5.0), zero_error=0.0)
    assert log.outcome != "lasted"
    assert explain(log).causes[0].cause is RootCause.ZERO


def test_a_release_outside_the_recoverable_set_is_named_in_a_log_of_a_twin():
    policy = shipped_policy()
    wide = policy.settings.evaluation.model_copy(
        update={"phi_low": 0.14, "phi_high": 0.15, "phi_dot_low": 1.0, "phi_dot_high": 1.1}
    )
    settings = policy.settings.model_copy(update={"evaluation": wide})
    log = simulate_run(policy, world="twin:nominal", settings=settings, duration=3.0)
    assert log.outcome != "lasted"
    assert explain(log).causes[0].cause is RootCause.OUTSIDE


def test_a_run_on_a_twin_that_lasts_has_nothing_to_explain():
    log = on_twin()
    assert log.outcome is Outcome.LASTED
    assert [each.cause for each in explain(log).causes] == [Outcome.LASTED]
    timeline = _timeline(log)
    assert [found for detect in DETECTORS if (found := detect(timeline))] == []


@pytest.mark.parametrize("outcome", Outcome)
def test_every_outcome_of_a_log_is_explained(outcome, rig_log):
    whole = RunLog.load(rig_log, damaged=True)
    end = None if outcome is Outcome.BROKEN_OFF else RunEnd(outcome=outcome)
    found = explain(dataclasses.replace(whole, end=end))
    assert found.end.outcome is outcome
    assert found.causes[0].advice


def test_the_end_of_a_simulated_run_is_told_by_its_last_state():
    run = simulate_run(shipped_policy(), world="twin:nominal", seed=0, duration=0.3)
    end = RunEnd(outcome=Outcome.TRACK, evidence={"x": 0.2, "phi": 0.1})
    (found, *_) = explain(dataclasses.replace(run, end=end)).causes
    assert "x 0.2, phi 0.1" in found.evidence
