"""The encoder: exact at its edges, and a simulated swing that is what it says."""

from math import pi

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from equipoise import PendulumParameters, simulate_swing
from equipoise.model.encoder import counts_from_theta, theta_from_counts
from tests.reference import pendulum as reference

PENDULUM = PendulumParameters(w2=70.2, k=7.15, c=0.15)
SWING = {"theta0": 1.0, "duration": 2.0, "rate_hz": 500.0, "counts_per_rev": 4096}


@given(
    theta=st.floats(-20.0, 20.0),
    counts_per_rev=st.sampled_from([500, 4096, 8192]),
    sign=st.sampled_from([-1, 1]),
)
def test_an_angle_comes_back_within_half_a_step(theta, counts_per_rev, sign):
    counts = counts_from_theta(theta, counts_per_rev, sign)
    assert counts == round(counts)
    found = theta_from_counts(counts, counts_per_rev, sign)
    assert abs(found - theta) <= pi / counts_per_rev + 1e-12


def test_a_simulated_swing_is_the_true_one_within_half_a_step():
    swing = simulate_swing(PENDULUM, **SWING, zero_offset=0.1)
    theta, _ = reference.swing(swing.time, 1.0, 0.0, w2=70.2, c=0.15)
    assert np.max(np.abs(swing.theta - 0.1 - theta)) <= pi / 4096 + 1e-9
    assert swing.resolution == 2.0 * pi / 4096
    steps = swing.theta / swing.resolution
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
