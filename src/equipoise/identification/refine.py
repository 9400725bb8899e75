r"""Refinement of a policy's model from the log of a run.

This is the future work of Safeea & Neto: from the robot back to the simulation. A log holds the
setpoints of the joints, their measured angles, and the encoder's counts. From these are identified

1. the pendulum's w2 by a regression of its equation. The pivot follows from the measured
   joints; phi in space is the encoder's angle plus the tilt of the flange;
2. the actuator: delay, cycle, and the lags of the joints that move. Balancing moves few joints; the
   others keep their lags.

A parameter has moved if it differs beyond both 95 % intervals, corrected for the number of
parameters, and beyond the range of the training.

**The regression** of the pendulum's equation on a log of balancing, with a moving pivot.

.. math:: \ddot\varphi = w_2 (\sin\varphi - \ddot x \cos\varphi / g) - c\,\dot\varphi
          - f\,\mathrm{sign}\,\dot\varphi

phi from upright and x, the *measured* pivot, positive the same way (Safeea & Neto, section 3.2). A
rigid pendulum has k = w2 / g: while a policy balances, phi and x_ddot are correlated, and separate
estimates of w2 and k would be poor. The equation is linear in its parameters. Two additional terms
model errors of the log: the zero error of the encoder and the latency of x. The equation does not
hold for a flange that tilts or rises: add the tilt to phi; vertical motion is not modelled.

The log holds no accelerations. Direct differentiation amplifies the encoder's steps beyond the
motion of a balanced pendulum. Smoothing first removes different parts of the motion from phi and x
than from sin phi, and biases w2 by some percent. The weak form avoids both: the equation is
multiplied by a smooth window and integrated. Cubic splines through the samples give every term; by
integration by parts, their second derivatives under the window equal the samples under its second
derivative. All terms see the same window.
"""

from collections.abc import Mapping, Sequence
from math import sqrt
from typing import Final, NamedTuple

import numpy as np

from equipoise.arm.arm import FREE_JOINTS, Arm
from equipoise.arrays import Array
from equipoise.control.policy import TabularPolicy
from equipoise.errors import ArtefactError, RecordingError
from equipoise.files import Estimate, Value
from equipoise.identification.actuator import LEAST_SPEED, identify_actuator, speed_ranges
from equipoise.identification.least_squares import half_width, jackknife
from equipoise.log.run_log import RunLog
from equipoise.model.actuator import Actuator
from equipoise.model.encoder import theta_from_counts
from equipoise.model.pendulum import Pendulum
from equipoise.settings import GRAVITY

WINDOW: Final = 0.3
"""Length of the smooth window [s]. Shorter windows pass the encoder's steps; longer windows lose
the fast part of the motion, and dry friction with it."""
MIN_BLOCKS: Final = 8
"""Minimum number of blocks; the scatter of fewer blocks is meaningless."""
MAX_UNEXPLAINED: Final = 0.7
"""Largest accepted unexplained fraction of the acceleration; more indicates another motion. A
pendulum that moves by two counts of its encoder leaves 0.5."""
ROUGH_FIT: Final = 0.1
"""Unexplained fraction above which friction is indistinguishable from noise. Balancing with a table
leaves 0.01."""

W2, C, COULOMB, ZERO, LATE = range(5)
"""Indices of the coefficients: w2, the frictions, w2 times the zero error, k times the latency."""


class ClosedLoopFit(Value):
    """Pendulum parameters from a closed-loop log, with 95 % intervals."""

    w2: Estimate
    """Gravity over inertia, m g l / I [1/s^2]."""
    k: Estimate
    """Coupling to the pivot's acceleration, w2 / g [1/m]."""
    c: Estimate
    """Viscous friction over inertia [1/s]."""
    coulomb: Estimate
    """Coulomb friction over inertia [1/s^2]."""
    zero: Estimate
    """Zero error of the encoder: phi as read minus true [rad]."""
    late: Estimate
    """Latency of x relative to phi [s]."""
    duration: float
    """Length of the log [s]."""
    samples: int
    """Number of samples of the log."""
    unexplained: float
    """Root mean square residual over the root mean square acceleration."""
    warnings: tuple[str, ...] = ()
    """Warnings about a poor log, with remedies."""


