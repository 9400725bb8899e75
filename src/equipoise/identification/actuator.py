r"""Identification of an actuator: excitation of the arm, and a fit to setpoints and positions.

**Excitation.** Each free joint moves about home along two sines under one Hann window, from rest to
rest and up to the joint's top speed. All frequencies differ, and are far from the pendulum's
natural frequency, so that the pendulum keeps hanging. A servo with a shaping law answers a stream
of 5 ms with bursts of twice the joint's mean speed, which the load of the shoulder turns into
torques. The top speeds keep the drives below their limits; drives twice as fast as assumed reach
one for 2 of the 10,000 ms.

**Fit.**

Transport delay, shaping law and drive lags are fitted together to the simulation that training and
controller use (`equipoise.model.actuator`). A linear delay and lag, fitted to an arm behind the
shaping law, would depend on the amplitude of the motion.

1. Search a coarse grid for delay and t_c: with a periodic motion, a delay longer by one period fits
   nearly as well.
2. Fit the whole log by least squares: one delay, one t_c, and for each joint a lag and the constant
   bias of its load. The drives know only the bare arm: a joint that carries a tool sags and follows
   more slowly than its drive alone would. A joint weighs by its residual.
3. Compute intervals from a jackknife over blocks of time, as disturbances are autocorrelated, and
   from the unknown transport jitter.
4. Select the kind of actuator: a lag, unless a servo leaves less beyond chance.

The delay runs from sending a setpoint to its mean effect, independent of the phase of the servo's
cycles. It includes the return path if the reply times are times of *arrival*.
"""

from functools import partial
from hashlib import sha256
from math import exp, sqrt
from operator import itemgetter
from typing import Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.arguments import checked
from equipoise.arm.arm import FREE_JOINTS, Arm
from equipoise.arrays import Array
from equipoise.errors import ArmError, RecordingError
from equipoise.files import DIGEST_PREFIX, Estimate, StrPath
from equipoise.identification.least_squares import (
    blocks_of_time,
    fit_unknowns,
    half_width,
    jackknife,
    sensitivities,
)
from equipoise.log.run_log import RunLog
from equipoise.model.actuator import (
    CYCLE,
    KINDS,
    LAWS,
    Actuator,
    ActuatorFit,
    ActuatorParameters,
    JointResponse,
    Kind,
    track,
)

DELAY, T_C, LAG, LOAD_BIAS = 0, 1, 2, 2 + FREE_JOINTS
"""Indices of the unknowns: the delay, t_c, a lag and a load bias of each joint."""
START, SCALES, LOW, HIGH = np.repeat(
    [
        [0.0, CYCLE, 8e-3, 0.0],
        [1e-2, 1e-3, 1e-2, 1e-1],
        # With less t_c a servo without shaping law and lag oscillates; less lag is over within a
        # cycle.
        [0.0, 6e-4, 3e-4, -np.inf],
        # A robot with more delay or lag cannot balance.
        [0.1, 0.1, 0.1, np.inf],
    ],
    [1, 1, FREE_JOINTS, FREE_JOINTS],
    axis=1,
)
"""Initial guess, scale, lower and upper bound of each unknown, shape (14,)."""
FITTED: Final[dict[Kind, list[int]]] = {
    kind: [place for place in range(len(START)) if place != T_C or kind in LAWS]
    for kind in ("lag", *LAWS)
}
"""Indices of the unknowns of each kind that a log can have: every drive has inertia."""

JITTER: Final = 1e-3
"""Largest deviation of a setpoint's delay from the mean [s], from the servo's cycle and a quiet
network. The log hardly shows it; the intervals allow for twice its square. With a true value of
2 ms the estimated delay is 0.2 ms too short."""
BLOCKS: Final = 20
"""Number of blocks of time: residuals are correlated over some 20 ms, a block of the shortest log
lasts 200 ms."""
MIN_DURATION: Final = 4.25
"""Minimum duration of a log [s], with the settling."""
MAX_GAP: Final = 0.025
"""Largest accepted gap between setpoints or between replies [s]."""
LEAST_SPEED: Final = 0.1
"""Minimum velocity range of each joint [rad/s]: at a single speed, delay and lag of the shaping law
are indistinguishable."""
MIN_MOTION: Final = 0.25
"""Minimum range of each measured joint, as a fraction of the range of its setpoints."""
MAX_UNEXPLAINED: Final = 0.25
"""Largest accepted residual, as a fraction of a joint's motion."""
MAX_T_C_UNCERTAINTY: Final = 0.3
"""Relative half width of the interval of t_c above which t_c stays at the value of the server's
source."""

