r"""How the arm follows the setpoints that it is sent: the actuator, as a model and as a file.

A setpoint takes effect a transport delay after it was sent. Then, once each millisecond:

``kst``, the position servo of the KUKA Sunrise Toolbox's server, joint by joint, with the error
e = setpoint - q and the drive's own response behind it as a first-order lag T:

.. math:: \dot q_c = \frac{a}{t_c} \,\mathrm{sign}(e)\,(1 - e^{-(e/b)^2}), \qquad
          T \ddot q = \dot q_c - \dot q

a = 0.07 rad, b = 0.0525 rad, t_c = 1 ms. It is quadratic near zero: a soft dead band, whose lag
falls with speed (28 ms at 0.05 rad/s, 6 ms at 1 rad/s).

``lag``: T q_dot = e. ``ideal``: q is the setpoint, at once; this is the paper's.

The training plant, the controller's observer and the identification run the kernels below.
"""

import functools
from importlib import resources
from math import exp, expm1, inf, log, log1p, sqrt
from typing import Annotated, ClassVar, Final, Literal, NamedTuple, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from equipoise.artefacts import Artefact, Count, Estimate, Name, Number, Sentence, Value
from equipoise.compiled import inlined, kernel
from equipoise.model.arms.arm import FREE_JOINTS
from equipoise.model.elementary import at, put

Array = npt.NDArray[np.float64]
Kind = Literal["ideal", "lag", "kst"]

IDEAL: Final = 0
LAG: Final = 1
KST: Final = 2
KINDS: Final[tuple[Kind, ...]] = ("ideal", "lag", "kst")

CYCLE: Final = 1e-3
"""Time between two steps of the joint servo [s]."""
AMPLITUDE: Final = 0.07
"""a of the shaping law [rad], as the server's source has it."""
INTERVAL_WIDTH: Final = 0.0525
"""b of the shaping law [rad], as the server's source has it."""
LONGEST_RESPONSE: Final = 10.0
"""Limit on delay, lag and cycle [s]: a pendulum of a metre falls within one."""
SHORTEST_CYCLE: Final = 1e-6
"""Limit on the cycle of the shaping law [s]: its rate stays finite."""
TYPICAL_SPEED: Final = 0.1
"""Joint speed at which `response_time` speaks of the shaping law's lag [rad/s]: balancing moves
the joints at 0.05 to 0.3 rad/s."""


class ActuatorParameters(NamedTuple):
    """An actuator as kernels take it."""

    kind: int
    """IDEAL, LAG or KST."""
    cycle: float = CYCLE
    """t_c of the shaping law [s]."""
    amplitude: float = AMPLITUDE
    """a of the shaping law [rad]."""
    width: float = INTERVAL_WIDTH
    """b of the shaping law [rad]."""


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
    """Return how far from the measured position the server sets its destination [rad].

    Args:
        e: Setpoint minus measured position [rad].
        amplitude: a [rad].
        width: b [rad].
    """
    ratio = e / width
    step = amplitude * _saturation(ratio * ratio)
    return step if e >= 0.0 else -step


@kernel
def follow(
    q: Array, dq: Array, target: Array, share: Array, actuator: ActuatorParameters, lanes: int
) -> None:
    """Advance the free joints of the first lanes by one servo cycle, towards their targets.

    Args:
        q: Joint positions [rad], a block of 6 rows, changed in place.
        dq: Their velocities [rad/s], a block of 6 rows, changed in place.
        target: The setpoints that are in force [rad], a block of 6 rows.
        share: What a lag takes up of a change within a cycle, from `lag_share`, 6 rows.
        actuator: Constants.
        lanes: How many lanes.
    """
    if actuator.kind == KST:
        rate, width = 1.0 / actuator.cycle, actuator.width
        amplitude = actuator.amplitude
        for i in range(FREE_JOINTS):
            for n in range(lanes):
                angle, speed = at(q, i, n), at(dq, i, n)
                wanted = rate * shaped_step(at(target, i, n) - angle, amplitude, width)
                speed += (wanted - speed) * at(share, i, n)
                put(dq, i, n, speed)
                put(q, i, n, angle + CYCLE * speed)
    elif actuator.kind == LAG:
        for i in range(FREE_JOINTS):
            for n in range(lanes):
                move = (at(target, i, n) - at(q, i, n)) * at(share, i, n)
                put(dq, i, n, move / CYCLE)
                put(q, i, n, at(q, i, n) + move)
    else:
        for i in range(FREE_JOINTS):
            for n in range(lanes):
                put(dq, i, n, (at(target, i, n) - at(q, i, n)) / CYCLE)
                put(q, i, n, at(target, i, n))