def regress(time: Array, phi: Array, x: Array, *, g: float = GRAVITY) -> ClosedLoopFit:
    """Regress the pendulum's equation on a log with a moving pivot.

    The intervals come from a jackknife over blocks of time. That of w2 extends to the regression
    with exchanged roles: noise on the regressors biases one regression low and the other high
    (Frisch). Both agree on a log with enough motion.

    Args:
        time: Time stamps [s], increasing, shape (n,).
        phi: Measured angle from upright [rad], shape (n,).
        x: Measured, not commanded, displacement of the pivot [m], shape (n,).
        g: Acceleration of gravity [m/s^2].

    Returns:
        The parameters, with 95 % intervals.

    Raises:
        RecordingError: The log is too short, its samples cannot be used, or it does not follow the
            equation.
    """
    from scipy.interpolate import CubicSpline

    finite = all(len(values) == len(time) and np.all(np.isfinite(values)) for values in (phi, x))
    if not finite or len(time) < 16 or not np.all(np.diff(time) > 0.0):
        raise RecordingError(
            f"the log has {len(time)} samples, expected at least 16 finite ones whose time "
            "increases; sort it and leave broken and repeated samples out"
        )
    # A board sends every millisecond, with stamps that err by a third of that, which a spline
    # through all samples would fit. The equation of the pendulum is nearly linear, so that averages
    # of its terms over about 10 ms satisfy it.
    every = max(round(0.01 / float(np.median(np.diff(time)))), 1)
    used = len(time) // every * every
    time, phi, x = (
        part[:used].reshape(-1, every).mean(axis=1) for part in (time, np.unwrap(phi), x)
    )
    length = float(np.ptp(time))
    # A block of 2 s is longer than the correlation of the motion.
    blocks = max(round(length / 2.0), MIN_BLOCKS)
    # The latency is linearised, so x is shifted by the first estimate and solved again.
    values, *_ = _solve(*_averaged(time, phi, x, g)[1:])
    late = float(values[LATE] / values[W2]) * g
    moved = CubicSpline(time, x)(np.clip(time + late, time[0], time[-1]))
    when, M, y = _averaged(time, phi, moved, g)
    values, residual, unexplained = _solve(M, y)
    w2 = float(values[W2])
    spread = jackknife(M, residual, when, blocks)
    # Increase of the slope in a regression of gravity's term on all others.
    inverse = float(np.linalg.pinv(M.T @ M, hermitian=True)[0, 0])
    reach = float(residual @ residual) * inverse / w2

    def estimate(
        place: int, factor: float = 1.0, offset: float = 0.0, reach: float = 0.0
    ) -> Estimate:
        """Return a coefficient times a factor, with its interval."""
        value = offset + factor * float(values[place])
        half = half_width(factor**2 * float(spread[place, place]), blocks)
        low, high = value - half, value + half + reach
        return Estimate(value=value, low=low, high=high, source="identified")

    late_x = estimate(LATE, g / w2, offset=late)
    warnings: list[str] = []
    if unexplained > ROUGH_FIT:
        warnings.append(
            f"the equation leaves {unexplained:.0%} of the acceleration unexplained, expected "
            f"less than {ROUGH_FIT:.0%}: friction is hidden in noise, and w2 is rough; let the "
            "pendulum move more, use a finer encoder, or look at encoder_sign in rig.toml"
        )
    if max(late_x.low, -late_x.high) > 0.002:  # [s]
        warnings.append(
            f"x comes {1e3 * late_x.value:.1f} ms later than the phi of its time stamp (negative:"
            " earlier); the fit allows for it, but look at the clocks"
        )
    return ClosedLoopFit(
        w2=estimate(W2, reach=reach),
        k=estimate(W2, 1.0 / g, reach=reach / g),
        c=estimate(C),
        coulomb=estimate(COULOMB),
        zero=estimate(ZERO, 1.0 / w2),
        late=late_x,
        duration=length,
        samples=len(time),
        unexplained=unexplained,
        warnings=tuple(warnings),
    )