PERIOD: Final = 0.005
"""Time between two setpoints [s]: half a control step."""
TOP_SPEED: Final = np.array([0.45, 0.3, 0.4, 1.0, 1.0, 1.0])
"""Top speed of each free joint, from the base on [rad/s]; the load falls towards the flange."""
FAST: Final = np.array([16.0, 14.5, 30.0, 12.0, 10.0, 11.0])
"""Angular frequency of the faster sine of each free joint [rad/s]. That of A4 tells the delay from
the time to the setpoint, whose effects differ with its cube."""
SLOW: Final = np.array([6.4, 5.8, 5.2, 4.8, 4.0, 4.4])
"""Angular frequency of the slower sine [rad/s]; the pendulum's own, 8.4 rad/s, lies between."""


def excitation(arm: Arm, duration: float = 10.0, period: float = PERIOD) -> Array:
    """Return setpoints around home that move every free joint, from rest to rest.

    Args:
        arm: The arm with its home posture.
        duration: Time from the first to the last setpoint [s].
        period: Time between two setpoints [s].

    Returns:
        Free joints [rad], shape (m, 6).

    Raises:
        ArmError: A joint's home is too close to its limits.
    """
    t = np.linspace(0.0, duration, round(duration / period) + 1)[:, None]
    order = np.arange(len(FAST))
    sines = np.sin(FAST * t + order) / FAST + np.sin(SLOW * t + 2 * order) / SLOW
    motion = np.sin(np.pi * t / duration) ** 2 * sines
    velocity = np.gradient(motion, period, axis=0)
    acceleration = np.gradient(velocity, period, axis=0)
    limits = np.array([(joint.velocity, joint.acceleration) for joint in arm.free_joints]).T
    limits *= 0.8  # margin
    most = np.minimum(TOP_SPEED, limits[0]) / np.abs(velocity).max(axis=0)
    motion *= np.minimum(most, limits[1] / np.abs(acceleration).max(axis=0))
    q = arm.home_free + motion
    for joint, lowest, highest in zip(arm.free_joints, q.min(axis=0), q.max(axis=0), strict=True):
        if not (joint.lower < lowest and highest < joint.upper):
            raise ArmError(
                f"excitation takes {joint.name} from {lowest:.3g} to {highest:.3g} rad, its limits "
                f"are {joint.lower:.3g} and {joint.upper:.3g} rad; choose a home further inside"
            )
    return q


class Log(NamedTuple):
    """Setpoints and measured positions; rows belong to joints."""

    stream_time: Array
    """Send times of the setpoints [s], shape (m,)."""
    stream_q: Array
    """Setpoints [rad], shape (6, m)."""
    reply_time: Array
    """Measurement times of the positions [s], shape (p,)."""
    reply_q: Array
    """Measured positions [rad], shape (6, p)."""
    time: Array
    """The times that are fitted [s], shape (n,): the last ones, after the simulation settled."""
    measured: Array
    """The positions then [rad], shape (6, n)."""

    def residual(self, kind: Kind, unknowns: Array, spread: float = JITTER) -> Array:
        """Return measured minus predicted positions [rad], shape (6, n)."""
        residual = np.empty_like(self.reply_q)
        for joint, q in enumerate(self.reply_q):
            delay, t_c, lag, bias = unknowns[[DELAY, T_C, LAG + joint, LOAD_BIAS + joint]].tolist()
            servo = ActuatorParameters(KINDS.index(kind), t_c)
            response = JointResponse(delay, lag, servo, spread, bias)
            stream = self.stream_time, self.stream_q[joint]
            residual[joint] = q - track(*stream, self.reply_time, q, response)
        return residual[:, -len(self.time) :]

    def unexplained(self, residual: Array) -> Array:
        """Return the standard deviation of a residual over that of the motion, shape (6,)."""
        return np.std(residual, axis=1) / np.std(self.measured, axis=1)


