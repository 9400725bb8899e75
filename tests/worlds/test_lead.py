"""Setpoints that lead, on the twin: where the arm would go if the client died."""

import numpy as np
import pytest

from equipoise.control.baselines import baselines
from equipoise.control.policy import KernelPolicy, shipped_policy
from equipoise.model.actuator import MAX_LEAD, Actuator
from equipoise.model.elementary import BATCH_SIZE
from equipoise.model.worlds import read_world
from equipoise.worlds import setup_of
from equipoise.worlds.twin.world import TwinSimulation

POLICY = shipped_policy()
SLOW = Actuator.assumed("kst", delay=0.010, lag=0.008, cycle=0.04)


def distances(lead, seconds=10.0):
    """Return the largest distance of a joint's setpoint from the arm and from its reference."""
    controller = POLICY.settings.controller.model_copy(update={"lead": lead})
    settings = POLICY.settings.model_copy(update={"controller": controller})
    world = read_world("twin:trajectory40")
    setup = setup_of(POLICY, world, settings, SLOW)
    simulation = TwinSimulation(world, setup, seed=1, stream=7)
    loop, trial = simulation.loop(), simulation.draw(1).trial(0)
    policy = KernelPolicy(baselines(POLICY.pendulum.parameters(), POLICY.h)["LQR, snapped"])
    loop.reset(trial)
    away, ahead = [], []
    for _ in range(round(seconds / POLICY.h)):
        assert loop.step(policy.act(loop.controller.observation[::BATCH_SIZE])) == 0
        last = POLICY.arm.with_held(loop.controller.setpoints[::BATCH_SIZE][6:])
        away.append(np.abs(loop.joints() - last).max())
        ahead.append(np.abs(loop.controller.leads).max())
    return max(away), max(ahead)


@pytest.mark.compiled_only
def test_the_last_target_is_no_farther_from_the_arm_with_a_lead():
    (plain, none), (away, ahead) = distances(False), distances(True)
    assert none == 0.0
    assert 0.005 < ahead < MAX_LEAD
    assert away < plain