def _averaged(time: Array, phi: Array, x: Array, g: float) -> tuple[Array, Array, Array]:
    """Return the equation averaged over a moving window, without gaps.

    Returns:
        Times [s], shape (n,), the regressors of the coefficients, shape (n, 5), and phi_ddot,
        shape (n,).

    Raises:
        RecordingError: The log is too short.
    """
    from scipy.interpolate import CubicSpline
    from scipy.signal import oaconvolve

    usual = float(np.median(np.diff(time)))
    # Four points per sample integrate a window to rounding error.
    step = usual / 4
    fine = np.arange(time[0], time[-1], step)
    angle, pivot = CubicSpline(time, phi), CubicSpline(time, x)
    sine, cosine = np.sin(angle(fine)), np.cos(angle(fine))
    phi_dot, x_ddot = angle(fine, 1), pivot(fine, 2)
    # Longer windows miss short swings, and half of the dry friction with them; shorter windows pass
    # the encoder's steps.
    rate = oaconvolve(phi_dot, _bump(0.06, step), "same")
    # To first order, a zero error rotates gravity and the pivot's acceleration relative to phi, and
    # a latency tau of x subtracts tau x_dddot.
    terms = [sine - x_ddot * cosine / g, -phi_dot, -np.sign(rate)]
    terms += [-cosine - x_ddot * sine / g, -pivot(fine, 3) * cosine]
    steps = np.diff(time)[np.searchsorted(time, fine, side="right") - 1]
    gap = np.asarray(steps > 3.5 * usual, dtype=np.float64)
    columns = np.stack([fine - time[0], *terms, angle(fine, 2), gap], axis=1)
    bump = _bump(WINDOW, step)[:, None]
    if len(bump) <= len(fine):
        means = np.asarray(oaconvolve(columns, bump, "valid", axes=0))[::4]
        rows = means[means[:, -1] < 1e-6]  # convolution by FFT leaves 1e-17 outside gaps
        if len(rows) and np.ptp(rows[:, 0]) >= MIN_BLOCKS * WINDOW:
            return rows[:, 0], rows[:, 1:6], rows[:, 6]
    raise RecordingError(
        f"the log holds {np.ptp(time):.2f} s, expected at least {(MIN_BLOCKS + 2) * WINDOW:.1f} s "
        "without gaps; balance for longer"
    )


def _bump(length: float, step: float) -> Array:
    """Return a smooth window (1 - s^2)^3 of length `length` [s] and sum one."""
    n = max(round(length / step), 4)
    bump = (1.0 - np.linspace(-1.0, 1.0, n + 1)[1:-1] ** 2) ** 3
    return bump / np.sum(bump)


def _solve(M: Array, y: Array) -> tuple[Array, Array, float]:
    """Return the coefficients, shape (5,), the residual, shape (n,), and its fraction of y.

    Raises:
        RecordingError: The log does not follow the equation.
    """
    values = np.linalg.lstsq(M, y, rcond=None)[0].astype(np.float64)
    residual = y - M @ values
    w2, left = float(values[W2]), float(np.linalg.norm(residual) / max(np.linalg.norm(y), 1e-12))
    if w2 <= 0.0 or left > MAX_UNEXPLAINED:
        raise RecordingError(
            f"the pendulum's equation leaves {left:.0%} of the acceleration unexplained "
            f"(w2 = {w2:.3g} 1/s^2), expected less than {MAX_UNEXPLAINED:.0%}: the pendulum "
            "stands too still for its encoder, or phi and x do not belong together; look at "
            "their units, signs (encoder_sign in rig.toml) and clocks, and that phi is 0 upright"
        )
    return values, residual, left


NORMAL: Final = 1.96
"""Half width of a 95 % interval in standard deviations [-]."""


class ModelMotion(NamedTuple):
    """Measured motion of pendulum and pivot; each of shape (n,)."""

    time: Array
    """Time stamps of the encoder [s]."""
    phi: Array
    """Angle of the pendulum from upright, in space [rad]."""
    x: Array
    """Displacement of the pivot along base x [m]."""


class RefinementFindings(NamedTuple):
    """Model of a policy as identified from logs."""

    fit: ClosedLoopFit
    """The identified pendulum."""
    response: dict[str, Estimate]
    """The identified parameters of the actuator, by name [s]."""
    moves: dict[str, str]
    """A line on each parameter that moved, by name; empty if the model still holds."""
    pendulum: Pendulum
    """The policy's pendulum, with w2 and k of the log if w2 moved."""
    actuator: Actuator
    """The policy's actuator, with all identified parameters if any of them moved."""
    warnings: tuple[str, ...]
    """Limitations of the logs, each with advice."""


