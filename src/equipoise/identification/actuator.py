r"""Identification of an actuator from a log of setpoints and measured joint positions.

Transport delay, shaping law and drive lags are fitted together to the simulation that training and
controller use (`equipoise.model.actuator`). A linear delay and lag, fitted to an arm behind the
shaping law, would depend on the amplitude of the motion.

1. Search a coarse grid for delay and t_c: with a periodic motion, a delay longer by one period fits
   nearly as well.
2. Fit the whole log by least squares: one delay, one t_c, and for each joint a lag and the constant
   bias of its load. The drives know only the bare arm: a joint that carries a tool sags and follows
   more slowly than its drive alone would. Disturbances are autocorrelated, so the weight of a joint
   depends on the agreement of its blocks of time, not on the size of its residual.
3. Compute intervals from a jackknife over these blocks and from the unknown transport jitter.
4. Select the kind of actuator that leaves least; `ideal` unless another leaves less beyond chance.
   A log hardly tells a servo with inertia from a linear lag: the intervals of the servo allow for
   both.

Where the log shows the swinging pendulum and the masses are known, the drive of the last joint
moves its load, too (`equipoise.identification.wrist_load`): its inertia is fitted.

The delay runs from sending a setpoint to its mean effect, independent of the phase of the cabinet's
cycles. It includes the return path if the reply times are times of *arrival*.
"""

from collections.abc import Mapping
from hashlib import sha256
from math import exp, hypot, sqrt
from typing import Final, Literal, NamedTuple, TypedDict

import numpy as np
import numpy.typing as npt

from equipoise.artefacts import DIGEST_PREFIX, Estimate
from equipoise.errors import RecordingError
from equipoise.identification.jackknife import blocks_of_time, jackknife
from equipoise.identification.wrist_load import LoadMotion, WristLoad, load_motion, wrist_load
from equipoise.logs.run_log import RunLog
from equipoise.model.actuator import (
    CYCLE,
    KINDS,
    LAWS,
    Actuator,
    ActuatorFit,
    ActuatorParameters,
    DriveInertia,
    JointResponse,
    Kind,
    track,
)
from equipoise.model.arms.arm import FREE_JOINTS
from equipoise.model.encoder import theta_from_counts

Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.intp]

DELAY, T_C, LAG, LOAD_BIAS = 0, 1, 2, 2 + FREE_JOINTS
SHARE = LOAD_BIAS + FREE_JOINTS
"""Indices of the unknowns: the delay, t_c, a lag and a load bias of each joint, and the share of
the last joint's drive in the inertia that it moves."""
LAST: Final = FREE_JOINTS - 1
"""Index of the last free joint, which carries bracket and pendulum."""

_LAGS, _BIASES = range(LAG, LOAD_BIAS), range(LOAD_BIAS, SHARE)
FITTED: Final[dict[Kind, list[int]]] = {
    "ideal": [DELAY, *_BIASES],
    "lag": [DELAY, *_LAGS, *_BIASES],
    "unshaped": [DELAY, T_C, *_LAGS, *_BIASES, SHARE],
    "kst": [DELAY, T_C, *_LAGS, *_BIASES, SHARE],
}
"""Indices of the unknowns of each kind; the share only with a known load."""


def _unknowns(delay: float, t_c: float, lag: float, bias: float, share: float) -> Array:
    return np.array([delay, t_c, *[lag] * FREE_JOINTS, *[bias] * FREE_JOINTS, share])


def _joint(place: int) -> int | None:
    """Return the joint of an unknown; None for delay and t_c, which all joints share."""
    if place == SHARE:
        return LAST
    return (place - LAG) % FREE_JOINTS if place >= LAG else None


