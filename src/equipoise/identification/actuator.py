r"""A log of setpoints and measured joint positions becomes an actuator.

Transport delay, shaping law and the lags of the drives are fitted together, to the simulation that
training and controller run as well (`equipoise.model.actuator`). A linear delay and lag, fitted to
an arm behind the shaping law, would change with the amplitude of the motion.

1. A coarse grid finds the place of the delay: where a motion repeats itself, a delay fits nearly as
   well one period later.
2. Least squares over the whole log: one delay and one t_c; for each joint its lag, and the steady
   push of its load. The drives know the bare arm only: a joint that carries a tool sags, and
   follows more slowly than its drive would alone. What shakes a joint lasts, so a joint weighs as
   much as its blocks of time agree with each other, not as its residual is small.
3. Intervals from a jackknife over these blocks, and from what the log does not tell: how much the
   transports jitter.
4. Of several kinds of actuator, the simplest that explains the log.

The delay is from sending a setpoint to its mean effect, wherever the cabinet's cycles begin. If the
times of the replies say when a position *arrived*, it includes the way back.
"""

from math import exp, sqrt
from typing import Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.artefacts import Estimate
from equipoise.errors import RecordingError
from equipoise.identification.jackknife import blocks_of_time, jackknife
from equipoise.logs.run_log import RunLog
from equipoise.model.actuator import (
    CYCLE,
    KINDS,
    Actuator,
    ActuatorFit,
    ActuatorParameters,
    Kind,
    track,
)
from equipoise.model.arms.arm import FREE_JOINTS

Array = npt.NDArray[np.float64]
Whole = npt.NDArray[np.intp]

DELAY, T_C, LAG, PUSH = 0, 1, 2, 2 + FREE_JOINTS
"""Places of the unknowns: the delay, t_c, a lag and a push of each joint."""

COMMON: Final[dict[Kind, list[int]]] = {"ideal": [DELAY], "lag": [DELAY], "kst": [DELAY, T_C]}
"""The unknowns that all joints share, for each kind."""
OWN: Final[dict[Kind, list[int]]] = {"ideal": [PUSH], "lag": [LAG, PUSH], "kst": [LAG, PUSH]}
"""Those of each joint, by their place for the first joint."""


def _unknowns(delay: float, t_c: float, lag: float, push: float) -> Array:
    return np.array([delay, t_c, *[lag] * FREE_JOINTS, *[push] * FREE_JOINTS])


START: Final = _unknowns(0.0, CYCLE, 8e-3, 0.0)
SCALES: Final = _unknowns(1e-2, 1e-3, 1e-2, 1e-1)
"""Natural size of each unknown."""
LOWEST: Final = _unknowns(0.0, 1e-4, 0.0, -np.inf)
HIGHEST: Final = _unknowns(0.1, 1e-2, 0.1, np.inf)
"""A robot with more delay or lag balances nothing."""
GRID: Final = 5e-3
"""Between the delays that are tried first [s]: a small part of any period."""
SPREAD: Final = 1e-3
"""A setpoint takes effect up to this earlier or later than the mean [s], as a server's cycle and a
quiet network make it. The log hardly tells it; twice its square is taken as possible. Should it be
2 ms, the delay comes out 0.2 ms too short."""
SETTLING: Final = 0.25
"""After so long the simulation has forgotten the state that it began with [s]."""
BLOCKS: Final = 20
"""Blocks of time: residuals last for some 20 ms, a block of the shortest log for 200 ms."""
SHORTEST: Final = 4.0
"""Shorter logs are refused [s]."""
LONGEST_GAP: Final = 0.025
"""Logs with a longer gap between setpoints or between replies are refused [s]."""
LEAST_SPEED: Final = 0.1
"""The velocity of each joint must have this range [rad/s]: at one speed, a delay and the lag of the
shaping law are the same."""
LEAST_SHARE: Final = 0.25
"""The range of each measured joint must be this share of its setpoints'."""
UNEXPLAINED: Final = 0.25
"""A log is refused where the model leaves more than this share of a joint's motion."""
BETTER: Final = 0.95
"""A richer kind of actuator must leave less than this share of what a simpler one leaves."""
LOOSE: Final = 0.3
"""t_c is kept, as the server's source has it, where the log does not tell it within this share."""
MISFIT: Final = (3.0, 0.02)
"""A warning is given where the model leaves so many times the noise and this share of the motion;
the jitter of the transports leaves twice the noise."""
MEMORIES: Final = tuple(i / 10 for i in range(10))
"""Of the observers that are tried for the one-step prediction."""


