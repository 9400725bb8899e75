r"""Actuator: model and file format of an arm's response to setpoints.

A setpoint takes effect a transport delay after it was sent. Then the servo moves each joint once
per millisecond, by one of four laws.

``kst`` is the position servo of the KUKA Sunrise Toolbox's server, with the error e = setpoint - q,
followed by the response of the drive as a first-order lag T:

.. math:: \dot q_c = \frac{a}{t_c} \,\mathrm{sign}(e)\,(1 - e^{-(e/b)^2}), \qquad
          T \ddot q = \dot q_c - \dot q

a = 0.07 rad, b = 0.0525 rad, t_c = 1 ms. The law is quadratic near zero: a soft dead band, whose
lag decreases with speed (28 ms at 0.05 rad/s, 6 ms at 1 rad/s).

``unshaped``: the same drive without the shaping law, q_dot_c = e / t_c. ``lag``: T q_dot = e.
``ideal``: q equals the setpoint immediately, as in the paper.

The training plant, the controller's observer and the identification use the kernels below.
"""

import functools
from math import exp, inf, log, log1p, sqrt
from typing import Annotated, ClassVar, Final, Literal, NamedTuple, Protocol, Self

import numpy as np
from pydantic import Field, model_validator

from equipoise.arm.arm import FREE_JOINTS
from equipoise.arrays import Array
from equipoise.elementary import BATCH_SIZE, fma
from equipoise.files import Artefact, Count, Estimate, Name, Number, Sentence, StrPath, Value
from equipoise.jit import PACKAGE, compilable, inlined, kernel

Kind = Literal["ideal", "lag", "unshaped", "kst"]

IDEAL, LAG, UNSHAPED, KST = range(4)
"""Codes of the kinds of actuator in kernels, their places in `KINDS`."""
KINDS: Final[tuple[Kind, ...]] = ("ideal", "lag", "unshaped", "kst")
LAWS: Final[tuple[Kind, ...]] = ("unshaped", "kst")
"""Kinds with the inertia of a servo, and with its t_c."""

CYCLE: Final = 1e-3
"""Period of the joint servo [s]."""
AMPLITUDE: Final = 0.07
"""a of the shaping law [rad], from the server's source."""
INTERVAL_WIDTH: Final = 0.0525
"""b of the shaping law [rad], from the server's source."""
MAX_RESPONSE_TIME: Final = 10.0
"""Limit on delay, lag and cycle [s]: a pendulum of a metre falls within one."""
MIN_CYCLE: Final = 1e-6
"""Lower limit on the cycle of the shaping law [s], which keeps its rate finite."""
FUSED_CYCLES: Final = 5
"""Number of servo cycles that lanes advance in registers: a setpoint of 5 ms."""
NEAR: Final = 0.2
"""Error below which the law is a short series [widths]: 10 mrad, the steady error at 2.7 rad/s."""
ROWS: Final = (FREE_JOINTS, BATCH_SIZE)
"""Shape of a field with a row for each free joint."""


class ActuatorParameters(NamedTuple):
    """Actuator parameters for kernels."""

    kind: int
    """IDEAL, LAG, UNSHAPED or KST."""
    cycle: float = CYCLE
    """t_c of the servo [s]."""
    amplitude: float = AMPLITUDE
    """a of the shaping law [rad]."""
    width: float = INTERVAL_WIDTH
    """b of the shaping law [rad]."""


@inlined
def _near_gain(z: float, amplitude: float, width: float) -> float:
    """Return a (1 - exp(-z / b^2)) / z for z <= (NEAR b)^2, to 1e-12: near minimax."""
    # The factors do not depend on z: a compiler takes them out of a loop.
    s = 1.0 / (width * width)
    gain1 = amplitude * s
    gain2 = gain1 * s
    gain3 = gain2 * s
    gain4 = gain3 * s
    p = fma(z, gain4 * s * 0.008195725493063237, gain4 * -0.04166186463547304)
    p = fma(z, p, gain3 * 0.1666665981572807)
    return fma(z, fma(z, p, gain2 * -0.49999999965765884), gain1 * 0.9999999999997261)


