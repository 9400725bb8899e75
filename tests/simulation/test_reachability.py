"""The bound on recoverable releases, against SciPy's integrator of the falling pendulum."""

from math import pi

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from equipoise.errors import SettingsError
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator
from equipoise.model.pendulum import PendulumParameters
from equipoise.settings import GRAVITY, Settings, changed
from equipoise.simulation.reachability import check_releases, diverging_angles


def behind(delay):
    return Actuator.assumed("lag", delay=delay, lag=0.0)


def test_a_longer_delay_warns_and_then_refuses():
    pendulum = PendulumParameters(140.0, 140.0 / GRAVITY, 0.1)
    assert check_releases(pendulum, Settings(), IDEAL_ACTUATOR) is None
    assert check_releases(pendulum, Settings(), behind(0.01)) is None
    assert "% of the releases" in check_releases(pendulum, Settings(), behind(0.1))
    for delay, least in ((0.1, 0.99), (0.2, 0.0)):
        with pytest.raises(SettingsError):
            check_releases(pendulum, Settings(), behind(delay), least=least)


def test_friction_and_delay_change_the_angle_as_in_the_falling_pendulum():
    exact = {"plant.delay_spread": 0.0, "plant.lag_spread": 0.0}
    release = {
        f"evaluation.{name}_{end}": value
        for name, value in (("phi", pi / 60), ("phi_dot", 0.2))
        for end in ("low", "high")
    }
    settings = changed(Settings(), exact | release)
    pendulum = PendulumParameters(70.2, 70.2 / GRAVITY, 0.15, coulomb=0.5)

    def motion(_, s):
        return [s[1], 70.2 * s[0] - 0.15 * s[1] - 0.5]

    phi, phi_dot = solve_ivp(motion, (0.0, 0.04), (pi / 60, 0.2), rtol=1e-10).y[:, -1]
    after = diverging_angles(pendulum, settings, behind(0.04))
    root = np.roots([1.0, 0.15, -70.2])
    assert after == pytest.approx(phi - phi_dot / root.min(), rel=1e-6)
