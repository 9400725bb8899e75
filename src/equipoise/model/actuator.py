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
from typing import Annotated, ClassVar, Final, Literal, NamedTuple, Self

from pydantic import Field, model_validator

from equipoise.arrays import Array
from equipoise.artefacts import Artefact, Count, Estimate, Name, Number, Sentence, StrPath, Value
from equipoise.jit import PACKAGE, called, inlined, kernel
from equipoise.model.arms.arm import FREE_JOINTS
from equipoise.model.elementary import BATCH_SIZE, fma

Kind = Literal["ideal", "lag", "unshaped", "kst"]

IDEAL: Final = 0
LAG: Final = 1
UNSHAPED: Final = 2
KST: Final = 3
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
TYPICAL_SPEED: Final = 0.1
"""Default joint speed of `response_time` [rad/s]: balancing moves the joints at 0.05 to 0.3
rad/s."""


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
    """Return 1 - exp(-z) for z >= 0, to 1e-12, without a call: see `equipoise.model.elementary`."""
    # Taylor's series at z / 256, doubled eight times: 1 - (1 - p)^2 = p (2 - p).
    t = min(z, 40.0) * (1.0 / 256.0)
    p = 1.0 / 24.0 - t * (1.0 / 120.0 - t * (1.0 / 720.0))
    p = t * (1.0 - t * (0.5 - t * (1.0 / 6.0 - t * p)))
    p = p * (2.0 - p)
    p = p * (2.0 - p)
    p = p * (2.0 - p)
    p = p * (2.0 - p)
    p = p * (2.0 - p)
    p = p * (2.0 - p)
    p = p * (2.0 - p)
    return p * (2.0 - p)


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
    e: float, dq: float, share: float, far: bool, actuator: ActuatorParameters
) -> float:
    """Return the velocity of a joint after a servo cycle of the shaping law [rad/s].

    Args:
        e: Setpoint minus position at the beginning [rad].
        dq: Velocity then [rad/s].
        share: Gain of the lag per cycle.
        far: Whether the error may exceed NEAR widths; if not, the law is a short series.
        actuator: Constants.
    """
    rate, width = actuator.amplitude / actuator.cycle, actuator.width
    square = e * abs(e)
    change = fma(square, _near_gain(abs(square), rate, width), -dq)
    if far and abs(e) > NEAR * width:
        change = shaped_step(e, rate, width) - dq
    return fma(change, share, dq)


@inlined
def follow(
    q: Array, dq: Array, target: Array, share: Array, actuator: ActuatorParameters, lanes: int
) -> None:
    """Advance the free joints of the first lanes by one servo cycle towards their targets.

    Args:
        q: Joint positions [rad], a block of 6 rows, changed in place.
        dq: Joint velocities [rad/s], a block of 6 rows, changed in place.
        target: Active setpoints [rad], a block of 6 rows.
        share: Gain of the lag per cycle, from `lag_share`, a block of 6 rows.
        actuator: Constants.
        lanes: Number of lanes.
    """
    # Flat loops over adjacent numbers: the lanes that are not in use are computed as well.
    count, stride = (FREE_JOINTS, BATCH_SIZE) if lanes == 1 else (FREE_JOINTS * BATCH_SIZE, 1)
    if actuator.kind == KST:
        for i in range(0, count * stride, stride):
            dq[i] = _shaped_velocity(target[i] - q[i], dq[i], share[i], True, actuator)
            q[i] = fma(CYCLE, dq[i], q[i])
        return
    for i in range(0, count * stride, stride):
        e = target[i] - q[i]
        if actuator.kind == UNSHAPED:
            dq[i] = fma(e / actuator.cycle - dq[i], share[i], dq[i])
            q[i] = fma(CYCLE, dq[i], q[i])
        elif actuator.kind == LAG:
            dq[i] = e * share[i] / CYCLE
            q[i] += e * share[i]
        else:
            dq[i] = e / CYCLE
            q[i] = target[i]


class DelayedSetpoint(NamedTuple):
    """A setpoint that takes effect in one of the servo cycles until the next one."""

    before: Array
    """Setpoints in force in the first cycles [rad], a block of 6 rows."""
    target: Array
    """Setpoints in force in the others [rad], a block of 6 rows."""
    turn: Array
    """Number of the first cycle with `target`, a block of 6 rows."""
    delayed: bool
    """Whether `before` and `turn` are used; otherwise `target` is always in force."""


@inlined
def follow_setpoint(
    q: Array,
    dq: Array,
    setpoint: DelayedSetpoint,
    share: Array,
    actuator: ActuatorParameters,
    cycles: int,
    scratch: Array,
    lanes: int,
) -> None:
    """Advance the free joints of the first lanes by the servo cycles of one setpoint.

    Args:
        q: Joint positions [rad], a block of 6 rows, changed in place.
        dq: Joint velocities [rad/s], a block of 6 rows, changed in place.
        setpoint: The setpoint.
        share: Gain of the lag per cycle, from `lag_share`, a block of 6 rows.
        actuator: Constants.
        cycles: Number of cycles.
        scratch: A block of 12 rows. The last 6 receive the velocity of the motion [rad/s]: behind
            `KST` that at its end, otherwise its mean, since a fast servo moves in steps.
        lanes: Number of lanes.
    """
    velocity = scratch[FREE_JOINTS * BATCH_SIZE :]
    if actuator.kind != KST:
        for i in range(FREE_JOINTS * BATCH_SIZE):
            velocity[i] = q[i]
    cycle = 0
    if actuator.kind == KST and lanes > 1:
        while cycle + FUSED_CYCLES <= cycles:
            _follow_fused(q, dq, setpoint, share, actuator, cycle, scratch)
            cycle += FUSED_CYCLES
    while cycle < cycles:
        aim = setpoint.target
        if setpoint.delayed:
            aim = scratch
            aim_at(cycle, setpoint, aim)
        follow(q, dq, aim, share, actuator, lanes)
        cycle += 1
    for i in range(FREE_JOINTS * BATCH_SIZE):
        mean = (q[i] - velocity[i]) * (1.0 / (cycles * CYCLE))
        velocity[i] = dq[i] if actuator.kind == KST else mean