class JointFit(NamedTuple):
    """Result of a least-squares fit."""

    kind: Kind
    unknowns: Array
    """Values, shape (14,)."""
    fitted: list[int]
    """Indices of the free unknowns."""
    weights: Array
    """Weights of the residuals of each joint [1/rad], shape (6,)."""
    residual: Array
    """Measured minus predicted positions [rad], shape (6, n)."""
    rms: float
    """Root mean square residual, geometric mean over the joints [rad]."""


def identify_actuator(
    sent: Array, measured: Array, *, source: str = "", kind: Literal["auto"] | Kind = "auto"
) -> Actuator:
    """Identify the actuator of an arm from a motion of all joints.

    Args:
        sent: Send times [s] and setpoints of the free joints [rad], shape (m, 7).
        measured: Measurement times by the same clock [s] and positions of the free joints [rad],
            shape (p, 7).
        source: Digest of the run log; by default that of the two arrays.
        kind: Kind of actuator, but not `ideal`; `auto` selects the one that explains the log.

    Returns:
        The actuator, with 95 % intervals, and warnings about a poor fit.

    Raises:
        RecordingError: The log is too short, has gaps, moves too little, or does not show an arm
            that follows its setpoints.
    """
    log = _read(sent, measured)
    source = source or DIGEST_PREFIX + sha256(sent.tobytes() + measured.tobytes()).hexdigest()
    kinds: tuple[Kind, ...] = tuple(FITTED) if kind == "auto" else (kind,)
    starts = {one: _search(log, one, FITTED[one]) for one in kinds}
    if kind == "auto":  # the fit of a law takes long: that of the less likely one is left out
        del starts[max(LAWS, key=lambda law: starts[law][0][0])]
    fits = [_fit(log, one, FITTED[one], starts[one]) for one in kinds if one in starts]
    best, *servos = fits  # of `auto` the lag, and one servo
    best = next((servo for servo in servos if _explains_more(log, servo, best)), best)
    left = log.unexplained(best.residual)
    if np.max(left) > MAX_UNEXPLAINED:
        raise RecordingError(
            f"free joint {np.argmax(left) + 1} does not follow its setpoints: the best actuator "
            f"({best.kind}) leaves {np.max(left):.0%} of its motion unexplained, expected less "
            f"than {MAX_UNEXPLAINED:.0%}; check that setpoints and replies belong together and "
            "share a clock"
        )
    half = _half_widths(log, best)
    # Without the law, slow motions hardly tell delay from t_c, and an assumed t_c would give the
    # delay too narrow an interval.
    if best.kind == "kst" and half[T_C] > MAX_T_C_UNCERTAINTY * best.unknowns[T_C]:
        rest = [place for place in best.fitted if place != T_C]
        best = _fit(log, best.kind, rest, _search(log, best.kind, rest))
        half = _half_widths(log, best)
    delay, cycle, *lags = (
        Estimate.around(
            float(best.unknowns[place]),
            float(half[place]),
            "identified" if place in best.fitted else "assumed",
        ).not_negative()
        for place in range(LOAD_BIAS)
    )
    noise = np.std(np.diff(best.residual, axis=1), axis=1) / sqrt(2.0)  # the white part
    return Actuator(
        kind=best.kind,
        delay=delay,
        lags=tuple(lags),
        cycle=cycle,
        fit=ActuatorFit(
            source=source,
            samples=len(log.time),
            duration=float(np.ptp(log.time)),
            rms=best.rms,
            noise=_typical(noise),
            alternatives={other.kind: other.rms for other in fits if other.kind != best.kind},
            warnings=_warnings(log, best, noise),
        ),
    )


@checked
def identify_run(run: RunLog | StrPath) -> Actuator:
    """Identify the actuator of the arm of a run log.

    Args:
        run: Log with setpoints and measured joints, as recorded by `equipoise.rig.simulate.excite`,
            or its file.

    Raises:
        RecordingError: The log cannot be used, see `identify_actuator`.
    """
    run = run if isinstance(run, RunLog) else RunLog.load(run)
    stream, replies = run.stream, run.replies
    free = list(run.conditions.arm.free)
    sent, measured = (np.column_stack((part.time, part.q[:, free])) for part in (stream, replies))
    return identify_actuator(sent, measured, source=run.digest)