START: Final = _unknowns(0.0, CYCLE, 8e-3, 0.0, 1.0)
SCALES: Final = _unknowns(1e-2, 1e-3, 1e-2, 1e-1, 1e-1)
"""Scale of each unknown."""
LOWER_BOUNDS: Final = _unknowns(0.0, 6e-4, 3e-4, -np.inf, 0.01)
"""Lower bounds of the unknowns: with less t_c a servo without shaping law and lag oscillates; less
lag is over within a cycle."""
UPPER_BOUNDS: Final = _unknowns(0.1, 0.1, 0.1, np.inf, 1.0)
"""Upper bounds of the unknowns: a robot with more delay or lag cannot balance."""
DELAY_GRID: Final = 5e-3
"""Grid step of the delay search [s]: a small part of any period."""
ROTORLESS_SHARE: Final = 0.1
"""Share of a drive without a rotor, with which a fit may begin; `START` has that of a heavy one."""
T_C_GRID: Final = (CYCLE, 1e-2, 2.5e-2)
"""Grid of t_c in that search [s]: a slow servo looks like more delay."""
NEAR_BEST: Final = 3.0
"""Residual of a start relative to the best one up to which a fit begins there, too: delay and t_c
are nearly the same to slow motions, and a fit proceeds slowly from one to the other."""
JITTER: Final = 1e-3
"""Largest deviation of a setpoint's delay from the mean [s], from the server's cycle and a quiet
network. The log hardly shows it; the intervals allow for twice its square. With a true value of
2 ms the estimated delay is 0.2 ms too short."""
SETTLING_TIME: Final = 0.25
"""Time after which the initial state of the simulation has no effect [s]."""
BLOCKS: Final = 20
"""Number of blocks of time: residuals are correlated over some 20 ms, a block of the shortest log
lasts 200 ms."""
MIN_DURATION: Final = 4.0
"""Minimum duration of a log [s]."""
MAX_GAP: Final = 0.025
"""Largest accepted gap between setpoints or between replies [s]."""
LEAST_SPEED: Final = 0.1
"""Minimum velocity range of each joint [rad/s]: at a single speed, delay and lag of the shaping law
are indistinguishable."""
MIN_MOTION_SHARE: Final = 0.25
"""Minimum range of each measured joint, as a share of the range of its setpoints."""
MAX_UNEXPLAINED: Final = 0.25
"""Largest accepted residual, as a share of a joint's motion."""
MIN_ADVANTAGE: Final = 2.5
"""Mean reduction of the squared residual per block of time, in its standard errors, from which
a servo replaces `ideal`, and a lag either."""
LOAD_UNCERTAINTY: Final = 0.05
"""Relative uncertainty of the load of the last joint [-]: of its weighing, and of uniform bars."""
MAX_T_C_UNCERTAINTY: Final = 0.3
"""Relative half width of the interval of t_c above which t_c stays at the value of the server's
source."""
MISFIT_LIMITS: Final = (3.0, 0.02)
"""Residual above which a joint gives a warning: as a multiple of the noise, and as a share of the
motion. Transport jitter alone leaves twice the noise."""
OBSERVER_MEMORIES: Final = tuple(i / 10 for i in range(10))
"""Memories of the candidate observers for the one-step prediction."""


NO_LOAD: Final = np.empty(0)
"""Placeholder of an unknown load."""


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
    settled: int
    """Number of initial positions that are not fitted, while the simulation settles."""
    load: LoadMotion | None = None
    """Load on the last joint in each servo cycle from the first measurement on; None if unknown."""

    @property
    def time(self) -> Array:
        """Times of the fitted positions [s], shape (n,)."""
        return self.reply_time[self.settled :]

    @property
    def measured(self) -> Array:
        """Fitted positions [rad], shape (6, n)."""
        return self.reply_q[:, self.settled :]

    @property
    def blocks(self) -> IntArray:
        """Index of the block of time of each fitted position, shape (n,)."""
        return blocks_of_time(self.time, BLOCKS)

    def predict(
        self, kind: Kind, unknowns: Array, joint: int, memory: float = 1.0, spread: float = JITTER
    ) -> Array:
        """Simulate the positions of a joint [rad], shape (n,)."""
        delay, t_c, lag, bias = map(float, unknowns[[DELAY, T_C, LAG + joint, LOAD_BIAS + joint]])
        compliance, inertia, torque = 0.0, NO_LOAD, NO_LOAD
        if self.load is not None and joint == LAST:
            inertia, torque = self.load
            compliance = (1.0 / float(unknowns[SHARE]) - 1.0) / self.load.at_rest
        actuator = ActuatorParameters(KINDS.index(kind), t_c)
        stream = self.stream_time, self.stream_q[joint]
        replies = self.reply_time, self.reply_q[joint]
        predicted = np.empty_like(self.reply_time)
        response = JointResponse(delay, lag, actuator, spread, bias, memory, compliance)
        track(*stream, *replies, response, inertia, torque, predicted)
        return predicted[self.settled :]

    def residual(self, kind: Kind, unknowns: Array, spread: float = JITTER) -> Array:
        """Return measured minus predicted positions [rad], shape (6, n)."""
        joints = range(FREE_JOINTS)
        return self.measured - [self.predict(kind, unknowns, j, spread=spread) for j in joints]

    def sensitivities(self, kind: Kind, unknowns: Array, fitted: list[int]) -> Array:
        """Return the derivatives of the predictions by the scaled unknowns, shape (6, n, k)."""
        J = np.zeros((*self.measured.shape, len(fitted)))
        base = self.measured - self.residual(kind, unknowns)
        for column, place in enumerate(fitted):
            moved = unknowns.copy()
            # The share is at most 1: its derivative is that from below.
            step = -1e-3 if place == SHARE else 1e-3
            moved[place] += step * SCALES[place]
            own = _joint(place)
            for j in range(FREE_JOINTS) if own is None else [own]:
                J[j, :, column] = (self.predict(kind, moved, j) - base[j]) / step
        return J


