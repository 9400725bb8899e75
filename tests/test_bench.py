"""The benchmark: that it measures what it says, and that the peer does the same work.

Speed itself is measured, not tested: it depends on the machine.
"""

import numpy as np
import pytest
from benchmarks.bench import PinocchioLoop

from equipoise import PendulumParameters, iiwa, paper, resolve
from equipoise.model.actuator import IDEAL_ACTUATOR
from equipoise.simulation.plant import make_loop_params
from tests.batch import NOMINAL, Batch

pytestmark = pytest.mark.full

PENDULUM = PendulumParameters(w2=70.2, k=7.16, c=0.1)
QUIET = resolve(overrides=["plant.position_error_sigma=0.0", "plant.orientation_error_sigma=0.0"])


@pytest.mark.parametrize("size", [7, 14])
def test_the_loop_through_pinocchio_moves_the_arm_as_ours_does(size):
    """Both round in each of 1,000 steps, some 1e-15 of a radian; a slip in a formula shows 1e-6."""
    pytest.importorskip("pinocchio")
    arm = iiwa(size)
    peer = PinocchioLoop(arm, QUIET, paper.STEP)
    ours = Batch(make_loop_params(arm, QUIET, paper.STEP, PENDULUM, IDEAL_ACTUATOR))
    ours.reset(PENDULUM, NOMINAL, (0.0, 0.0, 0.0, 0.0))
    rng = np.random.default_rng(5)
    x, x_dot, reached = 0.0, 0.0, 0.0
    for _ in range(1000):
        # Random actions that stay on the track: towards its middle where the arm would leave it.
        ahead = x + x_dot * abs(x_dot) / 2.0
        u = rng.choice(paper.ACTIONS) if abs(ahead) < 0.15 else -np.sign(ahead) * 2.0
        ours.controller.u[0] = u
        ours.step()
        assert peer.run([float(u)]) == 1
        assert peer.q == pytest.approx(ours.controller.q[:, 0], abs=1e-9)
        # u' is a difference of velocities over h = 0.01 s: a hundredth as exact.
        assert peer.tracked == pytest.approx(ours.state.u_tracked[0], abs=1e-7)
        x, x_dot, _, _ = ours.true(0)
        reached = max(reached, abs(x))
    assert peer.within
    assert 0.1 < reached < 0.22