@inlined
def _in_force(t: float, effect: float, spread: float) -> float:
    """Return for how long a setpoint was in force by t [s], on average over its times of effect."""
    since = t - effect
    if since >= spread:
        return since
    return (since + spread) ** 2 / (4.0 * spread) if since > -spread else 0.0


@kernel
def track(
    stream_time: Array,
    stream_q: Array,
    reply_time: Array,
    reply_q: Array,
    delay: float,
    spread: float,
    lag: float,
    push: float,
    memory: float,
    actuator: ActuatorParameters,
    predicted: Array,
) -> None:
    """Simulate one joint from its first measured position to its last.

    It moves as under `follow`. When the cabinet's cycles begin nobody knows, and transports
    jitter. So cycles begin at the first measurement here, and in each cycle a setpoint has the
    share of the time that it is in force on average: positions depend smoothly on the delay.

    After each measurement an observer may correct position and velocity by what it did not expect
    (a critically damped filter of second order, as radars have it).

    Args:
        stream_time: When setpoints were sent [s], increasing, shape (m,); the first takes effect
            before the first measurement.
        stream_q: The setpoints [rad], shape (m,); each is held until the next takes effect.
        reply_time: When positions were measured [s], increasing, shape (p,), p > 1.
        reply_q: The measured positions [rad], shape (p,).
        delay: From sending a setpoint to its effect [s].
        spread: It takes effect up to this earlier or later, evenly [s].
        lag: T [s].
        push: What the load adds, steadily: to the velocity wanted for `kst` [rad/s], else to the
            setpoint [rad].
        memory: What the observer keeps of its own position and velocity, 0 to 1: with 1 it
            simulates on, with 0 it starts anew at each measurement.
        actuator: Constants.
        predicted: Receives the positions, before their correction [rad], shape (p,).
    """
    rate, amplitude, width = 1.0 / actuator.cycle, actuator.amplitude, actuator.width
    shaped = actuator.kind == KST
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
            if shaped:
                dq += (rate * mean + push - dq) * share
                q += CYCLE * dq
            else:
                q += (mean + push) * share
        predicted[j] = q + (now - reply_time[j]) / CYCLE * (before - q)
        if j > 0:
            surprise = reply_q[j] - predicted[j]
            q += (1.0 - memory**2) * surprise
            before += (1.0 - memory**2) * surprise
            dq += (1.0 - memory) ** 2 * surprise / (reply_time[j] - reply_time[j - 1])


@kernel
def steady_error(dq: float, lag: float, actuator: ActuatorParameters) -> float:
    """Return setpoint minus position of a joint that moves at a constant velocity [rad].

    Args:
        dq: Velocity [rad/s].
        lag: T [s].
        actuator: Constants.
    """
    if actuator.kind == LAG:
        return dq * lag
    if actuator.kind == IDEAL:
        return 0.0
    part = min(abs(dq) * actuator.cycle / actuator.amplitude, 0.999)
    e = actuator.width * sqrt(-log(1.0 - part))
    return e if dq >= 0.0 else -e


def shaped_peak(speed: float, period: float) -> float:
    r"""Return the peak of the velocity that the shaping law asks a joint for [rad/s].

    Setpoints that are a period P apart are v P apart. Each makes the error e_0, from which it falls
    by v P until the next. While it is small the law is quadratic, k = a / (b^2 t_c), and

    .. math:: e_0 = \frac{v P}{2} + \sqrt{\left(\frac{v P}{2}\right)^2 + \frac{v}{k}}, \qquad
              \dot q_c = \frac{a}{t_c} \left(1 - e^{-(e_0 / b)^2}\right)

    A drive that lags evens the steps out, so that the peak is lower there.

    Args:
        speed: Velocity v of the setpoints [rad/s].
        period: Time P between two of them [s].
    """
    half, k = 0.5 * speed * period, AMPLITUDE / (INTERVAL_WIDTH**2 * CYCLE)
    e = half + sqrt(half**2 + speed / k)
    return AMPLITUDE / CYCLE * -expm1(-((e / INTERVAL_WIDTH) ** 2))


def speed_of_peak(peak: float, period: float) -> float:
    """Return the velocity of setpoints at which the shaping law asks for a peak [rad/s].

    The inverse of `shaped_peak`: v = k e_0^2 / (1 + k e_0 P).

    Args:
        peak: Of the velocity that the law asks for, below a / t_c = 70 [rad/s].
        period: Time between two setpoints [s].
    """
    k = AMPLITUDE / (INTERVAL_WIDTH**2 * CYCLE)
    e = INTERVAL_WIDTH * sqrt(-log1p(-peak * CYCLE / AMPLITUDE))
    return k * e**2 / (1.0 + k * e * period)


