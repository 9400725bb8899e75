"""A log goes through the controller again: the same comes out, or the first difference is named."""

import dataclasses

import numpy as np
import pytest

from equipoise.control.policy import shipped_policy
from equipoise.logs.run_log import RunLog
from equipoise.rig.simulate import simulate_run
from tests.faults.harness import FaultHarness, Scenario, Trigger
from tests.faults.table import hold_back
from tests.rig.replayed import replay

pytestmark = pytest.mark.compiled_only  # the twin takes minutes otherwise


def changed(run, table, row, **values):
    """The same run with other numbers in one row."""
    tables = dict(run.tables) | {table: run.tables[table].copy()}
    for name, value in values.items():
        tables[table][name][row] = value
    return dataclasses.replace(run, tables=tables)


def balancing(run):
    return int(np.flatnonzero(run.tables["tick"]["state"] == 7)[0])


@pytest.fixture(scope="module")
def run(rig_log):
    return RunLog.load(rig_log, damaged=True)


def test_a_whole_course_comes_out_bit_for_bit(run):
    found = replay(run, shipped_policy())
    assert found == (len(run.tables["tick"]), True, None)


def test_a_log_that_breaks_off_comes_out_as_far_as_it_goes(broken_off):
    run = RunLog.load(broken_off, damaged=True)
    found = replay(run, shipped_policy())
    assert found == (len(run.tables["tick"]), False, None)


def test_the_first_difference_is_named_with_its_tick(run):
    tick = balancing(run) + 20
    other = changed(run, "tick", tick, u=1.25)
    first = replay(other, shipped_policy()).difference
    assert (first.tick, first.what, first.logged) == (tick, "u", 1.25)
    assert first.time == run.tables["tick"]["time"][tick]
    assert first.replayed == run.tables["tick"]["u"][tick]


def test_a_run_on_a_twin_comes_out_bit_for_bit():
    log = simulate_run(shipped_policy(), world="twin:harsh", seed=4, duration=1.0)
    assert replay(log, shipped_policy()) == (len(log.time), True, None)
    other = changed(log, "tick", 30, u=log.u[30] + 0.5)
    first = replay(other, shipped_policy()).difference
    assert (first.tick, first.what) == (30, "u")


STALLS = {
    "loop": lambda harness: harness.clock.stalls.extend((0.05, 0.0, 0.0)),
    "second setpoint": lambda harness: harness.clock.stalls.extend((0.0, 0.05)),
    "encoder": lambda harness: hold_back(harness, "sensor"),
    "link": lambda harness: hold_back(harness, "robot"),
}


@pytest.mark.parametrize(
    "stall",
    [
        "loop",
        *(pytest.param(s, marks=pytest.mark.slow) for s in ("link", "second setpoint", "encoder")),
    ],
)
def test_a_run_with_stalls_replays_to_the_bit(tmp_path, stall):
    scenario = Scenario(duration=1.5, out=tmp_path / "run.mcap")
    harness = FaultHarness(scenario, (Trigger("balancing", 0.5), STALLS[stall]))
    assert harness.run().outcome == "lasted"
    log = RunLog.load(scenario.out)
    ticks, rows = len(log.tables["tick"]), len(log.tables["stream"])
    assert (rows < 2 * ticks) is (stall in ("second setpoint", "link"))
    replayed = replay(log, scenario.policy)
    assert replayed.difference is None
    assert replayed.ticks == ticks
