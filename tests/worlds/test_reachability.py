"""The bound on recoverable releases, against SciPy's integrator of the falling pendulum."""

from math import pi

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from equipoise import paper
from equipoise.errors import SettingsError
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator
from equipoise.model.pendulum import PendulumParameters
from equipoise.settings import GRAVITY, Settings
from equipoise.worlds.reachability import check_releases, diverging_angles


def behind(delay):
    return Actuator.assumed("lag", delay=delay, lag=0.0)


@pytest.mark.parametrize(("w2", "c"), [(25.0, 0.01), (70.2, 0.15), (140.0, 0.6)])
def test_a_release_beyond_the_bound_falls_against_the_largest_acceleration(w2, c):
    pendulum = PendulumParameters(w2, w2 / GRAVITY, c)
    bound = pendulum.k * paper.U_MAX / w2

    def end(start, delay=0.05):
        def motion(t, s):
            u = paper.U_MAX if t >= delay else 0.0
            return [s[1], w2 * s[0] - c * s[1] - pendulum.k * u]

        rate = 0.5 * (np.sqrt(c * c + 4.0 * w2) - c)
        phi = start * np.exp(-rate * delay)
        return solve_ivp(motion, (0.0, 1.5), (phi, 0.0), rtol=1e-9, atol=1e-12).y[0, -1]

    assert end(1.01 * bound) > 0.0 > end(0.99 * bound)


def test_a_longer_delay_warns_and_then_refuses():
    pendulum = PendulumParameters(140.0, 140.0 / GRAVITY, 0.1)
    assert check_releases(pendulum, Settings(), IDEAL_ACTUATOR) is None
    assert check_releases(pendulum, Settings(), behind(0.01)) is None
    assert "% of the releases" in check_releases(pendulum, Settings(), behind(0.1))
    for delay, least in ((0.1, 0.99), (0.2, 0.0)):
        with pytest.raises(SettingsError):
            check_releases(pendulum, Settings(), behind(delay), least=least)


def test_friction_and_delay_change_the_angle_as_in_the_falling_pendulum():
    exact = {"delay_spread": 0.0, "lag_spread": 0.0}
    settings = Settings()
    release = {"phi_low": pi / 60, "phi_high": pi / 60, "phi_dot_low": 0.2, "phi_dot_high": 0.2}
    settings = settings.model_copy(
        update={
            "plant": settings.plant.model_copy(update=exact),
            "evaluation": settings.evaluation.model_copy(update=release),
        }
    )
    pendulum = PendulumParameters(70.2, 70.2 / GRAVITY, 0.15, coulomb=0.5)

    def motion(_, s):
        return [s[1], 70.2 * s[0] - 0.15 * s[1] - 0.5]

    phi, phi_dot = solve_ivp(motion, (0.0, 0.04), (pi / 60, 0.2), rtol=1e-10).y[:, -1]
    after = diverging_angles(pendulum, settings, behind(0.04))
    root = np.roots([1.0, 0.15, -70.2])
    assert after == pytest.approx(phi - phi_dot / root.min(), rel=1e-6)


@pytest.mark.parametrize("w2", [1e-6, 1e6, 1e11])
@pytest.mark.parametrize("c", [0.0, 100.0, -100.0])
def test_pendulums_beyond_any_rig_are_judged_without_an_error(w2, c):
    pendulum = PendulumParameters(w2, w2 / GRAVITY, c)
    assert np.isfinite(diverging_angles(pendulum, Settings(), behind(0.02))).all()
