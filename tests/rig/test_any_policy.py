"""Policies of every kind on a virtual rig: balance, replay, and the stop where they fail."""

import sys
import time

import numpy as np
import pytest

from equipoise.control.bound_policy import bind_policy, load_policy
from equipoise.control.policy import shipped_policy
from equipoise.errors import InputError
from equipoise.logs.run_log import RunLog
from equipoise.model.worlds import pendulum_on, read_world
from equipoise.outcomes import Outcome, Phase
from equipoise.rig.config import RigSettings
from equipoise.rig.connection import emulated_rig
from equipoise.rig.explanation import explain
from equipoise.rig.preflight import warm_up
from equipoise.rig.processes import InterruptedPolicy
from equipoise.rig.request import RunRequest
from equipoise.rig.run import run_virtually
from equipoise.rig.run_controller import PHASES
from tests.control.test_bound_policy import KINDS, folder
from tests.rig.replayed import replay

__all__ = ["folder"]

pytestmark = pytest.mark.compiled_only
NOMINAL = read_world("twin:nominal")
BALANCE = load_policy("lqr")


class Silent:
    def notify(self, event):
        pass

    def read_input(self):
        return []


def run(policy, out, duration=1.0, failing=None):
    """Run a policy on a virtual rig; return the result and the log."""
    request = RunRequest(
        policy=policy,
        actuator=policy.actuator,
        settings=RigSettings(),
        robot="twin:nominal",
        encoder=None,
        duration=duration,
        t1=False,
        dry_run=False,
        seed=3,
    )
    pendulum = pendulum_on(policy.pendulum, NOMINAL.settings)
    rig = emulated_rig(NOMINAL, request.settings, pendulum, seed=3).rig
    if failing is not None:
        failing.clock = rig.clock
    result = run_virtually(request, out, rig=rig, operator=Silent())
    return result, RunLog.load(out, damaged=True)


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
    exits: "the policy failed: 1",
    lambda policy: np.nan: "Failing returned nan",
    is_late: "the policy failed: it took 6.0 ms, expected at most 5.0 ms",
}


@pytest.mark.parametrize(
    "name",
    ["guest:Counting", None]
    + [pytest.param(name, marks=pytest.mark.slow) for name in KINDS if name != "guest:Counting"],
)
def test_a_policy_of_any_kind_runs_on_a_virtual_rig_and_its_run_replays(folder, name):
    policy = load_policy(name)
    _, log = run(policy, folder / "run.mcap")
    assert log.conditions.policy == policy.digest
    assert log.conditions.policy_name == policy.name
    found = replay(log, load_policy(name))
    assert found.difference is None
    assert found.whole


@pytest.mark.parametrize(
    "fail",
    [
        fail if fail in (raises, is_late) else pytest.param(fail, marks=pytest.mark.slow)
        for fail in FAILURES
    ],
)
def test_a_policy_that_fails_ends_in_the_latched_stop_with_the_arm_at_rest(tmp_path, fail):
    failing = Failing(fail)
    policy = bind_policy(failing, name="Failing")
    result, log = run(policy, tmp_path / "run.mcap", 5.0, failing)
    assert (result.outcome, result.stoppable, result.exit_code) == ("policy failed", True, 1)
    assert FAILURES[fail] in result.reason
    assert result.lasted == pytest.approx(0.5)
    tick = log.tables["tick"]
    last = tick["state"][-1]
    assert last == PHASES.index(Phase.STOPPING)
    assert np.abs(tick["dq"][-1]).max() == 0.0
    first = int(np.flatnonzero(tick["state"] == last)[0])
    assert (tick["state"][first:] == last).all()
    assert tick["u"][first] == 0.0
    found = explain(log)[0]
    assert found.cause is Outcome.POLICY
    assert result.reason[:40] in found.evidence


# Before and beside the run


def request(policy):
    return RunRequest(
        policy, policy.actuator, RigSettings(), "twin:nominal", None, 1.0, False, False, 3
    )


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


def test_an_endless_loop_of_a_policy_is_interrupted_even_where_it_catches_exceptions():
    def endless(observation):
        while True:
            try:
                sum(range(1000))
            except Exception:
                continue

    policy = InterruptedPolicy(bind_policy(endless), 0.005)
    began = time.perf_counter()
    with pytest.raises(KeyboardInterrupt, match=r"it took more than 5\.0 ms"):
        policy.act(np.zeros(4))
    assert time.perf_counter() - began < 0.5
    quick = InterruptedPolicy(bind_policy(lambda _: 0.5), 0.05)
    assert quick.act(np.zeros(4)) == 0.5
    time.sleep(0.06)  # the timer is off
