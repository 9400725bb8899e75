"""A whole run on emulated rigs, in virtual time, with all guards on, and the replay of its log."""

from types import SimpleNamespace

import numpy as np
import pytest

from equipoise import RunLog, shipped_policy
from equipoise.identification.actuator import identify_actuator
from equipoise.outcomes import Phase
from equipoise.rig.config import RigSettings
from equipoise.rig.connection import connect
from equipoise.rig.request import RunRequest
from equipoise.rig.run import run_virtually
from equipoise.rig.run_controller import PHASES
from tests.conftest import tiers
from tests.faults.harness import FaultHarness, Scenario, Trigger
from tests.log.made_up import changed_table
from tests.rig.replayed import replay
from tests.rig.test_guarded import check_sent

POLICY = shipped_policy()
MOTIONS = ("homing", "swing", "balancing")


class Scripted:
    """Acts once after messages of some names: types a word, or calls a function with the bench."""

    def __init__(self, bench=None, **acts):
        self.names, self.texts, self.typed = [], "", []
        self.bench, self.acts = bench, acts

    def notify(self, event):
        self.names.append(event.name)
        self.texts += event.text
        act = self.acts.pop(event.name, None)
        if isinstance(act, str):
            self.typed.append(act)
        elif act is not None:
            act(self.bench)

    def read_input(self):
        typed, self.typed = self.typed, []
        return typed


def request(policy=POLICY, duration=2.0, robot="twin:nominal", **changes):
    task = policy, policy.actuator, RigSettings()
    return RunRequest(*task, robot, None, duration, seed=3, **changes)


def test_it_stands_on_the_twin_and_the_log_says_how(tmp_path):
    out, spy = tmp_path / "run.mcap", Scripted()
    outcome = run_virtually(request(), out, spy)
    assert (outcome.outcome, outcome.survival, outcome.exit_code) == ("survived", 2.0, 0)
    order = ["homing", "home", "reference", "swing", "self-test", "lift", "armed", "balancing"]
    assert [name for name in spy.names if name in order] == order
    run = RunLog.load(out, damaged=True)
    tick, stream = run.tables["tick"], run.tables["stream"]
    balancing = tick["state"] == PHASES.index(Phase.BALANCING)
    assert balancing.sum() == 200
    assert np.abs(tick["phi"][balancing]).max() < np.radians(8.0)
    # Two setpoints in each tick, within the limits of the arm, from first to last.
    assert len(stream) == 2 * len(tick)
    check_sent(stream["q"])
    assert run.end.outcome == "survived"


@pytest.mark.slow
def test_a_policy_controls_another_arm_once_the_excitation_has_identified_it(tmp_path):
    out, spy = tmp_path / "run.mcap", Scripted()
    wanted = request(robot="twin:pd", identify=identify_actuator)
    end = run_virtually(wanted, out, spy)
    assert end.outcome == "survived"
    assert "20 of 20 trials survive in simulation" in spy.texts
    run = RunLog.load(out, damaged=True)
    found = run.end.identified
    assert found.cycle.value == pytest.approx(0.016, rel=0.02)
    assert run.conditions.identifies
    assert replay(run, POLICY) == (len(run.tables["tick"]), [])


def test_a_dry_run_moves_nothing(tmp_path):
    out, spy = tmp_path / "run.mcap", Scripted()
    outcome = run_virtually(request(dry_run=True), out, spy)
    assert (outcome.outcome, outcome.exit_code) == ("dry run", 0)
    assert "checklist" in spy.names
    assert len(RunLog.load(out, damaged=True).tables["stream"]) == 0


def answered(wanted, *words):
    """Run where an operator types all words at once; return the end, and what was told."""
    typed, told = [list(words)], []
    operator = SimpleNamespace(
        notify=lambda event: told.append(event.text),
        read_input=lambda: typed.pop() if typed else [],
    )
    rig = connect(wanted)._replace(operator=None)
    return run_virtually(wanted, None, operator, rig=rig), told


@pytest.mark.parametrize(
    ("typed", "cause", "asked"),
    [
        (["estpo", "", "estop", "fnece", "fence", "monitoring", "t1"], "dry run", 7),
        (["no", "estop"], "operator", 1),
        (["estop", "stop", "fence"], "operator", 2),
    ],
)
def test_a_mistyped_word_is_asked_again(typed, cause, asked):
    end, told = answered(request(dry_run=True), *typed)
    assert end.outcome == cause
    assert sum("Type" in text for text in told) == asked


def test_a_stop_that_came_with_the_last_answer_is_heard_in_the_first_tick():
    end, told = answered(request(), "estop", "fence", "monitoring", "t1", "y", "stop")
    assert (end.outcome, end.survival) == ("operator", 0.0)
    assert "stopped by the operator (stop)" in told


# A log goes through the controller again: the same comes out, or the first difference is named.


@pytest.fixture(scope="module")
def recorded(rig_log):
    return RunLog.load(rig_log, damaged=True)


def test_a_whole_course_comes_out_bit_for_bit(recorded):
    assert replay(recorded, POLICY) == (len(recorded.tables["tick"]), [])


def test_the_first_difference_is_named_with_its_tick(recorded):
    tick = recorded.tables["tick"]
    number = int(np.flatnonzero(tick["state"] == PHASES.index(Phase.BALANCING))[0]) + 20
    u = tick["u"].copy()
    u[number] = 1.25
    assert replay(changed_table(recorded, "tick", u=u), POLICY) == (number, ["u"])


@pytest.mark.full
def test_a_run_with_a_stall_replays_to_the_bit(tmp_path):
    scenario = Scenario(duration=1.5, out=tmp_path / "run.mcap")
    # The second setpoint of a tick is late, and is not sent.
    stall = Trigger("balancing", 0.5), lambda harness: harness.clock.stalls.extend((0.0, 0.05))
    assert FaultHarness(scenario, stall).run().outcome == "survived"
    log = RunLog.load(scenario.out)
    ticks, rows = len(log.tables["tick"]), len(log.tables["stream"])
    assert rows < 2 * ticks
    assert replay(log, scenario.policy) == (ticks, [])


@pytest.mark.parametrize("when", tiers(MOTIONS, ["homing"], MOTIONS))
def test_any_word_stops_it_in_the_same_tick_and_the_arm_comes_to_rest(tmp_path, when):
    out = tmp_path / "run.mcap"
    outcome = run_virtually(request(), out, Scripted(**{when: "stop"}))
    assert (outcome.outcome, outcome.exit_code) == ("operator", 130)
    run = RunLog.load(out, damaged=True)
    tick = run.tables["tick"]
    stopping = tick["state"] == PHASES.index(Phase.STOPPING)
    stopped_at = next(event.time for event in run.events if event.name == "stopping")
    assert tick["time"][stopping][0] == pytest.approx(stopped_at)
    assert np.abs(tick["dq"][-1]).max() == 0.0
    # It never moves again.
    assert stopping[np.argmax(stopping) :].all()