class JointFit(NamedTuple):
    """Result of a least-squares fit."""

    kind: Kind
    unknowns: Array
    """Values, shape (15,)."""
    fitted: list[int]
    """Indices of the free unknowns."""
    weights: Array
    """Weights of the residuals of each joint [1/rad], shape (6,)."""
    residual: Array
    """Measured minus predicted positions [rad], shape (6, n)."""

    @property
    def rms(self) -> float:
        """Root mean square residual, geometric mean over the joints [rad]."""
        return _typical(_rms(self.residual))


def identify_actuator(
    stream_time: Array,
    stream_q: Array,
    reply_time: Array,
    reply_q: Array,
    *,
    source: str,
    kind: Literal["auto"] | Kind = "auto",
    load: WristLoad | None = None,
    encoder_time: Array = NO_LOAD,
    theta: Array = NO_LOAD,
) -> Actuator:
    """Identify the actuator of an arm.

    Args:
        stream_time: Send times of the setpoints [s], shape (m,).
        stream_q: Setpoints of the free joints [rad], shape (m, 6).
        reply_time: Measurement times of the positions, by the same clock [s], shape (p,).
        reply_q: Measured positions of the free joints [rad], shape (p, 6).
        source: Digest of the run log.
        kind: Kind of actuator; `auto` selects the one that explains the log.
        load: Bracket and pendulum; without them the inertia of the last drive is not fitted.
        encoder_time: Times of the pendulum's angles, by the same clock [s], shape (s,).
        theta: Angles of the pendulum from hanging [rad], shape (s,).

    Returns:
        The actuator, with 95 % intervals, and warnings about a poor fit.

    Raises:
        RecordingError: The log is too short, has gaps, moves too little, or does not show an arm
            that follows its setpoints.
    """
    log = _read(stream_time, stream_q, reply_time, reply_q)
    if load is not None:
        log = log._replace(load=_load_of(log, load, encoder_time, theta))
    kinds: tuple[Kind, ...] = KINDS if kind == "auto" else (kind,)
    starts: dict[Kind, list[Start]] = {
        each: _search(log, each, _fitted(log, each)) for each in kinds
    }
    if kind == "auto":  # the fit of a law takes long: that of the less likely one is left out
        del starts[max(LAWS, key=lambda law: starts[law][0].share)]
    fits: dict[Kind, JointFit] = {
        each: _fit(log, each, _fitted(log, each), starts[each]) for each in starts
    }
    best = _choose(log, fits)
    _reject_unexplained(log, best)
    covariance = _covariance(log, best)
    # Zero where t_c is fixed. Without the law, slow motions hardly tell delay from t_c, and an
    # assumed t_c would give the delay too narrow an interval.
    if (
        best.kind == "kst"
        and _half_width(covariance, T_C) > MAX_T_C_UNCERTAINTY * best.unknowns[T_C]
    ):
        rest = [place for place in best.fitted if place != T_C]
        best = _fit(log, best.kind, rest, _search(log, best.kind, rest))
        covariance = _covariance(log, best)
    values, drive_inertia = best.unknowns.copy(), None
    if load is not None and log.load is not None and SHARE in best.fitted:
        share = float(values[SHARE])
        half_width = hypot(_half_width(covariance, SHARE), LOAD_UNCERTAINTY * (1.0 - share))
        drive_inertia = DriveInertia(
            share=Estimate.around(share, half_width, "identified"),
            load=log.load.at_rest,
            link=load.link_inertia,
        )
    estimates = [
        Estimate.around(
            float(value),
            _half_width(covariance, place),
            "identified" if place in best.fitted else "assumed",
        ).not_negative()
        for place, value in enumerate(values[:LOAD_BIAS])
    ]
    noise, duration = _noise(best.residual), float(log.time[-1] - log.time[0])
    return Actuator(
        kind=best.kind,
        delay=estimates[DELAY],
        lags=tuple(estimates[LAG : LAG + FREE_JOINTS]),
        cycle=estimates[T_C],
        drive_inertia=drive_inertia,
        fit=ActuatorFit(
            source=source,
            samples=len(log.time),
            duration=duration,
            rms=best.rms,
            noise=_typical(noise),
            one_step=_typical(_one_step(log, best.kind, best.unknowns)),
            alternatives={other: fits[other].rms for other in fits if other != best.kind},
            warnings=_warnings(log, best, noise),
        ),
    )


