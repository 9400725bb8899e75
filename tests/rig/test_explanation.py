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
from equipoise.rig.explanation import ADVICE, RootCause, detect, explain, unexplained_rate
from equipoise.rig.simulate import simulate_run
from tests.rig.faulted import KINDS, Fault, draw_fault, run_with

pytestmark = pytest.mark.compiled_only  # the twin takes minutes otherwise


def run_of(fault, seed, folder):
    """The log of a run with a fault."""
    path = folder / f"{seed}.mcap"
    outcome = run_with(fault, seed, path)
    run = RunLog.load(path, damaged=True)
    assert run.end.outcome == outcome.outcome
    path.unlink()
    return run


def is_named(kind, seed, folder):
    fault = draw_fault(kind, seed)
    causes = explain(run_of(fault, seed, folder))
    scores = [cause.score for cause in causes]
    assert scores == sorted(scores, reverse=True)
    return ADVICE.get(causes[0].cause) == ADVICE.get(fault.name)


@pytest.mark.parametrize("kind", KINDS)
def test_the_fault_that_was_injected_is_named(kind, tmp_path):
    assert is_named(kind, 1, tmp_path)


@pytest.mark.slow
def test_95_of_100_faults_are_named(tmp_path):
    drawn = [(kind, seed) for kind in KINDS for seed in range(100, 114)]
    wrong = [each for each in drawn if not is_named(*each, tmp_path)]
    assert len(wrong) <= 0.05 * len(drawn), wrong


def test_a_run_that_lasts_raises_no_suspicion(tmp_path):
    run = run_of(Fault(Outcome.LASTED, start=draw_fault("push", 0).start), 0, tmp_path)
    assert [each.cause for each in explain(run)] == [Outcome.LASTED]
    # Nor would it if it had ended: no look finds anything.
    assert not any(detect(run))
    # The unexplained rate stays where it is: to 1 deg/s over 80 ms.
    rate = unexplained_rate(run)[1]
    assert np.rad2deg(np.std(rate[16:] - rate[:-16])) < 3.0


def test_a_push_is_measured(tmp_path):
    rate, at = 2.6, 1.2
    fault = draw_fault("push", 0)._replace(at=at, once=lambda stage: stage.bench.push(rate))
    run = run_of(fault, 0, tmp_path)
    time, found = unexplained_rate(run)
    i = int(np.searchsorted(time, at))
    assert found[i + 10] - found[i - 10] == pytest.approx(rate, rel=0.15)
    assert explain(run)[0].time == pytest.approx(at, abs=0.05)


def test_a_wrong_zero_is_measured(tmp_path):
    error = np.deg2rad(3.0)
    run = run_of(draw_fault("zero", 0)._replace(zero=error), 0, tmp_path)
    slope = np.polyfit(*unexplained_rate(run), 1)[0]
    w2 = shipped_policy().pendulum.w2.value
    assert -slope / w2 == pytest.approx(error, rel=0.15)


def test_a_log_that_breaks_off_is_explained_as_far_as_it_goes(tmp_path, broken_off):
    assert explain(RunLog.load(broken_off, damaged=True))[0].cause is Outcome.BROKEN_OFF
    # A push is seen in what is there, whether or not the log says how the run ended.
    whole = run_of(draw_fault("push", 5), 5, tmp_path)
    end = whole.end.model_copy(update={"outcome": Outcome.ERROR})
    assert explain(dataclasses.replace(whole, end=end))[0].cause is RootCause.PUSH


def test_a_run_that_never_balanced_is_explained_by_its_reason(tmp_path, rig_log):
    path = tmp_path / "run.mcap"
    writer = RunWriter(path, RunLog.load(rig_log, damaged=True).conditions, 0.0)
    recorder = Recorder(7)
    push_event(recorder.event, 0.5, OperatorMessage("homing", "Moving to home."))
    writer.drain(recorder)
    reason = "the encoder turns the wrong way round"
    writer.finish(1.0, RunEnd(outcome=Outcome.SELF_TEST, evidence={"text": reason}))
    (found,) = explain(RunLog.load(path, damaged=True))
    assert found[:3:2] == (Outcome.SELF_TEST, None)
    assert found.evidence == reason


def on_twin(seed=0, **numbers):
    world = read_world("twin:nominal")
    there = World("twin:other", world.settings.model_copy(update=numbers))
    return simulate_run(shipped_policy(), world=there, seed=seed, duration=5.0)


def test_a_zero_error_is_named_in_a_log_of_a_twin():
    log = on_twin(zero_offset=np.deg2rad(5.0), zero_error=0.0)
    assert explain(log)[0].cause is RootCause.ZERO


def test_a_run_on_a_twin_that_lasts_has_nothing_to_explain():
    log = on_twin()
    assert [each.cause for each in explain(log)] == [Outcome.LASTED]
    assert not any(detect(log))


@pytest.mark.parametrize("outcome", Outcome)
def test_every_outcome_of_a_log_is_explained(outcome, rig_log):
    whole = RunLog.load(rig_log, damaged=True)
    end = None if outcome is Outcome.BROKEN_OFF else RunEnd(outcome=outcome)
    assert outcome in [one.cause for one in explain(dataclasses.replace(whole, end=end))]
    assert explain(whole)[0].advice
