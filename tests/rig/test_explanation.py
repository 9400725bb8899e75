"""Explain names what was done to a run; each fault is injected on the twin."""

import dataclasses
import inspect
import re

import numpy as np
import pytest

from equipoise.control import states
from equipoise.control.grid import CAUSES, SAFETY_STOP
from equipoise.control.policy import shipped_policy
from equipoise.logs.conditions import RunEnd
from equipoise.logs.recorder import Recorder, push_event
from equipoise.logs.run_log import BROKEN_OFF, RunLog
from equipoise.logs.runs import load_run
from equipoise.logs.writer import RunWriter
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.worlds import World, read_world
from equipoise.rig import run as rig
from equipoise.rig import run_controller
from equipoise.rig.explanation import (
    ADVICE,
    DETECTORS,
    IN_SIMULATION,
    CauseName,
    _timeline,
    explain,
)
from equipoise.rig.simulate import excite, simulate_run
from equipoise.safety.rules import Rule
from equipoise.safety.trial import guard_named
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
    assert outcome.cause != "lasted", f"{kind} {seed} did not end the run"
    found = explain(RunLog.load(path, damaged=True))
    path.unlink()
    return found, fault.name


@pytest.mark.parametrize("kind", KINDS)
def test_the_fault_that_was_injected_is_named(kind, tmp_path):
    found, name = why(kind, 1, tmp_path)
    assert found.causes[0].name is name, found.causes
    assert found.causes[0].evidence
    assert found.causes[0].advice == ADVICE[name]
    scores = [cause.score for cause in found.causes]
    assert scores == sorted(scores, reverse=True)


@pytest.mark.slow
def test_95_of_100_faults_are_named(tmp_path):
    wrong = [
        (kind, seed)
        for kind in KINDS
        for seed in range(100, 100 + SEEDS)
        if (found := why(kind, seed, tmp_path))[0].causes[0].name is not found[1]
    ]
    assert len(wrong) <= (1.0 - SHARE) * len(KINDS) * SEEDS, wrong


@pytest.mark.parametrize("seed", [0, 1])
def test_a_run_that_lasts_raises_no_suspicion(seed, tmp_path):
    fault = Fault(CauseName.LASTED, start=draw_fault("push", seed).start)
    path = tmp_path / "run.mcap"
    assert run_with(fault, seed, path).cause == "lasted"
    run = RunLog.load(path, damaged=True)
    assert [cause.name for cause in explain(run).causes] == [CauseName.LASTED]
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
    assert (found.causes[0].name, found.ending.whole) == (CauseName.BROKEN_OFF, False)
    # A push is seen in what is there, whether or not the log says how the run ended.
    path = tmp_path / "run.mcap"
    run_with(draw_fault("push", 5), 5, path)
    whole = RunLog.load(path, damaged=True)
    cut = dataclasses.replace(whole, end=whole.end.model_copy(update={"cause": "error"}))
    assert explain(cut).causes[0].name is CauseName.PUSH


def test_a_run_that_never_balanced_is_explained_by_its_reason(tmp_path, rig_log):
    path = tmp_path / "run.mcap"
    writer = RunWriter(path, RunLog.load(rig_log, damaged=True).conditions, 0.0)
    recorder = Recorder(7)
    push_event(recorder.event, 0.5, "homing", (), "Moving to home.")
    writer.drain(recorder)
    reason = "the encoder turns the wrong way round"
    writer.finish(1.0, RunEnd(cause="self-test", reason=reason))
    found = explain(RunLog.load(path, damaged=True))
    assert found.log is None
    assert found.causes[0].name is CauseName.SELF_TEST
    assert found.causes[0].evidence == "the encoder turns the wrong way round"


def on_twin(seed=0, **numbers):
    world = read_world("twin:nominal")
    there = World("twin:other", world.settings.model_copy(update=numbers))
    return simulate_run(shipped_policy(), world=there, seed=seed, duration=5.0)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_zero_error_is_named_in_a_log_of_a_twin(seed):
    sign = (-1.0) ** seed
    log = on_twin(seed, zero_offset=sign * np.deg2rad(5.0), zero_error=0.0)
    assert log.cause != "lasted"
    assert explain(log).causes[0].name is CauseName.ZERO


