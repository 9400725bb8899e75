"""A pendulum from closed-loop logs: real cart-poles, and logs made by SciPy.

The reference values of the cart-poles come with the recordings (README of the data folder).
"""

import functools
from math import pi, radians

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from equipoise.errors import RecordingError
from equipoise.identification.refine import regress, significant_moves
from equipoise.model.pendulum import Pendulum, PendulumParameters
from equipoise.settings import GRAVITY, PlantSettings

# Real cart-poles: swung up and balanced in five seconds. They count phi against x.
# A is the w2 of a published kind of regression.


@pytest.mark.parametrize(("name", "A"), [("rtc", 46.39), ("rtcdist", 46.09)])
def test_real_cart_poles_give_the_published_w2(recordings, name, A):
    path = recordings / "dfki_robust_codesign" / f"cartpole_167332{name}.csv"
    time, against_phi, phi = np.genfromtxt(path, delimiter=",", skip_header=1, usecols=(0, 1, 2)).T
    x = -against_phi
    fit = regress(time, phi, x)
    assert fit.w2.value == pytest.approx(A, rel=0.02)
    assert fit.unexplained < 0.1
    # Seen from behind it is the same pendulum; with one sign wrong the equation does not hold.
    assert regress(time, -phi, -x).w2.value == pytest.approx(fit.w2.value, rel=1e-6)
    wrong = regress(time, phi, -x)
    assert wrong.unexplained > 3.0 * fit.unexplained
    assert any("encoder_sign" in warning for warning in wrong.warnings)


# Known truths, integrated by SciPy: a hanging pendulum on a pivot that is shaken.

TRUTH = PendulumParameters(w2=70.2, k=7.0, c=0.4, coulomb=0.3)
K = TRUTH.w2 / GRAVITY
TONES = np.array([[0.02, 0.9, 0.0], [0.012, 2.3, 1.0], [0.006, 4.1, 2.0]])
"""Amplitude [m], frequency [Hz] and phase of what shakes the pivot."""


def pivot(time, order=0):
    """Return x, or its derivative of an even order."""
    amplitude, frequency, phase = TONES.T[:, :, np.newaxis]
    w = 2.0 * pi * frequency
    return np.sum((-1) ** (order // 2) * w**order * amplitude * np.sin(w * time + phase), axis=0)


@functools.cache
def shaken():
    """Return times, angles and places of the pivot."""

    def law(t, y):
        push = K * pivot(np.array([t]), 2)[0] * np.cos(y[0])
        # Dry friction without its jump, which no integrator likes.
        dry = TRUTH.coulomb * np.tanh(y[1] / 1e-3)
        return [y[1], TRUTH.w2 * np.sin(y[0]) - push - TRUTH.c * y[1] - dry]

    time = np.arange(0.0, 20.0, 0.01)
    solution = solve_ivp(law, (0.0, 20.0), [pi - 0.8, 0.0], t_eval=time, rtol=1e-8, atol=1e-9)
    return time, solution.y[0], pivot(time)


def test_a_noiseless_log_gives_back_what_made_it():
    time, phi, x = shaken()
    wrapped = np.mod(phi + 0.01 + pi, 2.0 * pi) - pi  # an encoder's angle jumps
    assert np.ptp(wrapped) > np.ptp(phi)
    fit = regress(time, wrapped, x)
    assert fit.w2.value == pytest.approx(TRUTH.w2, rel=1e-3)
    assert fit.k.value == pytest.approx(K, rel=1e-3)
    assert fit.c.value == pytest.approx(TRUTH.c, rel=0.02)
    assert fit.coulomb.value == pytest.approx(TRUTH.coulomb, rel=0.05)
    assert fit.zero.value == pytest.approx(0.01, rel=5e-3)
    assert fit.late.value == pytest.approx(0.0, abs=5e-5)
    assert fit.unexplained < 5e-3
    assert fit.warnings == ()


def test_what_does_not_follow_the_equation_is_refused():
    time, phi, x = shaken()
    for log in (
        (time, phi - pi, x),
        (time, np.random.default_rng(1).permutation(phi), x),
        (time[:201], phi[:201], x[:201]),
        (time, np.where(time > 3.0, np.nan, phi), x),
        (time, phi, x[1:]),
        (time[::-1], phi, x),
    ):
        with pytest.raises(RecordingError, match=";"):
            regress(*log)


# What an encoder and joints measure of it: counts, a wrong zero, noise.


def measured(seed):
    rng, (time, phi, x) = np.random.default_rng([3, seed]), shaken()
    count, zero = 2.0 * pi / 8192, rng.uniform(-1.0, 1.0) * radians(0.2)
    phi = np.round((phi + zero) / count) * count
    return regress(time, phi, x + 2.5e-5 * rng.standard_normal(len(x)))


def test_the_intervals_cover_the_truth_of_some_logs():
    fits = [measured(seed) for seed in range(20)]
    # Of 20 intervals at 95 %, fewer than 15 hold the truth with a probability of 3e-4.
    for name, truth in (("w2", TRUTH.w2), ("c", TRUTH.c)):
        estimates = [getattr(fit, name) for fit in fits]
        assert sum(estimate.low <= truth <= estimate.high for estimate in estimates) >= 15
        assert np.mean([one.value for one in estimates]) == pytest.approx(truth, rel=0.02)


@pytest.mark.parametrize(("factor", "moved"), [(0.9, ["w2"]), (1.0, []), (1.1, ["w2"])])
def test_a_shift_of_the_inertia_by_a_tenth_is_flagged_and_none_is_not(factor, moved):
    known = Pendulum.assumed(factor * TRUTH.w2, TRUTH.c).w2
    varied = PlantSettings().inertia_sigma * known.value
    assert list(significant_moves({"w2": (known, measured(0).w2, varied)}, "1/s^2")) == moved
