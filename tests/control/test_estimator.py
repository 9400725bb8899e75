"""Gains of the observer against an independent recursion, and against all other gains."""

import numpy as np
import pytest

from equipoise.control.estimator import observer_gains
from equipoise.model.pendulum import PendulumParameters
from equipoise.settings import ControllerSettings
from tests.reference.closed_loop import gains as slow_gains

H = 0.01
PENDULUM = PendulumParameters(w2=70.2, k=7.15, c=0.15)
PENDULA = [
    PENDULUM,
    PendulumParameters(w2=20.0, k=2.0, c=0.0),
    PendulumParameters(w2=150.0, k=16.0, c=1.0),
]


@pytest.mark.parametrize(
    ("pendulum", "counts"), list(zip(PENDULA, [8192, 4096, 100_000], strict=True)), ids=str
)
@pytest.mark.parametrize("estimates_bias", [True, False])
def test_gains_are_those_to_which_the_riccati_recursion_converges(pendulum, counts, estimates_bias):
    settings = ControllerSettings(estimate_bias=estimates_bias)
    ours = observer_gains(pendulum, counts, H, estimate_bias=estimates_bias)
    # 1e-9: the recursion stops at changes of 1e-13, a thousandth of what is then left.
    np.testing.assert_allclose(ours, slow_gains(pendulum, settings, counts, H), rtol=1e-9)
    assert (ours[2] == 0.0) == (not estimates_bias)