def identify_run(run: RunLog) -> Actuator:
    """Identify the actuator of the arm of a run log.

    Args:
        run: Log with setpoints and measured joints, as recorded by `equipoise.rig.simulate.excite`.

    Raises:
        RecordingError: The log cannot be used, see `identify_actuator`.
    """
    stream, replies = run.stream, run.replies
    free = list(run.conditions.arm.free)
    return identify_actuator(
        *(stream.time, stream.q[:, free], replies.time, replies.q[:, free]),
        source=run.digest,
        **_measured_load(run),
    )


def identify_motion(sent: Array, measured: Array) -> Actuator:
    """Identify the actuator of an arm from a motion of all joints.

    The inertia of the last rotor is not fitted: the motion is half as large as that of a log of
    `deploy --excite`, and the policy's controller does not use it.

    Args:
        sent: Time [s] and setpoint of the free joints [rad], shape (m, 7).
        measured: Time [s] and measured free joints [rad], shape (p, 7).

    Returns:
        The actuator; the source of its fit is the digest of the two arrays.

    Raises:
        RecordingError: The motion cannot be used, see `identify_actuator`.
    """
    source = DIGEST_PREFIX + sha256(sent.tobytes() + measured.tobytes()).hexdigest()
    parts = (sent[:, 0], sent[:, 1:], measured[:, 0], measured[:, 1:])
    return identify_actuator(*map(np.ascontiguousarray, parts), source=source)


class _MeasuredLoad(TypedDict, total=False):
    load: WristLoad
    encoder_time: Array
    theta: Array


def _measured_load(run: RunLog) -> _MeasuredLoad:
    """Return the load and the swing of its pendulum; nothing where the log lacks either."""
    load, samples = wrist_load(run.conditions), run.encoder
    if load is None or run.conditions.counts_per_rev is None or len(samples.time) < 2:
        return {}
    sign = (run.conditions.rig or {}).get("encoder_sign", 1)
    counts = samples.counts.astype(np.float64)
    theta = theta_from_counts(counts, run.conditions.counts_per_rev, sign)
    return {"load": load, "encoder_time": samples.time, "theta": theta}


def _load_of(log: Log, load: WristLoad, encoder_time: Array, theta: Array) -> LoadMotion | None:
    """Return the load in each servo cycle; None where the encoder does not cover the log."""
    begin, end = float(log.reply_time[0]), float(log.reply_time[-1])
    if encoder_time[0] > begin + MAX_GAP or encoder_time[-1] < end - MAX_GAP:
        return None
    cycles = begin + CYCLE * np.arange(round((end - begin) / CYCLE) + 2, dtype=np.float64)
    return load_motion(load, cycles, log.reply_time, log.reply_q.T, encoder_time, theta)


def _fitted(log: Log, kind: Kind) -> list[int]:
    """Return the indices of the unknowns of a kind that the log can show."""
    return [place for place in FITTED[kind] if place != SHARE or log.load is not None]


