"""A log goes through the controller again: the same comes out, or the first difference is named."""

import numpy as np
import pytest

from equipoise.control.policy import shipped_policy
from equipoise.log.run_log import RunLog
from equipoise.outcomes import Phase
from equipoise.rig.run_controller import PHASES
from tests.faults.harness import FaultHarness, Scenario, Trigger
from tests.log.made_up import changed_table
from tests.rig.replayed import replay

pytestmark = pytest.mark.compiled_only  # the twin takes minutes otherwise


@pytest.fixture(scope="module")
def run(rig_log):
    return RunLog.load(rig_log, damaged=True)


def test_a_whole_course_comes_out_bit_for_bit(run):
    assert replay(run, shipped_policy()) == (len(run.tables["tick"]), [])


def test_the_first_difference_is_named_with_its_tick(run):
    tick = run.tables["tick"]
    number = int(np.flatnonzero(tick["state"] == PHASES.index(Phase.BALANCING))[0]) + 20
    u = tick["u"].copy()
    u[number] = 1.25
    assert replay(changed_table(run, "tick", u=u), shipped_policy()) == (number, ["u"])


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