class Log(NamedTuple):
    """What is fitted; rows belong to joints."""

    stream_time: Array
    """When setpoints were sent [s], shape (m,)."""
    stream_q: Array
    """The setpoints [rad], shape (6, m)."""
    reply_time: Array
    """When positions were measured [s], shape (p,)."""
    reply_q: Array
    """The positions [rad], shape (6, p)."""
    settled: int
    """How many of them the simulation has to forget its first state."""

    @property
    def time(self) -> Array:
        """Times of the positions that are fitted [s], shape (n,)."""
        return self.reply_time[self.settled :]

    @property
    def measured(self) -> Array:
        """The positions that are fitted [rad], shape (6, n)."""
        return self.reply_q[:, self.settled :]

    @property
    def blocks(self) -> Whole:
        """The block of time of each, shape (n,)."""
        return blocks_of_time(self.time, BLOCKS)

    def predict(
        self, kind: Kind, unknowns: Array, joint: int, memory: float = 1.0, spread: float = SPREAD
    ) -> Array:
        """Return the positions that a joint would have had [rad], shape (n,)."""
        predicted = np.empty_like(self.reply_time)
        track(
            self.stream_time,
            self.stream_q[joint],
            self.reply_time,
            self.reply_q[joint],
            float(unknowns[DELAY]),
            spread,
            float(unknowns[LAG + joint]),
            float(unknowns[PUSH + joint]),
            memory,
            ActuatorParameters(KINDS.index(kind), float(unknowns[T_C])),
            predicted,
        )
        return predicted[self.settled :]

    def residual(self, kind: Kind, unknowns: Array, spread: float = SPREAD) -> Array:
        """Return measured minus predicted positions, shape (6, n)."""
        joints = range(FREE_JOINTS)
        return self.measured - np.stack(
            [self.predict(kind, unknowns, j, spread=spread) for j in joints]
        )

    def sensitivities(self, kind: Kind, unknowns: Array, fitted: list[int]) -> Array:
        """Return what the predictions change per natural size of an unknown, shape (6, n, k)."""
        J = np.zeros((*self.measured.shape, len(fitted)))
        base = self.measured - self.residual(kind, unknowns)
        for column, place in enumerate(fitted):
            moved = unknowns.copy()
            moved[place] += 1e-3 * SCALES[place]
            for j in [(place - LAG) % FREE_JOINTS] if place >= LAG else range(FREE_JOINTS):
                J[j, :, column] = (self.predict(kind, moved, j) - base[j]) / 1e-3
        return J


class JointFit(NamedTuple):
    """The unknowns that leave the least squares."""

    kind: Kind
    unknowns: Array
    """Values, shape (14,)."""
    fitted: list[int]
    """Places of the unknowns that were free."""
    weights: Array
    """Of the residuals of each joint [1/rad], shape (6,)."""
    residual: Array
    """Measured minus predicted positions [rad], shape (6, n)."""

    @property
    def rms(self) -> float:
        """Root mean square residual of the typical joint [rad]."""
        return _typical(_rms(self.residual))