@inlined
def aim_at(cycle: int, setpoint: DelayedSetpoint, aim: Array) -> None:
    """Write the setpoints in force in a cycle to `aim`, a block of 6 rows."""
    before, target, turn = setpoint.before, setpoint.target, setpoint.turn
    for i in range(FREE_JOINTS * BATCH_SIZE):
        old, new = before[i], target[i]
        aim[i] = old if cycle < turn[i] else new


@inlined
def _follow_fused(
    q: Array,
    dq: Array,
    setpoint: DelayedSetpoint,
    share: Array,
    actuator: ActuatorParameters,
    first: int,
    scratch: Array,
) -> None:
    """Advance the free joints of all lanes by `FUSED_CYCLES` cycles of the shaping law."""
    before, target, turn, delayed = setpoint
    count, limit = FREE_JOINTS * BATCH_SIZE, NEAR * actuator.width
    # Joints are almost always near their setpoints: for them the law is a short series. Both loops
    # give equal bits where it holds.
    far = 0
    # Two joints at a time: while one number waits for its last cycle, the other continues.
    half = count // 2
    for i in range(half):
        angle, speed, other_angle, other_speed = q[i], dq[i], q[half + i], dq[half + i]
        old, new, change, gain = before[i], target[i], turn[i], share[i]
        other_old, other_new = before[half + i], target[half + i]
        other_change, other_gain = turn[half + i], share[half + i]
        for cycle in range(FUSED_CYCLES):
            e = (old if delayed and first + cycle < change else new) - angle
            other_e = other_old if delayed and first + cycle < other_change else other_new
            other_e -= other_angle
            far |= (abs(e) > limit) | (abs(other_e) > limit)
            speed = _shaped_velocity(e, speed, gain, False, actuator)
            other_speed = _shaped_velocity(other_e, other_speed, other_gain, False, actuator)
            angle = fma(CYCLE, speed, angle)
            other_angle = fma(CYCLE, other_speed, other_angle)
        scratch[i], scratch[count + i] = angle, speed
        scratch[half + i], scratch[count + half + i] = other_angle, other_speed
    if far:
        for i in range(count):
            scratch[i], scratch[count + i] = q[i], dq[i]
        for cycle in range(FUSED_CYCLES):
            for i in range(count):
                angle, speed = scratch[i], scratch[count + i]
                old, new = before[i], target[i]
                aim = old if delayed and first + cycle < turn[i] else new
                speed = _shaped_velocity(aim - angle, speed, share[i], True, actuator)
                scratch[i], scratch[count + i] = fma(CYCLE, speed, angle), speed
    for i in range(count):
        q[i], dq[i] = scratch[i], scratch[count + i]


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
    stream_time: Array,
    stream_q: Array,
    reply_time: Array,
    reply_q: Array,
    response: JointResponse,
    predicted: Array,
) -> None:
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
        predicted: Receives the positions [rad], shape (p,).
    """
    delay, lag, actuator, spread, push = response
    rate, amplitude, width = 1.0 / actuator.cycle, actuator.amplitude, actuator.width
    shaped, driven = actuator.kind == KST, actuator.kind >= UNSHAPED
    share = 1.0 if actuator.kind == IDEAL else lag_share(lag)
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
                dq += (rate * mean + push - dq) * share
                q += CYCLE * dq
            else:
                q += (mean + push) * share
        predicted[j] = q + (now - reply_time[j]) / CYCLE * (before - q)


@called
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


@called
def lag_share(lag: float) -> float:
    """Return the share of a change that a first-order lag follows within one servo cycle.

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

    def response_time(self, joint: int, speed: float = TYPICAL_SPEED) -> float:
        """Return the response time of a joint to a small change, without transport [s].

        The sum of the drive's lag and the reciprocal slope of the servo's law: t_c for `unshaped`;
        for `kst` at the steady error of a speed.

        Args:
            joint: Index of the free joint, from zero.
            speed: Joint speed [rad/s].
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


def read_actuator(given: Actuator | StrPath | None) -> Actuator:
    """Return a given actuator, that of a file, the ideal one (`ideal`), or by default the shipped.

    Raises:
        ArtefactError: The file holds no actuator.
    """
    if given is None:
        return shipped_actuator()
    if isinstance(given, Actuator):
        return given
    return IDEAL_ACTUATOR if given == "ideal" else Actuator.load(given)


@functools.cache
def shipped_actuator() -> Actuator:
    """Load the actuator that ships with Equipoise, identified on the digital twin."""
    return Actuator.load(PACKAGE / "data" / "actuator.json")