def _choose(log: Log, fits: Mapping[Kind, JointFit]) -> JointFit:
    """Return the fit of the kind that explains a log.

    Drives have inertia, so a servo is chosen where it leaves less than `ideal`. A lag that leaves
    as little as the servo is not told from it by the log: only the servo's intervals hold both.
    """
    best = next(iter(fits.values()))
    for kind in (*LAWS, "lag"):
        if kind in fits and _explains_more(log, fits[kind], best):
            best = fits[kind]
    return best


def _explains_more(log: Log, richer: JointFit, simpler: JointFit) -> bool:
    """Return whether a kind leaves less than a simpler one, beyond chance."""
    squares = (richer.weights[:, None] * simpler.residual) ** 2
    squares -= (richer.weights[:, None] * richer.residual) ** 2
    gains = np.bincount(log.blocks, weights=squares.sum(axis=0))
    return float(np.mean(gains)) > MIN_ADVANTAGE * float(np.std(gains, ddof=1)) / sqrt(BLOCKS)


def _read(stream_time: Array, stream_q: Array, reply_time: Array, reply_q: Array) -> Log:
    """Validate a log; return it without the replies that precede the first setpoints."""
    for name, time, q in (("setpoints", stream_time, stream_q), ("replies", reply_time, reply_q)):
        usable = q.shape == (len(time), FREE_JOINTS) and len(time) > 1 and np.all(np.isfinite(q))
        if not usable or not np.all(np.isfinite(time)) or np.any(np.diff(time) <= 0.0):
            raise RecordingError(
                f"the {name} have the shape {q.shape}, or values that are not finite, or times "
                f"that do not increase; give {FREE_JOINTS} free joints at each time, and each once"
            )
    keep = (reply_time >= stream_time[0] + UPPER_BOUNDS[DELAY]) & (reply_time <= stream_time[-1])
    for name, times in (("setpoints", stream_time), ("replies", reply_time[keep])):
        duration = float(np.ptp(times)) if len(times) else 0.0
        gap = float(np.max(np.diff(times), initial=0.0))
        if duration < MIN_DURATION + SETTLING_TIME or gap > MAX_GAP:
            raise RecordingError(
                f"the {name} last {duration:.1f} s beside the others, with a gap of "
                f"{1e3 * gap:.0f} ms, expected at least {MIN_DURATION + SETTLING_TIME} s and at "
                f"most {1e3 * MAX_GAP:.0f} ms; record 10 s by one clock"
            )
    time, q = np.ascontiguousarray(reply_time[keep]), np.ascontiguousarray(reply_q[keep].T)
    speeds = speed_ranges(stream_time, stream_q)
    shares = np.ptp(q, axis=1) / np.maximum(np.ptp(stream_q, axis=0), 1e-300)
    j = int(np.argmax((speeds < LEAST_SPEED) | (shares < MIN_MOTION_SHARE)))
    if speeds[j] < LEAST_SPEED or shares[j] < MIN_MOTION_SHARE:
        raise RecordingError(
            f"the velocity of free joint {j + 1} ranges over {speeds[j]:.2g} rad/s, and the joint "
            f"moves {shares[j]:.0%} of the way, expected at least {LEAST_SPEED} rad/s and "
            f"{MIN_MOTION_SHARE:.0%}; let every joint move slowly and fast, with the drives on"
        )
    return Log(
        stream_time=np.ascontiguousarray(stream_time),
        stream_q=np.ascontiguousarray(stream_q.T),
        reply_time=time,
        reply_q=q,
        settled=int(np.searchsorted(time, time[0] + SETTLING_TIME)),
    )


def speed_ranges(time: Array, q: Array) -> Array:
    """Return the range of each joint's velocity between its 2 % and 98 % quantiles [rad/s].

    Args:
        time: Send times of the setpoints [s], shape (m,).
        q: Setpoints [rad], shape (m, joints).
    """
    velocity = np.diff(q, axis=0) / np.diff(time)[:, None]
    return np.ptp(np.quantile(velocity, [0.02, 0.98], axis=0), axis=0)