def identify_actuator(
    stream_time: Array,
    stream_q: Array,
    reply_time: Array,
    reply_q: Array,
    *,
    source: str,
    kind: Literal["auto"] | Kind = "auto",
) -> Actuator:
    """Identify how an arm follows its setpoints.

    Args:
        stream_time: When setpoints were sent [s], shape (m,).
        stream_q: The setpoints of the free joints [rad], shape (m, 6).
        reply_time: When positions were measured, by the same clock [s], shape (p,).
        reply_q: The measured free joints [rad], shape (p, 6).
        source: Digest of the run log.
        kind: `auto` tries all and keeps the simplest that explains the log.

    Returns:
        The actuator, with 95 % intervals and warnings where the model explains the log badly.

    Raises:
        RecordingError: The log is too short, has gaps, moves too little, or does not show an arm
            that follows its setpoints.
    """
    log = _read(stream_time, stream_q, reply_time, reply_q)
    fits = {each: _fit(log, each) for each in (KINDS if kind == "auto" else (kind,))}
    best = next(iter(fits.values()))
    for richer in fits.values():
        if richer.rms < BETTER * best.rms:
            best = richer
    _refuse_unexplained(log, best)
    covariance = _covariance(log, best)
    if T_C in best.fitted and _half_width(covariance, T_C) > LOOSE * best.unknowns[T_C]:
        best = _fit(log, best.kind, t_c_kept=True)
        covariance = _covariance(log, best)
    estimates = _estimates(best, covariance)
    noise, duration = _noise(best.residual), float(log.time[-1] - log.time[0])
    return Actuator(
        kind=best.kind,
        delay=estimates[DELAY],
        lags=tuple(estimates[LAG : LAG + FREE_JOINTS]),
        cycle=estimates[T_C],
        fit=ActuatorFit(
            source=source,
            samples=len(log.time),
            duration=duration,
            rms=best.rms,
            noise=_typical(noise),
            one_step=_typical(_one_step(log, best.kind, best.unknowns)),
            alternatives={
                other.kind: other.rms for other in fits.values() if other.kind != best.kind
            },
            warnings=_warnings(log, best, noise),
        ),
    )


def identify_run(run: RunLog) -> Actuator:
    """Identify how the arm of a run log follows its setpoints.

    Args:
        run: A log with setpoints and measured joints, as `equipoise.deployment.excite` records it.

    Raises:
        RecordingError: The log cannot be used, see `identify_actuator`.
    """
    stream, replies = run.stream, run.replies
    free = list(run.conditions.free)
    return identify_actuator(
        stream.time, stream.q[:, free], replies.time, replies.q[:, free], source=run.digest
    )


def _read(stream_time: Array, stream_q: Array, reply_time: Array, reply_q: Array) -> Log:
    """Return the log as it is fitted; what came before the first setpoints is left out."""
    for name, time, q in (("setpoints", stream_time, stream_q), ("replies", reply_time, reply_q)):
        if q.shape != (*time.shape, FREE_JOINTS) or len(q) < 2:
            raise RecordingError(
                f"the {name} have the shapes {time.shape} and {q.shape}, expected (n,) and "
                f"(n, {FREE_JOINTS}); give times and the free joints"
            )
        if not (np.all(np.isfinite(time)) and np.all(np.isfinite(q)) and np.all(np.diff(time) > 0)):
            raise RecordingError(
                f"the {name} hold NaN or infinity, or their times do not increase; give each once, "
                "with its time by a monotonic clock"
            )
    keep = (reply_time >= stream_time[0] + HIGHEST[DELAY]) & (reply_time <= stream_time[-1])
    time, q = np.ascontiguousarray(reply_time[keep]), np.ascontiguousarray(reply_q[keep].T)
    duration = float(np.ptp(time)) if len(time) else 0.0
    if duration < SHORTEST + SETTLING:
        raise RecordingError(
            f"setpoints and replies share {duration:.1f} s, expected at least "
            f"{SHORTEST + SETTLING} s; record 10 s"
        )
    for name, times in (("setpoints", stream_time), ("replies", time)):
        gap = int(np.argmax(np.diff(times)))
        if (length := float(times[gap + 1] - times[gap])) > LONGEST_GAP:
            raise RecordingError(
                f"the {name} have a gap of {1e3 * length:.0f} ms at {times[gap]:.3f} s, expected "
                f"at most {1e3 * LONGEST_GAP:.0f} ms; record again, or cut the log there"
            )
    for j, speed in enumerate(speed_ranges(stream_time, stream_q)):
        if speed < LEAST_SPEED:
            raise RecordingError(
                f"the velocity of free joint {j + 1} ranges over {speed:.2g} rad/s, expected at "
                f"least {LEAST_SPEED} rad/s; let every joint move slowly and fast"
            )
    shares = np.ptp(q, axis=1) / np.ptp(stream_q, axis=0)
    j = int(np.argmin(shares))
    if shares[j] < LEAST_SHARE:
        raise RecordingError(
            f"free joint {j + 1} moves {shares[j]:.0%} of the way of its setpoints, expected at "
            f"least {LEAST_SHARE:.0%}; check that the drives are on and the servo runs"
        )
    return Log(
        stream_time=np.ascontiguousarray(stream_time),
        stream_q=np.ascontiguousarray(stream_q.T),
        reply_time=time,
        reply_q=q,
        settled=int(np.searchsorted(time, time[0] + SETTLING)),
    )


