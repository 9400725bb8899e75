"""The controller of a rig: counts that come late, and the arm that comes to rest in a pause."""

from math import pi

import numpy as np
import pytest

from equipoise.control.control_step import make_controller_params
from equipoise.control.controller import Controller
from equipoise.control.policy import shipped_policy
from equipoise.model.worlds import pendulum_on, read_world
from equipoise.rig.simulated_rig import Bodies, SimulatedRig

pytestmark = pytest.mark.compiled_only

POLICY = shipped_policy()
ARM, H, COUNTS = POLICY.arm, POLICY.h, 8192
PARAMS = make_controller_params(
    ARM, POLICY.settings, POLICY.actuator, POLICY.pendulum.parameters(),
    h=H, counts_per_rev=COUNTS,
)  # fmt: skip
PUSHES = [1.5, -0.5, 0.0, 2.0, -1.0, -2.0, 1.0, 0.5, -1.5, 0.0, 1.0, -0.5]


def controller():
    made = Controller(ARM, PARAMS, POLICY.settings.boxes)
    made.begin(0.02, -0.1)
    return made


def counted(tick):
    """Counts and their age at a tick, of a pendulum that sways."""
    phi = 0.02 * np.cos(0.7 * tick)
    return float(round((pi - phi) * COUNTS / (2.0 * pi))), 0.001


@pytest.mark.parametrize("late", [0, 3])
def test_counts_that_come_late_count_as_if_they_had_come_in_time(late):
    """Those of five ticks: all at once, or the first ones a few ticks after their own."""
    in_time, behind = controller(), controller()
    for tick, u in enumerate(PUSHES):
        in_time.observe(counted(tick), (ARM.home, 0.004))
        stalls = 4 <= tick <= 8
        newest = (tick - late if late else 3) if stalls else tick

        def before(back, tick=tick, newest=newest):
            then = tick - round(back / H)
            return counted(then) if then <= newest else None

        behind.observe(None if stalls else counted(tick), (ARM.home, 0.004), before)
        assert (behind.estimate == in_time.estimate) is not stalls
        in_time.command(u)
        behind.command(u)


@pytest.mark.parametrize("unsent", [False, True])
def test_in_a_pause_the_model_comes_to_rest_with_the_twins_arm(unsent):
    world = read_world("twin:nominal")
    pendulum = pendulum_on(POLICY.pendulum, world.settings)
    rig = SimulatedRig(Bodies(ARM, pendulum, world.settings, ARM.home_free, 0.0, 0))
    rig.body.servo(True)
    own, delay = controller(), POLICY.actuator.delay.value
    for tick in range(20):
        own.observe(counted(tick), (ARM.home, 0.004))
        first, second = own.command(1.0)
        last = first if unsent and tick == 19 else second
        for setpoint in (first, last):
            rig.body.target(setpoint)
            rig.advance(rig.now + 0.5 * H)
    assert rig.twin.truth().x_dot > 0.1
    own.rest(last, 4, unsent)
    rig.advance(rig.now + 4 * H)
    own.observe(counted(24), (ARM.home, 0.004))
    assert own.x_dot == 0.0
    assert own.x == pytest.approx(rig.twin.truth().x, abs=2e-3)
    # The estimate of the observer is that of the arm now, a delay behind the command.
    assert own.estimate.pivot_v == pytest.approx(rig.twin.truth().x_dot, abs=0.01)
    assert delay < 2 * H
