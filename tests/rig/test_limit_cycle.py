"""Limit cycle of a balanced pendulum: made-up motions of known period and amplitudes."""

import numpy as np
import pytest

from equipoise.rig.limit_cycle import limit_cycle
from tests.logs.made_up import changed_table, made_up

TIME = 0.01 * np.arange(6000)
RUN = made_up(len(TIME))


@pytest.mark.parametrize("period", [0.35, 2.5])
def test_a_cycle_is_measured_beside_a_drift(period):
    turns = 2.0 * np.pi * TIME / period
    noise = np.random.default_rng(0).normal(0.0, 0.002, len(TIME))
    x = 0.05 * np.sin(TIME / 8.0) - 0.004 * np.sin(turns)
    found = limit_cycle(changed_table(RUN, "tick", estimated_phi=0.02 * np.sin(turns) + noise, x=x))
    assert found == pytest.approx((period, 0.004, 0.02), rel=0.05)


def test_neither_noise_nor_a_drift_is_a_cycle():
    assert limit_cycle(RUN) is None
    drift = changed_table(RUN, "tick", estimated_phi=0.02 * np.sin(TIME / 2.0))
    assert limit_cycle(drift) is None
    assert limit_cycle(made_up(1)) is None