class Start(NamedTuple):
    """A start of a fit, from a coarse grid."""

    unknowns: Array
    """Values, shape (15,)."""
    left: Array
    """Standard deviations of the residuals there [rad], shape (6,)."""
    share: float
    """Root mean square of their shares of the motion."""


def _search(log: Log, kind: Kind, fitted: list[int]) -> list[Start]:
    """Return the best delay of a coarse grid for each t_c; the best start first."""
    start, found = START.copy(), list[Start]()
    if kind == "ideal":
        start[LAG:LOAD_BIAS] = 0.0
    for cycle in T_C_GRID if T_C in fitted else (CYCLE,):
        row = list[Start]()
        for delay in np.arange(0.0, UPPER_BOUNDS[DELAY], DELAY_GRID):
            start[[DELAY, T_C]] = delay, cycle
            left = np.std(log.residual(kind, start), axis=1)
            row.append(Start(start.copy(), left, float(_rms(left / np.std(log.measured, axis=1)))))
        found.append(_with_rotor(log, kind, min(row, key=lambda one: one.share), fitted))
    return sorted(found, key=lambda one: one.share)


def _with_rotor(log: Log, kind: Kind, start: Start, fitted: list[int]) -> Start:
    """Return a start with the share of a heavy rotor or of none, which fits the last joint best."""
    if SHARE not in fitted:
        return start
    unknowns, left = start.unknowns.copy(), start.left.copy()
    unknowns[SHARE] = ROTORLESS_SHARE
    left[LAST] = np.std(log.measured[LAST] - log.predict(kind, unknowns, LAST))
    return min((start, start._replace(unknowns=unknowns, left=left)), key=lambda s: s.left[LAST])


def _fit(log: Log, kind: Kind, fitted: list[int], starts: list[Start]) -> JointFit:
    """Fit one kind of actuator, weighted by residual first, then by the effective noise."""
    fits = list[JointFit]()
    for start in starts:
        if start.share > NEAR_BEST * starts[0].share:
            break
        unknowns = _least_squares(log, kind, start.unknowns, fitted, 1.0 / start.left)
        weights = 1.0 / _effective_noise(log, kind, unknowns, fitted)
        unknowns = _least_squares(log, kind, unknowns, fitted, weights)
        fits.append(JointFit(kind, unknowns, fitted, weights, log.residual(kind, unknowns)))
    return min(fits, key=lambda fit: fit.rms)


def _least_squares(log: Log, kind: Kind, start: Array, fitted: list[int], weights: Array) -> Array:
    from scipy.optimize import least_squares

    unknowns, scales = start.copy(), SCALES[fitted]
    low, high = LOWER_BOUNDS[fitted], UPPER_BOUNDS[fitted]

    def at(x: Array) -> Array:
        unknowns[fitted] = x * scales
        return unknowns

    def jacobian(x: Array) -> Array:
        J = log.sensitivities(kind, at(x), fitted)
        return (weights[:, None, None] * J).reshape(-1, len(fitted))

    inside = np.clip(start[fitted], low + 1e-3 * scales, high - 1e-3 * scales)
    solution = least_squares(
        lambda x: -(weights[:, None] * log.residual(kind, at(x))).ravel(),
        inside / scales,
        # SciPy's stub accepts a name here, but no function.
        jac=jacobian,  # pyright: ignore[reportArgumentType]
        bounds=(low / scales, high / scales),
        x_scale="jac",
        # Exact steps, by decomposing the tall Jacobian, would take most of the time.
        tr_solver="lsmr",
        xtol=1e-6,
        ftol=1e-7,
    )
    return at(solution.x).copy()


def _effective_noise(log: Log, kind: Kind, unknowns: Array, fitted: list[int]) -> Array:
    """Return the standard deviation of white noise with the same effect, shape (6,) [rad].

    The gradient of the squared residual over each block of time shifts the unknowns of a joint. For
    white noise, the squared gradients over the information of the motion are the variance.
    """
    J, residual = log.sensitivities(kind, unknowns, fitted), log.residual(kind, unknowns)
    block, sizes = log.blocks, np.empty(FREE_JOINTS)
    for j in range(FREE_JOINTS):
        J_j = J[j][:, [i for i, place in enumerate(fitted) if _joint(place) in (None, j)]]
        gradients = np.stack([J_j[block == i].T @ residual[j, block == i] for i in range(BLOCKS)])
        share = np.linalg.lstsq(J_j.T @ J_j, gradients.T @ gradients, rcond=None)[0]
        sizes[j] = sqrt(np.trace(share) / J_j.shape[1])
    return sizes