def inspect(policy: TabularPolicy, *logs: RunLog) -> RefinementFindings:
    """Identify the model of a policy from the logs of runs on one rig, and compare.

    Args:
        policy: The policy, with its pendulum, arm and actuator.
        logs: The runs; of several, those that identify no pendulum are left out with a warning.

    Raises:
        ArtefactError: A log is of another arm.
        RecordingError: No log identifies the pendulum.
    """
    plant, arm = policy.settings.plant, policy.arm
    pendulum, actuator = policy.pendulum, policy.actuator
    fits, responses, warnings = list[ClosedLoopFit](), list[dict[str, Estimate]](), list[str]()
    for number, log in enumerate(logs, start=1):
        name = f"run {number}: " if len(logs) > 1 else ""
        try:
            fit = regress(*read_motion(log, arm), g=pendulum.g)
        except RecordingError as error:
            if len(logs) == 1:
                raise
            warnings.append(f"{name}{error}")
            continue
        fits.append(fit)
        warnings += [name + warning for warning in fit.warnings]
        # An ideal arm has no actuator to compare with.
        if actuator.kind != "ideal":
            try:
                responses.append(read_response(log, arm, actuator))
            except RecordingError as error:
                warnings.append(f"{name}the log does not identify the actuator: {error}")
    if not fits:
        raise RecordingError("none of the runs identifies the pendulum; balance for longer")
    of_all = {
        "duration": sum(fit.duration for fit in fits),
        "samples": sum(fit.samples for fit in fits),
        "unexplained": max(fit.unexplained for fit in fits),
    }
    means = combine([{n: one for n, one in fit if isinstance(one, Estimate)} for fit in fits])
    fit = fits[0].model_copy(update=means | of_all)
    response, known = combine(responses), _numbers(actuator, arm)
    # The friction of a balanced pendulum is hardly known, and not compared.
    of_w2 = (pendulum.w2, fit.w2, plant.inertia_sigma * pendulum.w2.value)
    moves = significant_moves({"w2": of_w2}, "1/s^2")
    pairs: dict[str, tuple[Estimate, Estimate, float]] = {}
    for name, now in response.items():
        # The range of the delay covers lags too: to slow motion both are equivalent.
        varied = 0.0 if name == "cycle" else plant.delay_spread
        varied += 0.0 if name == "delay" else plant.lag_spread * known[name].value
        pairs[name] = known[name], now, varied
    responded = significant_moves(pairs, "s")
    if moves:
        covariance = np.array(pendulum.covariance)
        covariance[0, :] = covariance[:, 0] = 0.0
        covariance[0, 0] = (fit.w2.half_width / NORMAL) ** 2
        changes = {"w2": fit.w2, "k": fit.k, "covariance": tuple(map(tuple, covariance.tolist()))}
        # A new inertia has no mass and length.
        gone = dict.fromkeys(("fit", "friction", "mass", "length", "inertia"))
        pendulum = pendulum.model_copy(update=changes | gone)
    if responded:
        delay, cycle, *lags = (known | response).values()
        new = {"delay": delay, "cycle": cycle, "lags": tuple(lags), "fit": None}
        actuator = actuator.model_copy(update=new)
    moved = moves | responded
    return RefinementFindings(fit, response, moved, pendulum, actuator, tuple(warnings))


def combine(found: Sequence[Mapping[str, Estimate]]) -> dict[str, Estimate]:
    """Return the mean of independent estimates of each number, weighted by their intervals.

    Where they scatter by more than their intervals say, its interval grows by as much.
    """
    means: dict[str, Estimate] = {}
    for name in dict.fromkeys(name for estimates in found for name in estimates):
        first, *others = estimates = [one[name] for one in found if name in one]
        means[name] = first
        if others:
            values = np.array([estimate.value for estimate in estimates])
            weights = np.array([max(one.half_width, 1e-12) for one in estimates]) ** -2.0
            mean = float(np.average(values, weights=weights))
            scatter = NORMAL**2 * float(weights @ (values - mean) ** 2) / len(others)
            half = sqrt(max(scatter, 1.0) / float(weights.sum()))
            means[name] = Estimate.around(mean, half, first.source)
    return means


def read_motion(log: RunLog, arm: Arm) -> ModelMotion:
    """Return the motion of pendulum and pivot from the measurements of encoder and joints.

    Args:
        log: A run on a rig.
        arm: Its arm, with the home posture of the run.

    Raises:
        ArtefactError: The log is of another arm.
        RecordingError: The log has no measurements.
    """
    from scipy.interpolate import CubicSpline

    conditions, ran = log.conditions, log.conditions.arm
    # The iiwa 7 and the iiwa 14 have joints of the same names.
    of_policy = (arm.name, tuple(joint.name for joint in arm.joints), arm.held_joint)
    if (ran.name, conditions.joints, ran.held_joint) != of_policy:
        raise ArtefactError(
            f"the run was on an {ran.name} with joint {ran.held_joint} held, and the "
            f"policy is for an {arm.name} with joint {arm.held_joint} held; give a run on that arm"
        )
    # A tick without a new sample reads the previous one again.
    time, first = np.unique(log.encoder.time, return_index=True)
    measured, of = np.unique(log.replies.time, return_index=True)
    inside = time >= np.min(measured, initial=np.inf)
    inside &= time <= np.max(measured, initial=-np.inf)
    if conditions.counts_per_rev is None or np.count_nonzero(inside) < 2 or len(measured) < 2:
        raise RecordingError(
            f"the log holds {len(time)} encoder counts and {len(measured)} measured postures (world"
            f" {conditions.world}), expected a run on a rig; run the policy on one, or on a twin"
        )
    theta = theta_from_counts(log.encoder.counts[first].astype(float), conditions.counts_per_rev, 1)
    phi = np.mod(2.0 * np.pi - theta, 2.0 * np.pi) - np.pi
    x, tilt = CubicSpline(measured, _pivot(log.replies.q[of], arm))(time[inside]).T
    return ModelMotion(time[inside], phi[inside] + tilt, x)