@inlined
def _saturation(z: float) -> float:
    """Return 1 - exp(-z) for z >= 0, to 1e-12, without a call: see `equipoise.elementary`."""
    # Taylor's series at z / 256, doubled eight times: 1 - (1 - p)^2 = p (2 - p).
    t = min(z, 40.0) * (1.0 / 256.0)
    p = 1.0 / 24.0 - t * (1.0 / 120.0 - t * (1.0 / 720.0))
    p = t * (1.0 - t * (0.5 - t * (1.0 / 6.0 - t * p)))
    for _ in range(8):
        p = p * (2.0 - p)
    return p


@inlined
def shaped_step(e: float, amplitude: float, width: float) -> float:
    """Return the step from the measured position to the server's destination [rad].

    Args:
        e: Setpoint minus measured position [rad].
        amplitude: a [rad].
        width: b [rad].
    """
    if abs(e) <= NEAR * width:
        return e * abs(e) * _near_gain(e * e, amplitude, width)
    ratio = e * (1.0 / width)
    step = amplitude * _saturation(ratio * ratio)
    return step if e >= 0.0 else -step


@inlined
def _shaped_velocity(
    e: float, dq: float, fraction: float, far: bool, actuator: ActuatorParameters
) -> float:
    """Return the velocity of a joint after a servo cycle of the shaping law [rad/s].

    Args:
        e: Setpoint minus position at the beginning [rad].
        dq: Velocity then [rad/s].
        fraction: Gain of the lag per cycle.
        far: Whether the error may exceed NEAR widths; if not, the law is a short series.
        actuator: Constants.
    """
    rate, width = actuator.amplitude / actuator.cycle, actuator.width
    square = e * abs(e)
    change = fma(square, _near_gain(abs(square), rate, width), -dq)
    if far and abs(e) > NEAR * width:
        change = shaped_step(e, rate, width) - dq
    return fma(change, fraction, dq)


class Servos(Protocol):
    """Servos of the free joints of `BATCH_SIZE` arms; kernels change them in place."""

    q: Annotated[Array, ROWS]
    """Joint positions [rad]."""
    dq: Annotated[Array, ROWS]
    """Joint velocities [rad/s]."""
    velocity: Annotated[Array, ROWS]
    """Mean velocity of the motion under the last setpoint [rad/s]; unused behind `KST`."""
    fraction: Annotated[Array, ROWS]
    """Gain of the lag per cycle, from `lag_fraction`."""
    before: Annotated[Array, ROWS]
    """Setpoints in force in the cycles before `turn` [rad]."""
    target: Annotated[Array, ROWS]
    """Setpoints in force in the others [rad]."""
    turn: Annotated[Array, ROWS]
    """Number of the first cycle with `target`; zero without a delay."""
    q_before: Annotated[Array, ROWS]
    """Joint positions before the last setpoint [rad]."""
    q_ahead: Annotated[Array, ROWS]
    """Joint positions after some cycles [rad], until `q` takes them over."""
    dq_ahead: Annotated[Array, ROWS]
    """Joint velocities then [rad/s]."""