def test_a_release_outside_the_recoverable_set_is_named_in_a_log_of_a_twin():
    policy = shipped_policy()
    wide = policy.settings.evaluation.model_copy(
        update={"phi_low": 0.14, "phi_high": 0.15, "phi_dot_low": 1.0, "phi_dot_high": 1.1}
    )
    settings = policy.settings.model_copy(update={"evaluation": wide})
    log = simulate_run(policy, world="twin:nominal", settings=settings, duration=3.0)
    assert log.cause != "lasted"
    assert explain(log).causes[0].name is CauseName.OUTSIDE


def test_a_run_on_a_twin_that_lasts_has_nothing_to_explain():
    log = on_twin()
    assert log.cause == CAUSES[0] == "lasted"
    assert [cause.name for cause in explain(log).causes] == [CauseName.LASTED]
    timeline = _timeline(log)
    assert [found for detect in DETECTORS if (found := detect(timeline))] == []


def test_every_cause_says_what_to_do(rig_log):
    assert set(ADVICE) == set(CauseName)
    assert set(IN_SIMULATION) <= set(CauseName)
    assert explain(load_run(rig_log)).causes[0].name is CauseName.LASTED


RIG_CAUSES = {rule.value for rule in Rule} | {
    *("lasted", "operator", "dry run", "self-test", "joint limit", "fault", "link lost"),
    *(BROKEN_OFF, "error", run_controller.POLICY),
}
"""Every cause of a log of a rig: the rules, and those of run controller, deployment and reader."""
OF_A_BENCH = {
    *(Rule.LINK, Rule.NOT_FOLLOWING, Rule.TORQUE, Rule.FIRST, Rule.TICK, Rule.NUMBER, Rule.COUNT),
    *(Rule.MEASUREMENT_STALE, Rule.ENCODER_STALE),
    *(Rule.ENCODER_ILLEGAL, Rule.ENCODER_GAP, Rule.ENCODER_JUMP),
}
"""Rules that trials do not ask: about clocks, links, cables and hands."""


def test_the_causes_of_a_rig_are_all_that_the_sources_name():
    """Each `Cause("...")` and each run that never moved, read from the sources themselves."""
    written = set[str]()
    for module in (run_controller, rig, states):
        source = inspect.getsource(module)
        written |= set(re.findall(r'Cause\(\s*"([^"]+)"', source))
        written |= set(re.findall(r'_unmoved\(\s*"([^"]+)"', source))
    assert len(written) >= 5
    assert written <= RIG_CAUSES


@pytest.fixture(scope="module")
def whole(rig_log):
    """What `rig_log` holds."""
    return RunLog.load(rig_log, damaged=True)


@pytest.mark.parametrize("cause", sorted(RIG_CAUSES))
def test_every_cause_of_a_log_of_a_rig_is_explained(cause, whole):
    end = None if cause == BROKEN_OFF else RunEnd(cause=cause, reason=f"because of {cause}")
    found = explain(dataclasses.replace(whole, end=end))
    assert found.causes[0].name is not CauseName.UNKNOWN
    assert found.causes[0].advice
    assert found.ending.cause == cause
    if end is not None:
        assert f"because of {cause}" in found.causes[0].evidence


@pytest.mark.parametrize(
    ("cause", "guard"),
    [
        *((cause, "") for cause in CAUSES if cause != CAUSES[SAFETY_STOP]),
        *((CAUSES[SAFETY_STOP], guard_named(SAFETY_STOP + code)) for code in range(len(Rule))),
    ],
)
def test_every_cause_of_a_log_of_a_twin_is_explained_from_its_last_tick(cause, guard, short_run):
    found = explain(dataclasses.replace(short_run, end=RunEnd(cause=cause, guard=guard)))
    first = found.causes[0]
    assert first.name is not CauseName.UNKNOWN
    assert (first.name is CauseName.LASTED) is (cause == "lasted")
    assert found.ending.cause == (guard or cause)
    if not guard or Rule(guard) not in OF_A_BENCH:  # what a simulation needs is not done at a rig
        assert not re.search("smartPAD|cable|hand|level the base", first.advice)
    if cause != "lasted":
        assert (guard or cause) in first.evidence
        assert "phi" in first.evidence
        assert "(limit 11)" in first.evidence


def test_an_excitation_is_no_riddle(pendulum):
    run = excite(iiwa(7), "twin:nominal", pendulum, duration=0.1)
    found = explain(run)
    assert [cause.name for cause in found.causes] == [CauseName.EXCITED]
    assert "equipoise identify" in found.causes[0].advice


@pytest.fixture(scope="module")
def short_run():
    return simulate_run(shipped_policy(), world="twin:nominal", seed=0, duration=0.3)