def _pivot(q: Array, arm: Arm) -> Array:
    """Return x of the pivot from home [m], and the tilt of the flange [rad], shape (n, 2).

    The tilt is a rotation about base y, the axis of the spindle; the encoder does not measure it.

    Args:
        q: All joints [rad], shape (n, joints).
        arm: The arm.
    """
    free = list(arm.free)
    poses = [arm.kinematics(posture) for posture in q[:, free]]
    position = np.array([pose.position for pose in poses])
    rotation = np.array([pose.rotation for pose in poses])
    home, outward = arm.kinematics(arm.home_free), np.array(arm.pivot)
    x = (position + rotation @ outward - home.position - home.rotation @ outward)[:, 0]
    turn = rotation @ home.rotation.T
    return np.stack([x, np.arctan2(turn[:, 0, 2], turn[:, 2, 2])], axis=1)


def read_response(log: RunLog, arm: Arm, known: Actuator) -> dict[str, Estimate]:
    """Return the parameters of the actuator that a run identifies, by name [s].

    Args:
        log: A run on a rig.
        arm: Its arm.
        known: An actuator of the same kind.

    Raises:
        RecordingError: The joints moved too little, or did not follow their setpoints.
    """
    free, stream, replies = np.array(arm.free), log.stream, log.replies
    speeds = speed_ranges(stream.time, stream.q[:, free])
    moving = np.flatnonzero(speeds >= LEAST_SPEED).tolist()
    if not moving:
        raise RecordingError(
            f"no joint's velocity ranges over {LEAST_SPEED} rad/s; let the pendulum move more, or "
            "record a run with equipoise deploy --excite"
        )
    # The fit needs six moving joints: the first of these replaces those at rest.
    joints = free[[j if j in moving else moving[0] for j in range(FREE_JOINTS)]]
    sent, measured = (np.column_stack((part.time, part.q[:, joints])) for part in (stream, replies))
    actuator = identify_actuator(sent, measured, source=log.digest, kind=known.kind)
    still = [f"lag of {arm.free_joints[j].name}" for j in range(FREE_JOINTS) if j not in moving]
    return {
        name: estimate
        for name, estimate in _numbers(actuator, arm).items()
        if name not in still and estimate.source == "identified"
    }


def _numbers(actuator: Actuator, arm: Arm) -> dict[str, Estimate]:
    """Return delay, cycle and lags of an actuator by name [s]."""
    lags = {
        f"lag of {joint.name}": lag
        for joint, lag in zip(arm.free_joints, actuator.lags, strict=True)
    }
    return {"delay": actuator.delay, "cycle": actuator.cycle, **lags}


def significant_moves(
    pairs: Mapping[str, tuple[Estimate, Estimate, float]], unit: str
) -> dict[str, str]:
    """Return a line on each significant change of a value beyond the range of the training.

    Args:
        pairs: Values before and now, and that range, by name.
        unit: Unit of the values.
    """
    from scipy.stats import norm

    limit = float(norm.isf(0.025 / max(len(pairs), 1)))
    moves: dict[str, str] = {}
    for name, (before, now, varied) in pairs.items():
        low, high = sorted((before, now), key=lambda estimate: estimate.value)
        # In standard deviations, from the facing halves of the intervals.
        halves = float(np.hypot(low.high - low.value, high.value - high.low))
        z = NORMAL * (high.value - low.value) / max(halves, 1e-300)
        if z > limit and high.value - low.value > varied:
            was, is_now = (f"{e.value:.4g} [{e.low:.4g}, {e.high:.4g}]" for e in (before, now))
            moves[name] = f"{name} moved from {was} to {is_now} {unit} (95 %, z = {z:.1f})"
    return moves