@inlined
def follow(arm: Servos, actuator: ActuatorParameters, cycle: int, lanes: int) -> None:
    """Advance the joints of the first lanes by one servo cycle towards their setpoints.

    Args:
        arm: Changed in place.
        actuator: Constants.
        cycle: Number of the cycle since the setpoints were sent.
        lanes: Number of lanes.
    """
    q, dq, fraction = arm.q, arm.dq, arm.fraction
    before, target, turn = arm.before, arm.target, arm.turn
    for i in range(FREE_JOINTS):
        for n in range(lanes):
            # Both are loaded: a compiler vectorises no loop in which a condition decides what is.
            old, new = before[i, n], target[i, n]
            setpoint = old if cycle < turn[i, n] else new
            e = setpoint - q[i, n]
            if actuator.kind == KST:
                dq[i, n] = _shaped_velocity(e, dq[i, n], fraction[i, n], True, actuator)
                q[i, n] = fma(CYCLE, dq[i, n], q[i, n])
            elif actuator.kind == UNSHAPED:
                dq[i, n] = fma(e / actuator.cycle - dq[i, n], fraction[i, n], dq[i, n])
                q[i, n] = fma(CYCLE, dq[i, n], q[i, n])
            elif actuator.kind == LAG:
                dq[i, n] = e * fraction[i, n] / CYCLE
                q[i, n] += e * fraction[i, n]
            else:
                dq[i, n] = e / CYCLE
                q[i, n] = setpoint


def follow_setpoint(
    arm: Servos, actuator: ActuatorParameters, cycles: int, delayed: bool, lanes: int
) -> None:
    """Advance the joints of the first lanes by the servo cycles of one setpoint.

    Args:
        arm: Changed in place.
        actuator: Constants.
        cycles: Number of cycles.
        delayed: Whether the setpoint takes effect after the first cycles; else `turn` is zero.
        lanes: Number of lanes.
    """
    q, velocity, q_before = arm.q, arm.velocity, arm.q_before
    cycle = 0
    if actuator.kind == KST:
        while cycle < cycles:
            fused = lanes > 1 and cycle + FUSED_CYCLES <= cycles
            if fused and delayed:
                fused = _follow_fused(arm, actuator, cycle, True, lanes)
            elif fused:
                fused = _follow_fused(arm, actuator, cycle, False, lanes)
            if not fused:
                follow(arm, actuator, cycle, lanes)
            cycle += FUSED_CYCLES if fused else 1
        return
    for i in range(FREE_JOINTS):
        for n in range(BATCH_SIZE):
            q_before[i, n] = q[i, n]
    for cycle in range(cycles):
        follow(arm, actuator, cycle, lanes)
    for i in range(FREE_JOINTS):
        for n in range(BATCH_SIZE):
            velocity[i, n] = (q[i, n] - q_before[i, n]) * (1.0 / (cycles * CYCLE))


@inlined
def motion_of(arm: Servos, actuator: ActuatorParameters) -> Array:
    """Return the joint velocities of the motion under the last setpoint [rad/s], 6 rows.

    Behind `KST` those at its end; otherwise their means, since a fast servo moves in steps.
    """
    return arm.dq if actuator.kind == KST else arm.velocity


@inlined
def _follow_fused(
    arm: Servos, actuator: ActuatorParameters, first: int, delayed: bool, lanes: int
) -> bool:
    """Advance all lanes by `FUSED_CYCLES` cycles of the shaping law, and return True.

    Joints are almost always near their setpoints: for them the law is a short series. Where one of
    the first lanes is not, nothing changes. Both ways give equal bits where the series holds.
    """
    q, dq, q_ahead, dq_ahead, fraction = arm.q, arm.dq, arm.q_ahead, arm.dq_ahead, arm.fraction
    before, target, turn = arm.before, arm.target, arm.turn
    limit, half = NEAR * actuator.width, FREE_JOINTS // 2
    far = False
    # Two joints at a time: while one number waits for its last cycle, the other continues.
    for i in range(half):
        j = half + i
        for n in range(BATCH_SIZE):
            q_i, dq_i, q_j, dq_j = q[i, n], dq[i, n], q[j, n], dq[j, n]
            old_i, new_i, turn_i, gain_i = before[i, n], target[i, n], turn[i, n], fraction[i, n]
            old_j, new_j, turn_j, gain_j = before[j, n], target[j, n], turn[j, n], fraction[j, n]
            away = False
            for cycle in range(FUSED_CYCLES):
                e_i = (old_i if delayed and first + cycle < turn_i else new_i) - q_i
                e_j = (old_j if delayed and first + cycle < turn_j else new_j) - q_j
                away |= (abs(e_i) > limit) | (abs(e_j) > limit)
                dq_i = _shaped_velocity(e_i, dq_i, gain_i, False, actuator)
                dq_j = _shaped_velocity(e_j, dq_j, gain_j, False, actuator)
                q_i = fma(CYCLE, dq_i, q_i)
                q_j = fma(CYCLE, dq_j, q_j)
            far |= away & (n < lanes)
            q_ahead[i, n], dq_ahead[i, n] = q_i, dq_i
            q_ahead[j, n], dq_ahead[j, n] = q_j, dq_j
    if far:
        return False
    for i in range(FREE_JOINTS):
        for n in range(BATCH_SIZE):
            q[i, n], dq[i, n] = q_ahead[i, n], dq_ahead[i, n]
    return True


