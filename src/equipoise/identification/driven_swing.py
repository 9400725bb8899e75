r"""Self-test of a rig: response of the hanging pendulum to a known motion, and the encoder's zero.

The flange makes a minimum-jerk move of 40 mm in 0.8 s, about a period: the pendulum responds with a
swing of several degrees, which then decays. The *measured* motion of the pivot drives the model,
which is fitted to the encoder:

.. math:: counts(t + \tau) \cdot 2\pi/N = G\,\theta(t) + zero, \qquad
          \ddot\theta = -w_2 \sin\theta - c\,\dot\theta - f\,\mathrm{sign}\,\dot\theta
                        - \frac{w_2}{g} \cos\theta\;\ddot x

G is 1 for the right sign and counts per revolution. The period determines w2, the amplitude G, the
phase tau, the middle of the swing the zero: each fault of a rig shows in one number. The fit also
estimates the friction c, f and the initial state.

The interval of the zero comes from blocks of half a period: errors within a block are
autocorrelated.
"""

from collections.abc import Callable
from enum import Enum
from math import degrees, inf, nan, pi, radians, sqrt
from typing import Final, NamedTuple

import numpy as np

from equipoise.arrays import Array
from equipoise.identification.least_squares import (
    fit_unknowns,
    half_width,
    jackknife,
    sensitivities,
)
from equipoise.jit import kernel
from equipoise.model.pendulum import PendulumParameters, step

MOVE_DISTANCE: Final = 0.04
"""Distance of the flange's move [m]."""
MOVE_TIME: Final = 0.8
"""Duration of the move [s]."""
SWING_TIME: Final = 4.0
"""Observation of the pendulum after the move [s]: five periods."""
COUNTS_TOLERANCE: Final = 0.05
"""Maximum deviation of |G| from 1 [-]: half the smallest mistake, 10 %."""
W2_TOLERANCE: Final = 0.05
"""Maximum relative deviation of w2 [-]: training varies it by 2 % (one standard deviation)."""
DELAY_TOLERANCE: Final = 0.015
"""Maximum |tau| [s]: the prediction has a margin of 5 ms, and 30 ms make it fail."""
ZERO_TOLERANCE: Final = radians(0.5)
"""Maximum distance of the swing's middle from the resting count [rad]: stiction explains 0.1 deg
with a good bearing, and half of the trials survive 0.75 deg."""
ZERO_INTERVAL: Final = radians(0.1)
"""Maximum half width of the zero's interval [rad]."""
MIN_RESPONSE: Final = radians(0.5)
"""Minimum standard deviation of the pendulum's response [rad]; a good one has 2 deg."""
MAX_MISFIT: Final = 0.1
"""Maximum residual as a fraction of the response's standard deviation [-]."""
MODEL_STEP: Final = 0.004
"""Time step of the model [s]: a 190th of a period."""
GAIN, W2, TAU, ZERO, C, COULOMB, THETA, THETA_DOT = range(8)
"""Indices of the unknowns."""
SCALES: Final = np.array([1.0, 70.0, 0.1, 0.1, 1.0, 1.0, 0.1, 1.0])
"""Typical size of each unknown, in its unit."""


class SelfTestVerdict(Enum):
    """Verdict of a self-test."""

    PASSED = "passed"
    """The response is that of the model, and the zero is known."""
    REPEAT = "repeat"
    """The zero's interval is too wide, or samples have a gap: repeat the swing."""
    ZERO = "zero"
    """The pendulum did not hang straight when it was referenced."""
    FAILED = "failed"
    """Another fault of the rig, or a response that is not that of such a pendulum."""


class SelfTest(NamedTuple):
    """Result of a self-test."""

    verdict: SelfTestVerdict
    """First fault found, or PASSED."""
    reason: str
    """Message for the operator."""
    gain: float = nan
    """Gain G, encoder over model [-]."""
    w2: float = nan
    """Gravity over inertia [1/s^2]."""
    delay: float = nan
    """Delay tau of the encoder behind the measured motion [s]."""
    zero: float = nan
    """Counts at which the pendulum hangs, less the resting count [rad]."""
    zero_half: float = inf
    """Half of the width of the 95 % interval of `zero` [rad]."""
    misfit: float = nan
    """Root mean square of the residual over the response's standard deviation [-]."""