def speed_ranges(time: Array, q: Array) -> Array:
    """Return over what range the velocity of each joint goes, but for 2 % at each end [rad/s].

    Args:
        time: When setpoints were sent [s], shape (m,).
        q: The setpoints [rad], shape (m, joints).
    """
    velocity = np.diff(q, axis=0) / np.diff(time)[:, None]
    return np.ptp(np.quantile(velocity, [0.02, 0.98], axis=0), axis=0)


def _fit(log: Log, kind: Kind, *, t_c_kept: bool = False) -> JointFit:
    """Fit one kind of actuator: joints weigh by their residuals, then by how their blocks agree."""
    common = [DELAY] if t_c_kept else COMMON[kind]
    fitted = [*common, *(first + j for first in OWN[kind] for j in range(FREE_JOINTS))]
    delays = np.arange(0.0, HIGHEST[DELAY], GRID)
    starts = np.tile(START, (len(delays), 1))
    starts[:, DELAY] = delays
    if kind == "ideal":
        starts[:, LAG:PUSH] = 0.0
    left = np.stack([np.std(log.residual(kind, start), axis=1) for start in starts])
    nearest = int(np.argmin(_rms(left / np.std(log.measured, axis=1))))
    weights = 1.0 / left[nearest]
    unknowns = _least_squares(log, kind, starts[nearest], fitted, weights)
    weights = 1.0 / _agreement(log, kind, unknowns, fitted)
    unknowns = _least_squares(log, kind, unknowns, fitted, weights)
    return JointFit(kind, unknowns, fitted, weights, log.residual(kind, unknowns))


def _least_squares(log: Log, kind: Kind, start: Array, fitted: list[int], weights: Array) -> Array:
    from scipy.optimize import least_squares

    unknowns, scales = start.copy(), SCALES[fitted]
    low, high = LOWEST[fitted], HIGHEST[fitted]

    def at(x: Array) -> Array:
        unknowns[fitted] = x * scales
        return unknowns

    def residual(x: Array) -> Array:
        return -(weights[:, None] * log.residual(kind, at(x))).ravel()

    def jacobian(x: Array) -> Array:
        J = log.sensitivities(kind, at(x), fitted)
        return (weights[:, None, None] * J).reshape(-1, len(fitted))

    inside = np.clip(start[fitted], low + 1e-3 * scales, high - 1e-3 * scales)
    solution = least_squares(
        residual,
        inside / scales,
        # The stub of SciPy knows a name here, but no function.
        jac=jacobian,  # pyright: ignore[reportArgumentType]
        bounds=(low / scales, high / scales),
        x_scale="jac",
        # Exact steps, by decomposing the tall Jacobian, would take most of the time.
        tr_solver="lsmr",
        xtol=1e-6,
        ftol=1e-7,
    )
    return at(solution.x).copy()


def _agreement(log: Log, kind: Kind, unknowns: Array, fitted: list[int]) -> Array:
    """Return the standard deviation of independent noise that would say as much, shape (6,) [rad].

    In a joint's blocks of time the residual pulls its unknowns to and fro. Of independent noise
    the squares of these pulls, in units of what the joint's motion tells, are the variance.
    """
    J, residual = log.sensitivities(kind, unknowns, fitted), log.residual(kind, unknowns)
    block, sizes = log.blocks, np.empty(FREE_JOINTS)
    for j in range(FREE_JOINTS):
        J_j = J[j][:, [i for i, p in enumerate(fitted) if p < LAG or (p - LAG) % FREE_JOINTS == j]]
        pulls = np.stack([J_j[block == i].T @ residual[j, block == i] for i in range(BLOCKS)])
        share = np.linalg.lstsq(J_j.T @ J_j, pulls.T @ pulls, rcond=None)[0]
        sizes[j] = sqrt(np.trace(share) / J_j.shape[1])
    return sizes