@inlined
def _in_force(t: float, effect: float, spread: float) -> float:
    """Return the mean active time of a setpoint until `t` over its possible delays [s]."""
    since = t - effect
    if since >= spread:
        return since
    return (since + spread) ** 2 / (4.0 * spread) if since > -spread else 0.0


class JointResponse(NamedTuple):
    """Model of one joint's response to setpoints."""

    delay: float
    """Time from sending a setpoint to its effect [s]."""
    lag: float
    """T [s]."""
    actuator: ActuatorParameters
    """Constants of the servo."""
    spread: float = 0.0
    """Half width of the uniform distribution of the delay [s]."""
    push: float = 0.0
    """Constant bias of the load, on the desired velocity for `unshaped` and `kst` [rad/s], else on
    the setpoint [rad]."""


@kernel
def track(
    stream_time: Array, stream_q: Array, reply_time: Array, reply_q: Array, response: JointResponse
) -> Array:
    """Simulate one joint from its first measured position to its last.

    The joint moves as under `follow`. The phase of the servo's cycles is unknown, and transports
    jitter. Therefore cycles begin at the first measurement, and within a cycle each setpoint is
    weighted by its mean active time, so that positions depend smoothly on the delay.

    Args:
        stream_time: Send times of the setpoints [s], increasing, shape (m,); the first takes effect
            before the first measurement.
        stream_q: Setpoints [rad], shape (m,); each is held until the next takes effect.
        reply_time: Measurement times [s], increasing, shape (p,), p > 1.
        reply_q: Measured positions [rad], shape (p,).
        response: Model of the joint.

    Returns:
        Positions at the measurement times [rad], shape (p,).
    """
    predicted = np.empty(len(reply_time))
    delay, lag, actuator, spread, push = response
    rate, amplitude, width = 1.0 / actuator.cycle, actuator.amplitude, actuator.width
    shaped, driven = actuator.kind == KST, actuator.kind >= UNSHAPED
    fraction = 1.0 if actuator.kind == IDEAL else lag_fraction(lag)
    q, dq = reply_q[0], (reply_q[1] - reply_q[0]) / (reply_time[1] - reply_time[0])
    before, now, cycles, newest = q, reply_time[0], 0, 0
    for j in range(len(reply_time)):
        while now < reply_time[j]:
            begin = now
            cycles += 1
            now = reply_time[0] + cycles * CYCLE
            while newest + 1 < len(stream_time) and (
                stream_time[newest + 1] + delay + spread <= begin
            ):
                newest += 1
            e = stream_q[newest] - q
            step = shaped_step(e, amplitude, width) if shaped else e
            mean, i = step, newest + 1
            while i < len(stream_time) and stream_time[i] + delay - spread < now:
                effect = stream_time[i] + delay
                part = _in_force(now, effect, spread) - _in_force(begin, effect, spread)
                e = stream_q[i] - q
                other = shaped_step(e, amplitude, width) if shaped else e
                mean += part / (now - begin) * (other - step)
                step, i = other, i + 1
            before = q
            if driven:
                dq += (rate * mean + push - dq) * fraction
                q += CYCLE * dq
            else:
                q += (mean + push) * fraction
        predicted[j] = q + (now - reply_time[j]) / CYCLE * (before - q)
    return predicted