@kernel
def lag_share(lag: float) -> float:
    """Return what a first-order lag takes up of a change within one servo cycle.

    Args:
        lag: Time constant [s]; zero takes up all of it.
    """
    return 1.0 - exp(-CYCLE / lag) if lag > 0.0 else 1.0


class ActuatorFit(Value):
    """How a log explained the actuator.

    Sizes are those of the typical joint, the geometric mean over the joints: a load that shakes the
    last one does not stand for all.
    """

    source: Name
    """Digest of the run log."""
    samples: Count
    """Measured positions of a joint that were fitted."""
    duration: Number
    """Length of the log [s]."""
    rms: Number
    """Root mean square of measured minus simulated position [rad]."""
    noise: Number
    """What of it changes from one sample to the next, as noise does [rad]."""
    one_step: Number
    """Root mean square error of the prediction of the next measured position [rad]."""
    alternatives: dict[Name, Number]
    """Root mean square that each other kind of actuator leaves [rad]."""
    warnings: Annotated[tuple[Sentence, ...], Field(max_length=100)] = ()
    """Where the model does not explain the log, and what to try."""


class Actuator(Artefact):
    """An actuator as a run log identifies it, with its uncertainty."""

    FORMAT: ClassVar[str] = "equipoise-actuator"
    VERSION: ClassVar[int] = 1

    kind: Kind
    """`kst`: the server's shaping law; `lag`: a first-order lag; `ideal`: none."""
    delay: Estimate
    """From sending a setpoint to its effect [s]."""
    lags: Annotated[tuple[Estimate, ...], Field(min_length=FREE_JOINTS, max_length=FREE_JOINTS)]
    """Time constant T of each free joint [s]."""
    cycle: Estimate
    """t_c of the shaping law [s]."""
    amplitude: float = Field(default=AMPLITUDE, ge=1e-6, le=10.0)
    """a of the shaping law [rad]."""
    width: float = Field(default=INTERVAL_WIDTH, ge=1e-6, le=10.0)
    """b of the shaping law [rad]."""
    fit: ActuatorFit | None = None
    """The log that it was identified from, if any."""

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        times = (self.delay, *self.lags)
        if any(not 0.0 <= time.value <= LONGEST_RESPONSE for time in times):
            raise ValueError(f"a delay or lag is not from 0 to {LONGEST_RESPONSE:g} s")
        if abs(self.delay.high) > LONGEST_RESPONSE:
            raise ValueError(f"the delay's interval reaches beyond {LONGEST_RESPONSE:g} s")
        if not SHORTEST_CYCLE <= self.cycle.value <= LONGEST_RESPONSE:
            raise ValueError(f"the cycle is not from {SHORTEST_CYCLE:g} to {LONGEST_RESPONSE:g} s")
        return self

    @classmethod
    def assumed(
        cls, kind: Kind, *, delay: float = 0.0, lag: float = 0.0, cycle: float = CYCLE
    ) -> Self:
        """Return an actuator that nobody measured: its intervals have no width.

        Args:
            kind: `ideal`, `lag` or `kst`.
            delay: From sending a setpoint to its effect [s].
            lag: Time constant of every joint [s].
            cycle: t_c of the shaping law [s].
        """

        def exactly(value: float) -> Estimate:
            return Estimate(value=value, low=value, high=value, source="assumed")

        return cls(
            kind=kind,
            delay=exactly(delay),
            lags=(exactly(lag),) * FREE_JOINTS,
            cycle=exactly(cycle),
        )

    @property
    def parameters(self) -> ActuatorParameters:
        """The best values, as kernels take them."""
        return ActuatorParameters(
            kind=KINDS.index(self.kind),
            cycle=self.cycle.value,
            amplitude=self.amplitude,
            width=self.width,
        )

    def response_time(self, joint: int, speed: float = TYPICAL_SPEED) -> float:
        """Return how long a joint takes to follow a small change, transport apart [s].

        The drive's lag, and for `kst` the reciprocal slope of the shaping law at the error that
        a speed keeps up.

        Args:
            joint: Which free joint, counted from zero.
            speed: Joint speed [rad/s].
        """
        lag = self.lags[joint].value
        if self.kind != "kst":
            return lag
        e = steady_error(speed, lag, self.parameters)
        slope = 2.0 * self.amplitude * e / self.width**2 * exp(-((e / self.width) ** 2))
        return lag + (self.cycle.value / slope if slope > 0.0 else inf)


IDEAL_ACTUATOR: Final = Actuator.assumed("ideal")
"""The paper's: the arm is where it is sent, at once."""


@functools.cache
def shipped_actuator() -> Actuator:
    """Return the actuator that ships with Equipoise, identified from the twin `nominal`."""
    with resources.as_file(resources.files("equipoise") / "data" / "actuator.json") as path:
        return Actuator.load(path)