def _covariance(log: Log, fit: JointFit) -> Array:
    """Return the covariance of the unknowns, shape (14, 14); zero where one was not free.

    A jackknife over blocks of time of all joints together; and how far the unknowns move when the
    transports jitter more than was assumed.
    """
    scales, k = SCALES[fit.fitted], len(fit.fitted)
    weights = fit.weights[:, None]
    sensitivities = log.sensitivities(fit.kind, fit.unknowns, fit.fitted)
    J = (weights[:, :, None] * sensitivities).reshape(-1, k)
    residual, block = (weights * fit.residual).ravel(), np.tile(log.blocks, FREE_JOINTS)
    jitter = weights * (
        log.residual(fit.kind, fit.unknowns, spread=sqrt(2.0) * SPREAD) - fit.residual
    )
    move = np.linalg.lstsq(J.T @ J, J.T @ jitter.ravel(), rcond=None)[0]
    covariance = np.zeros((len(fit.unknowns), len(fit.unknowns)))
    covariance[np.ix_(fit.fitted, fit.fitted)] = np.outer(scales, scales) * (
        jackknife(J, residual, block) + np.outer(move, move)
    )
    return covariance


def _half_width(covariance: Array, place: int) -> float:
    """Return half the width of the 95 % interval of an unknown."""
    from scipy.stats import t as student

    return float(student.ppf(0.975, BLOCKS - 1)) * sqrt(covariance[place, place])


def _estimates(fit: JointFit, covariance: Array) -> list[Estimate]:
    """Return the unknowns with their intervals, none of which reaches below zero."""
    estimates: list[Estimate] = []
    for place in range(PUSH):
        value, width = float(fit.unknowns[place]), _half_width(covariance, place)
        estimates.append(
            Estimate(
                value=value,
                low=max(value - width, 0.0),
                high=value + width,
                source="identified" if place in fit.fitted else "assumed",
            )
        )
    return estimates


def _one_step(log: Log, kind: Kind, unknowns: Array) -> Array:
    """Return the error of each joint's one-step prediction under the best observer, shape (6,)."""
    return np.array(
        [
            min(
                float(_rms(log.measured[j] - log.predict(kind, unknowns, j, memory)))
                for memory in MEMORIES
            )
            for j in range(FREE_JOINTS)
        ]
    )


def _refuse_unexplained(log: Log, fit: JointFit) -> None:
    left = np.std(fit.residual, axis=1) / np.std(log.measured, axis=1)
    j = int(np.argmax(left))
    if left[j] > UNEXPLAINED:
        raise RecordingError(
            f"free joint {j + 1} does not follow its setpoints: the best actuator ({fit.kind}) "
            f"leaves {left[j]:.0%} of its motion unexplained, expected less than {UNEXPLAINED:.0%};"
            " check that setpoints and replies belong together and share a clock"
        )


def _warnings(log: Log, fit: JointFit, noise: Array) -> tuple[str, ...]:
    warnings: list[str] = []
    if fit.kind == "kst" and T_C not in fit.fitted:
        warnings.append(
            f"the log does not tell the cycle of the shaping law within {LOOSE:.0%}: it is kept at "
            f"{1e3 * CYCLE:.0f} ms; let the joints move both slowly and fast"
        )
    times_noise, least_share = MISFIT
    for j, left in enumerate(_rms(fit.residual)):
        share = left / np.std(log.measured[j])
        if left > times_noise * noise[j] and share > least_share:
            warnings.append(
                f"free joint {j + 1} does not move as the model says: it leaves "
                f"{1e3 * left:.2g} mrad, {share:.0%} of the motion and {left / noise[j]:.0f} times "
                "the noise; where a torque was at its limit, record slower motions; otherwise its "
                "load shakes it, and its lag says little"
            )
    return tuple(warnings)


def _noise(residual: Array) -> Array:
    """Return what of each joint's residual is new in each sample [rad], shape (6,)."""
    return np.std(np.diff(residual, axis=1), axis=1) / sqrt(2.0)


def _typical(sizes: npt.NDArray[np.floating]) -> float:
    """Return the geometric mean over the joints: the worst does not stand for all."""
    return exp(float(np.mean(np.log(sizes))))


def _rms(values: Array) -> npt.NDArray[np.floating]:
    """Return the root mean square over the last axis."""
    return np.sqrt(np.mean(values**2, axis=-1))