@compilable
def steady_error(dq: float, lag: float, actuator: ActuatorParameters) -> float:
    """Return setpoint minus position of a joint that moves at a constant velocity [rad].

    Args:
        dq: Velocity [rad/s].
        lag: T [s].
        actuator: Constants.
    """
    if actuator.kind == LAG:
        return dq * lag
    if actuator.kind == UNSHAPED:
        return dq * actuator.cycle
    if actuator.kind == IDEAL:
        return 0.0
    part = min(abs(dq) * actuator.cycle / actuator.amplitude, 0.999)
    e = actuator.width * sqrt(-log(1.0 - part))
    return e if dq >= 0.0 else -e


def speed_of_peak(peak: float, period: float) -> float:
    r"""Return the setpoint velocity v that gives a peak velocity command [rad/s].

    Setpoints at intervals of P differ by v P. Each raises the error to e_0, from which it falls by
    v P until the next. For small errors the law is quadratic, k = a / (b^2 t_c), and

    .. math:: \dot q_c = \frac{a}{t_c} \left(1 - e^{-(e_0 / b)^2}\right), \qquad
              v = \frac{k e_0^2}{1 + k e_0 P}

    The lag of a drive smooths the steps and lowers the peak.

    Args:
        peak: Peak velocity command of the law, below a / t_c = 70 [rad/s].
        period: Period P of the setpoints [s].
    """
    k = AMPLITUDE / (INTERVAL_WIDTH**2 * CYCLE)
    e = INTERVAL_WIDTH * sqrt(-log1p(-peak * CYCLE / AMPLITUDE))
    return k * e**2 / (1.0 + k * e * period)


@compilable
def lag_fraction(lag: float) -> float:
    """Return the fraction of a change that a first-order lag follows within one servo cycle.

    Args:
        lag: Time constant [s]; zero gives 1.
    """
    return 1.0 - exp(-CYCLE / lag) if lag > 0.0 else 1.0


class ActuatorFit(Value):
    """Fit of an actuator to a run log.

    Residuals are geometric means over the joints, which a load that shakes the last joint does not
    dominate.
    """

    source: Name
    """Digest of the run log."""
    samples: Count
    """Number of fitted positions per joint."""
    duration: Number
    """Length of the log [s]."""
    rms: Number
    """Root mean square of measured minus simulated position [rad]."""
    noise: Number
    """White noise in the residual [rad]."""
    alternatives: dict[Name, Number]
    """Root mean square residual of each other kind of actuator [rad]."""
    warnings: Annotated[tuple[Sentence, ...], Field(max_length=100)] = ()
    """Warnings about a poor fit, with remedies."""