def speed_ranges(time: Array, q: Array) -> Array:
    """Return the range of each joint's velocity between its 2 % and 98 % quantiles [rad/s].

    Args:
        time: Send times of the setpoints [s], shape (m,).
        q: Setpoints [rad], shape (m, joints).
    """
    velocity = np.diff(q, axis=0) / np.diff(time)[:, None]
    return np.ptp(np.quantile(velocity, [0.02, 0.98], axis=0), axis=0)


def _read(sent: Array, replies: Array) -> Log:
    """Validate a log; return it without the replies that precede the first setpoints."""
    for name, rows in (("setpoints", sent), ("replies", replies)):
        usable = rows.shape[1] == 1 + FREE_JOINTS and len(rows) > 1 and np.all(np.isfinite(rows))
        if not usable or np.any(np.diff(rows[:, 0]) <= 0.0):
            raise RecordingError(
                f"the {name} have the shape {rows.shape}, or values that are not finite, or times "
                f"that do not increase; give a time and {FREE_JOINTS} free joints in each row"
            )
    stream_time, stream_q = sent[:, 0], sent[:, 1:]
    keep = (replies[:, 0] >= stream_time[0] + HIGH[DELAY]) & (replies[:, 0] <= stream_time[-1])
    time, q = replies[keep, 0], replies[keep, 1:].T
    for name, times in (("setpoints", stream_time), ("replies", time)):
        duration = float(np.ptp(times)) if len(times) else 0.0
        gap = float(np.max(np.diff(times), initial=0.0))
        if duration < MIN_DURATION or gap > MAX_GAP:
            raise RecordingError(
                f"the {name} last {duration:.1f} s beside the others, with a gap of "
                f"{1e3 * gap:.0f} ms, expected at least {MIN_DURATION} s and at most "
                f"{1e3 * MAX_GAP:.0f} ms; record 10 s by one clock"
            )
    speeds = speed_ranges(stream_time, stream_q)
    moved = np.ptp(q, axis=1) / np.maximum(np.ptp(stream_q, axis=0), 1e-300)
    for number, (speed, fraction) in enumerate(zip(speeds, moved, strict=True), start=1):
        if speed < LEAST_SPEED or fraction < MIN_MOTION:
            raise RecordingError(
                f"the velocity of free joint {number} ranges over {speed:.2g} rad/s, and the joint "
                f"moves {fraction:.0%} of the way, expected at least {LEAST_SPEED} rad/s and "
                f"{MIN_MOTION:.0%}; let every joint move slowly and fast, with the drives on"
            )
    # After a quarter of a second the initial state of the simulation has no effect.
    settled = int(np.searchsorted(time, time[0] + 0.25))
    stream_time, stream_q, time, q = map(np.ascontiguousarray, (stream_time, stream_q.T, time, q))
    return Log(stream_time, stream_q, time, q, time[settled:], q[:, settled:])


def _search(log: Log, kind: Kind, fitted: list[int]) -> list[tuple[float, Array]]:
    """Return the best delay of a coarse grid for each t_c, the best one first.

    Returns:
        For each t_c the root mean square fraction of the motion that is left, and the unknowns.
    """
    start, guesses = START.copy(), list[tuple[float, Array]]()
    # A slow servo looks like more delay: cycles of 10 and 25 ms are tried, too.
    for cycle in (CYCLE, 1e-2, 2.5e-2) if T_C in fitted else (CYCLE,):
        row = list[tuple[float, Array]]()
        for delay in np.arange(0.0, HIGH[DELAY], 5e-3):  # [s]: a small part of any period
            start[[DELAY, T_C]] = delay, cycle
            left = log.unexplained(log.residual(kind, start))
            row.append((float(_rms(left)), start.copy()))
        guesses.append(min(row, key=itemgetter(0)))
    return sorted(guesses, key=itemgetter(0))