def _covariance(log: Log, fit: JointFit) -> Array:
    """Return the covariance of the unknowns, shape (15, 15); zero for fixed unknowns.

    The sum of a jackknife over blocks of time of all joints together, and of the shift of the
    unknowns under a larger transport jitter.
    """
    scales, k = SCALES[fit.fitted], len(fit.fitted)
    weights = fit.weights[:, None]
    sensitivities = log.sensitivities(fit.kind, fit.unknowns, fit.fitted)
    J = (weights[:, :, None] * sensitivities).reshape(-1, k)
    residual, block = (weights * fit.residual).ravel(), np.tile(log.blocks, FREE_JOINTS)
    jittered = log.residual(fit.kind, fit.unknowns, spread=sqrt(2.0) * JITTER)
    change = (weights * (jittered - fit.residual)).ravel()
    move = np.linalg.lstsq(J.T @ J, J.T @ change, rcond=None)[0]
    spread = jackknife(J, residual, block) + np.outer(move, move)
    covariance = np.zeros((len(fit.unknowns), len(fit.unknowns)))
    covariance[np.ix_(fit.fitted, fit.fitted)] = np.outer(scales, scales) * spread
    return covariance


def _half_width(covariance: Array, place: int) -> float:
    """Return the half width of the 95 % interval of an unknown."""
    from scipy.stats import t as student

    return float(student.ppf(0.975, BLOCKS - 1)) * sqrt(covariance[place, place])


def _one_step(log: Log, kind: Kind, unknowns: Array) -> Array:
    """Return the one-step error of the best observer for each joint [rad], shape (6,)."""
    errors = [
        [_rms(log.measured[j] - log.predict(kind, unknowns, j, memory)) for j in range(FREE_JOINTS)]
        for memory in OBSERVER_MEMORIES
    ]
    return np.min(errors, axis=0)


def _reject_unexplained(log: Log, fit: JointFit) -> None:
    left = np.std(fit.residual, axis=1) / np.std(log.measured, axis=1)
    j = int(np.argmax(left))
    if left[j] > MAX_UNEXPLAINED:
        raise RecordingError(
            f"free joint {j + 1} does not follow its setpoints: the best actuator ({fit.kind}) "
            f"leaves {left[j]:.0%} of its motion unexplained, expected less than "
            f"{MAX_UNEXPLAINED:.0%}; check that setpoints and replies belong together and share a "
            "clock"
        )


def _warnings(log: Log, fit: JointFit, noise: Array) -> tuple[str, ...]:
    warnings: list[str] = []
    if fit.kind == "kst" and T_C not in fit.fitted:
        warnings.append(
            "the log does not determine the cycle of the shaping law within "
            f"{MAX_T_C_UNCERTAINTY:.0%}: it is kept at {1e3 * CYCLE:.0f} ms; let the joints move "
            "both slowly and fast"
        )
    times_noise, least_share = MISFIT_LIMITS
    for j, left in enumerate(_rms(fit.residual)):
        share = left / np.std(log.measured[j])
        if left > times_noise * noise[j] and share > least_share:
            warnings.append(
                f"free joint {j + 1} deviates from the model: it leaves "
                f"{1e3 * left:.2g} mrad, {share:.0%} of the motion and {left / noise[j]:.0f} times "
                "the noise; where a torque was at its limit, record slower motions; otherwise its "
                "load shakes it, and its lag is uncertain"
            )
    return tuple(warnings)


def _noise(residual: Array) -> Array:
    """Estimate the white noise in each joint's residual [rad], shape (6,)."""
    return np.std(np.diff(residual, axis=1), axis=1) / sqrt(2.0)


def _typical(sizes: npt.NDArray[np.floating]) -> float:
    """Return the geometric mean over the joints, which the worst joint does not dominate."""
    return exp(float(np.mean(np.log(sizes))))


def _rms(values: Array) -> npt.NDArray[np.floating]:
    """Return the root mean square over the last axis."""
    return np.sqrt(np.mean(values**2, axis=-1))