@kernel
def driven_swing(
    theta: float, theta_dot: float, u: Array, h: float, pendulum: PendulumParameters
) -> Array:
    """Return theta [rad] before and after each step of length h, u of the pivot held over each."""
    thetas, phi, phi_dot = np.empty(len(u) + 1), pi - theta, -theta_dot
    thetas[0] = theta
    for i in range(len(u)):
        phi, phi_dot = step(phi, phi_dot, u[i], h, pendulum)
        thetas[i + 1] = pi - phi
    return thetas


def self_test(
    time: Array, angle: Array, pivot_time: Array, pivot_x: Array, pendulum: PendulumParameters
) -> SelfTest:
    """Judge the pendulum's response to the motion of its pivot.

    Args:
        time: Times of the encoder samples [s], from before the move until some periods after it,
            shape (n,).
        angle: Angles that the encoder shows, from the resting count [rad], shape (n,).
        pivot_time: Times of the measured joints [s], over at least the same time, shape (m,).
        pivot_x: Place of the pivot along base x, from the measured joints [m], shape (m,).
        pendulum: The identified pendulum; k / w2 is 1 / g.
    """
    if fault := _fault_of_samples(time, angle, pivot_time, pivot_x):
        return SelfTest(SelfTestVerdict.FAILED, fault)
    gap = max(float(np.max(np.diff(times))) for times in (time, pivot_time))
    if gap > 0.05:  # [s]: the pivot's motion is interpolated over it
        reason = f"samples have a gap of {1e3 * gap:.0f} ms, expected 50 ms"
        return SelfTest(SelfTestVerdict.REPEAT, reason)
    response = np.std(angle)
    every = -(-len(time) // 2000)  # counts 2 ms apart suffice
    time, angle = time[::every], angle[::every]
    grid = np.arange(time[0] - 0.15, time[-1] + 0.15, MODEL_STEP)  # [s]: for the searched delays
    u = _acceleration(pivot_time, pivot_x, grid[:-1] + 0.5 * MODEL_STEP)

    def model(unknowns: Array) -> Array:
        """Return the encoder angle [rad], shape (n,)."""
        gain, w2, tau, zero, c, coulomb, theta, theta_dot = map(float, unknowns)
        k = w2 * pendulum.k / pendulum.w2
        # No friction drives: below zero the fit finds nothing better.
        parameters = PendulumParameters(w2, k, max(c, 0.0), max(coulomb, 0.0))
        thetas = driven_swing(theta, theta_dot, u, MODEL_STEP, parameters)
        return gain * np.interp(time - tau, grid, thetas) + zero

    def misfit(unknowns: Array) -> Array:
        return model(unknowns) - angle

    # Blocks of half a period.
    blocks, fitted = int(float(np.ptp(time)) * sqrt(pendulum.w2) / pi), list(range(len(SCALES)))
    start = _guess(model, angle, pendulum)
    # About ten evaluations are usual.
    unknowns = fit_unknowns(misfit, start, fitted, SCALES, xtol=1e-5, ftol=1e-4, max_nfev=30)
    J, residual = sensitivities(misfit, unknowns, fitted, SCALES), misfit(unknowns)
    variance = float(jackknife(J, residual, time, blocks)[ZERO, ZERO])
    # Where two unknowns are indistinguishable, rounding may make a variance negative.
    half = float(SCALES[ZERO]) * half_width(max(variance, 0.0), blocks)
    left = float(np.sqrt(np.mean(residual**2)) / response)
    gain, w2, tau, zero = unknowns[[GAIN, W2, TAU, ZERO]].tolist()
    result = SelfTest(SelfTestVerdict.PASSED, "", gain, w2, tau, zero, half, left)
    return _judged(result, pendulum.w2)


def _fault_of_samples(time: Array, angle: Array, pivot_time: Array, pivot_x: Array) -> str:
    """Return why samples cannot be fitted; empty if they can."""
    for name, times in (("encoder", time), ("pivot", pivot_time)):
        if len(times) < 200 or not np.all(np.diff(times) > 0.0):
            return (
                f"the {name} gave {len(times)} samples, expected 200 or more, at times that "
                "increase"
            )
    moved = float(np.ptp(pivot_x))
    if not 0.5 * MOVE_DISTANCE < moved < 2.0 * MOVE_DISTANCE:
        expected = f"expected {1e3 * MOVE_DISTANCE:g} mm"
        return f"the flange was measured to move by {1e3 * moved:.1f} mm, {expected}"
    away = np.abs(pivot_x - np.median(pivot_x[-len(pivot_x) // 8 :])) > 0.02 * moved
    left = float(time[-1] - pivot_time[np.flatnonzero(away)[-1]])
    if left < 0.5 * SWING_TIME:
        expected = f"expected {SWING_TIME:g} s"
        return f"the pendulum was observed for {left:.1f} s after the move, {expected}"
    response = float(np.std(angle))
    if response < MIN_RESPONSE:
        return (
            f"the encoder moved by {degrees(response):.2f} deg (standard deviation), expected at "
            f"least {degrees(MIN_RESPONSE):g} deg: is the pendulum free, the encoder connected?"
        )
    return ""


def _acceleration(time: Array, x: Array, at: Array) -> Array:
    """Return the acceleration of the measured pivot at some times [m/s^2]; zero outside.

    Twice the derivative of noise is mostly fast, and the pendulum is slow: a spline with knots that
    follow the move is smooth enough.
    """
    from scipy.interpolate import make_lsq_spline

    begin, end = float(time[0]), float(time[-1])
    pieces = max(int((end - begin) / 0.04), 1)  # [s]: a twentieth of the move
    inner = np.linspace(begin, end, pieces + 1)[1:-1]
    knots = np.concatenate(([begin] * 6, inner, [end] * 6))
    u_of = make_lsq_spline(time, x, knots, k=5).derivative(2)
    return np.where((at > begin) & (at < end), u_of(np.clip(at, begin, end)), 0.0)


def _guess(model: Callable[[Array], Array], angle: Array, pendulum: PendulumParameters) -> Array:
    """Return initial unknowns: w2 and tau from a search, G and zero that fit them best.

    The pendulum rests at first, so that the encoder shows its zero.
    """
    best, least = np.zeros(len(SCALES)), inf
    for w2 in pendulum.w2 * np.geomspace(0.4, 2.5, 25):
        for tau in (-0.06, -0.03, 0.0, 0.03, 0.06):
            unknowns = np.array([1.0, w2, tau, 0.0, pendulum.c, 0.0, 0.0, 0.0])
            columns = np.stack([model(unknowns), np.ones_like(angle)], axis=1)
            solution = np.linalg.lstsq(columns, angle, rcond=None)[0]
            left = float(np.sum((angle - columns @ solution) ** 2))
            if left < least:
                unknowns[GAIN], unknowns[ZERO] = solution
                best, least = unknowns, left
    return best


def _judged(result: SelfTest, known_w2: float) -> SelfTest:
    """Return a result with the first fault of its numbers, or that they are sound."""
    _, _, gain, w2, tau, zero, zero_half, misfit = result
    failures = {
        f"the model leaves {misfit:.0%} of the answer, expected less than {MAX_MISFIT:.0%}: is "
        "the pendulum free, and untouched?": not misfit < MAX_MISFIT,
        f"the counts fall where they should grow (G = {gain:.2f}, expected 1); change the "
        "encoder's sign": gain < 0.0,
        f"the encoder shows {gain:.3f} of the answer, expected 1 within {COUNTS_TOLERANCE:g}; "
        "correct its counts per revolution": abs(gain - 1.0) > COUNTS_TOLERANCE,
        f"w2 is {w2:.2f} 1/s^2, expected {known_w2:.2f} 1/s^2 within {W2_TOLERANCE:.0%}; "
        "identify this pendulum": abs(w2 / known_w2 - 1.0) > W2_TOLERANCE,
        f"the encoder is {1e3 * tau:.1f} ms behind the arm, expected 0.0 ms within "
        f"{1e3 * DELAY_TOLERANCE:g} ms; look at its link and clock": abs(tau) > DELAY_TOLERANCE,
    }
    verdict, reason = SelfTestVerdict.PASSED, "the pendulum answers as the model says"
    if any(failures.values()):
        verdict = SelfTestVerdict.FAILED
        reason = next(reason for reason, found in failures.items() if found)
    elif abs(zero) > ZERO_TOLERANCE:
        verdict = SelfTestVerdict.ZERO
        reason = (
            f"the pendulum hangs {degrees(zero):.2f} deg from where it was referenced, expected "
            f"at most {degrees(ZERO_TOLERANCE):g} deg; reference it again, hanging free"
        )
    elif zero_half > ZERO_INTERVAL:
        verdict, half, most = SelfTestVerdict.REPEAT, degrees(zero_half), degrees(ZERO_INTERVAL)
        reason = f"the zero is known to {half:.2f} deg, expected {most:g} deg; swing again"
    return result._replace(verdict=verdict, reason=reason)