def _fit(log: Log, kind: Kind, fitted: list[int], starts: list[tuple[float, Array]]) -> JointFit:
    """Fit one kind of actuator, each joint weighted by its residual."""
    own = [[place < LAG or (place - LAG) % FREE_JOINTS == j for place in fitted] for j in range(6)]
    fits = list[JointFit]()
    for left, unknowns in starts:
        # Delay and t_c are nearly the same to slow motions, and a fit proceeds slowly from one to
        # the other: starts that are nearly as good as the best one are used, too.
        if left > 3.0 * starts[0][0]:
            break
        residual, weights = log.residual(kind, unknowns), np.ones(FREE_JOINTS)
        for _ in range(2):  # weighted by the residuals of the search, then by those of the fit
            weights = 1.0 / np.std(residual, axis=1)
            unknowns = fit_unknowns(
                partial(_weighted, log, kind, weights),
                unknowns,
                fitted,
                SCALES,
                (LOW, HIGH),
                jac_sparsity=np.repeat(own, len(log.time), axis=0),
                xtol=1e-6,
                ftol=1e-7,
            )
            residual = log.residual(kind, unknowns)
        rms = _typical(_rms(residual))
        fits.append(JointFit(kind, unknowns, fitted, weights, residual, rms))
    return min(fits, key=lambda fit: fit.rms)


def _weighted(log: Log, kind: Kind, weights: Array, unknowns: Array) -> Array:
    """Return the weighted residuals of all joints, shape (6 n,)."""
    return (weights[:, None] * log.residual(kind, unknowns)).ravel()


def _explains_more(log: Log, servo: JointFit, lag: JointFit) -> bool:
    """Return whether a servo leaves less than a lag beyond chance.

    That is by 2.5 standard errors over blocks of time.
    """
    weights = servo.weights[:, None]
    squares = (weights * lag.residual) ** 2 - (weights * servo.residual) ** 2
    gains = np.bincount(blocks_of_time(log.time, BLOCKS), weights=squares.sum(axis=0))
    return bool(np.mean(gains) > 2.5 * np.std(gains, ddof=1) / sqrt(BLOCKS))


def _half_widths(log: Log, fit: JointFit) -> Array:
    """Return the half widths of the 95 % intervals of all unknowns; zero for fixed ones.

    The variance is the sum of a jackknife over blocks of time of all joints together, and of the
    shift of the unknowns under a larger transport jitter.
    """
    weighted = partial(_weighted, log, fit.kind, fit.weights)
    J = sensitivities(weighted, fit.unknowns, fit.fitted, SCALES)
    time = np.tile(log.time, FREE_JOINTS)
    jittered = log.residual(fit.kind, fit.unknowns, spread=sqrt(2.0) * JITTER)
    weights = fit.weights[:, None]
    change = (weights * (jittered - fit.residual)).ravel()
    move = np.linalg.lstsq(J.T @ J, J.T @ change, rcond=None)[0]
    variances = np.diag(jackknife(J, (weights * fit.residual).ravel(), time, BLOCKS)) + move**2
    half = np.zeros(len(fit.unknowns))
    half[fit.fitted] = [half_width(float(variance), BLOCKS) for variance in variances]
    return half * SCALES


def _warnings(log: Log, fit: JointFit, noise: Array) -> tuple[str, ...]:
    warnings: list[str] = []
    if fit.kind == "kst" and T_C not in fit.fitted:
        warnings.append(
            "the log does not determine the cycle of the shaping law within "
            f"{MAX_T_C_UNCERTAINTY:.0%}: it is kept at {1e3 * CYCLE:.0f} ms; let the joints move "
            "both slowly and fast"
        )
    for j, left in enumerate(_rms(fit.residual)):
        fraction = left / np.std(log.measured[j])
        # Transport jitter alone leaves twice the noise.
        if left > 3.0 * noise[j] and fraction > 0.02:
            warnings.append(
                f"free joint {j + 1} deviates from the model: it leaves {1e3 * left:.2g} mrad, "
                f"{fraction:.0%} of the motion and {left / noise[j]:.0f} times the noise; where a "
                "torque was at its limit, record slower motions; otherwise its load shakes it, and "
                "its lag is uncertain"
            )
    return tuple(warnings)


def _typical(sizes: npt.NDArray[np.floating]) -> float:
    """Return the geometric mean over the joints, which the worst joint does not dominate."""
    return exp(float(np.mean(np.log(sizes))))


def _rms(values: Array) -> npt.NDArray[np.floating]:
    """Return the root mean square over the last axis."""
    return np.sqrt(np.mean(values**2, axis=-1))