class Actuator(Artefact):
    """Actuator that was identified from a run log, with its uncertainty."""

    FORMAT: ClassVar[str] = "equipoise-actuator"

    kind: Kind
    """`kst`: the server's shaping law; `unshaped`: a drive towards the setpoint; `lag`: a
    first-order lag; `ideal`: none."""
    delay: Estimate
    """Transport delay from sending a setpoint to its effect [s]."""
    lags: Annotated[tuple[Estimate, ...], Field(min_length=FREE_JOINTS, max_length=FREE_JOINTS)]
    """Time constant T of each free joint with what it carries [s]."""
    cycle: Estimate
    """t_c of the servo, for `unshaped` and `kst` [s]."""
    amplitude: float = Field(default=AMPLITUDE, ge=1e-6, le=10.0)
    """a of the shaping law [rad]."""
    width: float = Field(default=INTERVAL_WIDTH, ge=1e-6, le=10.0)
    """b of the shaping law [rad]."""
    fit: ActuatorFit | None = None
    """Fit to the run log; None for an assumed actuator."""

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        times = (self.delay, *self.lags)
        if self.kind == "ideal" and any(time.value for time in times):
            raise ValueError("an ideal actuator has no delay and no lag")
        if any(not 0.0 <= time.value <= MAX_RESPONSE_TIME for time in times):
            raise ValueError(f"a delay or lag is not from 0 to {MAX_RESPONSE_TIME:g} s")
        if abs(self.delay.high) > MAX_RESPONSE_TIME:
            raise ValueError(f"the delay's interval reaches beyond {MAX_RESPONSE_TIME:g} s")
        if not MIN_CYCLE <= self.cycle.value <= MAX_RESPONSE_TIME:
            raise ValueError(f"the cycle is not from {MIN_CYCLE:g} to {MAX_RESPONSE_TIME:g} s")
        return self

    @classmethod
    def assumed(
        cls, kind: Kind, *, delay: float = 0.0, lag: float = 0.0, cycle: float = CYCLE
    ) -> Self:
        """Return an assumed actuator, with intervals of zero width.

        Args:
            kind: `ideal`, `lag`, `unshaped` or `kst`.
            delay: Time from sending a setpoint to its effect [s].
            lag: Time constant of every joint [s].
            cycle: t_c of the servo [s].
        """
        delay_, lag_, cycle_ = (Estimate.around(v, 0.0, "assumed") for v in (delay, lag, cycle))
        return cls(kind=kind, delay=delay_, lags=(lag_,) * FREE_JOINTS, cycle=cycle_)

    @property
    def parameters(self) -> ActuatorParameters:
        """Best values as parameters for kernels."""
        kind, cycle = KINDS.index(self.kind), self.cycle.value
        return ActuatorParameters(kind, cycle, self.amplitude, self.width)

    @property
    def summary(self) -> str:
        """Kind, delay, t_c and lags in a few words."""
        lags = [1e3 * lag.value for lag in self.lags]
        law = f"t_c {1e3 * self.cycle.value:.1f} ms, " if self.kind in LAWS else ""
        delay = 1e3 * self.delay.value
        return f"{self.kind}, delay {delay:.1f} ms, {law}lags {min(lags):.1f} to {max(lags):.1f} ms"

    def response_time(self, joint: int, speed: float = 0.1) -> float:
        """Return the response time of a joint to a small change, without transport [s].

        The sum of the drive's lag and the reciprocal slope of the servo's law: t_c for `unshaped`;
        for `kst` at the steady error of a speed.

        Args:
            joint: Index of the free joint, from zero.
            speed: Joint speed [rad/s]; balancing moves the joints at 0.05 to 0.3 rad/s.
        """
        lag = self.lags[joint].value
        if self.kind == "unshaped":
            return lag + self.cycle.value
        if self.kind != "kst":
            return lag
        e = steady_error(speed, lag, self.parameters)
        slope = 2.0 * self.amplitude * e / self.width**2 * exp(-((e / self.width) ** 2))
        return lag + (self.cycle.value / slope if slope > 0.0 else inf)


IDEAL_ACTUATOR: Final = Actuator.assumed("ideal")
"""Actuator of the paper: the arm reaches a setpoint immediately."""


def read_actuator(actuator: Actuator | StrPath | None) -> Actuator:
    """Return a given actuator, that of a file, the ideal one (`ideal`), or by default the shipped.

    Raises:
        ArtefactError: The file holds no actuator.
    """
    if actuator is None:
        return shipped_actuator()
    if isinstance(actuator, Actuator):
        return actuator
    return IDEAL_ACTUATOR if actuator == "ideal" else Actuator.load(actuator)


@functools.cache
def shipped_actuator() -> Actuator:
    """Load the actuator that ships with Equipoise, identified on the digital twin."""
    return Actuator.load(PACKAGE / "data" / "actuator.json")
