"""Policies of every kind on a virtual rig: balance, replay, and the stop where they fail."""

import sys
import time

import numpy as np
import pytest

from equipoise import RunLog, bind_policy, load_policy, shipped_policy
from equipoise.errors import InputError
from equipoise.outcomes import Phase
from equipoise.rig.checks import warm_up
from equipoise.rig.connection import connect
from equipoise.rig.run import run_virtually
from equipoise.rig.run_controller import PHASES
from tests.conftest import tiers
from tests.rig.test_run import request

BALANCE = load_policy("lqr")


class Failing:
    """The LQR, until it fails after half a second."""

    def __init__(self, fail):
        self._fail, self._ticks, self.clock = fail, 0, None

    def reset(self):
        self._ticks = 0

    def act(self, observation):
        self._ticks += 1
        return self._fail(self) if self._ticks > 50 else BALANCE.act(observation)


def raises(policy):
    raise RuntimeError("the gain\nis lost")


def exits(policy):
    sys.exit(1)


def is_late(policy):
    policy.clock.wait_until(policy.clock.now() + 0.006)
    return 0.0


FAILURES = {
    raises: "the policy failed: Failing raised RuntimeError",
    exits: "the policy failed: Failing raised SystemExit: 1",
    lambda policy: np.nan: "Failing returned nan",
    is_late: "the policy failed: it took 6.0 ms, expected at most 5.0 ms",
}


@pytest.mark.parametrize("fail", tiers(FAILURES, [raises], FAILURES))
def test_a_policy_that_fails_ends_in_the_latched_stop_with_the_arm_at_rest(tmp_path, fail):
    failing = Failing(fail)
    wanted, out = request(bind_policy(failing, name="Failing"), 5.0), tmp_path / "run.mcap"
    rig = connect(wanted)
    failing.clock = rig.clock
    result, log = run_virtually(wanted, out, rig=rig), RunLog.load(out, damaged=True)
    assert (result.outcome, result.stoppable, result.exit_code) == ("policy failed", True, 1)
    assert FAILURES[fail] in result.reason
    assert result.survival == pytest.approx(0.5)
    tick = log.tables["tick"]
    stopping = tick["state"] == PHASES.index(Phase.STOPPING)
    first = int(np.argmax(stopping))
    assert stopping[first:].all()
    assert tick["u"][first] == np.abs(tick["dq"][-1]).max() == 0.0


def test_a_policy_that_fails_or_is_slow_is_refused_before_the_arm_moves():
    def sleeps(observation):
        time.sleep(0.008)
        return 0.0

    for function, says in (
        (lambda _: 1 / 0, "ZeroDivisionError"),
        (sleeps, r"takes .* ms, expected at most 5\.0"),
    ):
        with pytest.raises(InputError, match=says):
            warm_up(request(bind_policy(function, name="mine")))
    warm_up(request(shipped_policy()))
