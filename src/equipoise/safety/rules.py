r"""Safety rules of a run on a rig: pure functions that return the broken rules.

Two checks, both without a clock and without I/O:

`check_setpoint`, `check_first`
    Check of a setpoint, just before it is sent: the first broken rule, or None.
`violations`
    Check of the run, once per tick, from its current state (`SafetyInputs`) and the state of the
    checks that span several ticks (`MonitorState`, from `update_monitor`): all broken rules.

A broken rule leads to a latched stop (`equipoise.safety.stop`). The rows of
`equipoise.outcomes.Outcome` list the rules in their order, with sentence, advice, and the limit
where a rule compares one input with a number.

The deciding functions are `@compilable`: the same ones run in the trials of the digital twin
(`equipoise.safety.trial`), where a broken rule ends the trial. They return codes and
numbers, of which this module makes an `End`.

Rules never clip: with a reduced setpoint the controller would continue a motion that does not
happen.

The joints' limits are those of the rig's arm; all other limits stand here with their reasons. These
rules are no safety functions in the sense of a standard: they run on a PC that may fail, and a
robot without a watchdog then moves on to its last target. The rules keep that target near.
"""

from collections.abc import Sequence
from itertools import pairwise
from math import copysign, inf, isfinite, radians
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.arm.arm import Arm
from equipoise.jit import compilable
from equipoise.outcomes import SAFETY_RULES, End, Numbers, Outcome, SafetyInputs

Row = Sequence[float] | npt.NDArray[np.float64]
"""One number per joint, from Python or from a kernel."""

POSITION_MARGIN: Final = radians(3.0)
"""Margin of setpoints inside the position limits [rad]; at a limit the robot controller's own
supervision stops the arm with its brakes."""
STEP_LIMIT: Final = radians(2.0)
"""Maximum step between two setpoints [rad], at any interval: five times the travel of an iiwa's
slowest joint in 5 ms. It catches degrees given for radians."""
FIRST_LIMIT: Final = 0.005
"""Maximum distance of the first setpoint from the measured posture [rad]: 5 mm at arm's length, a
hundred times the noise of a measured joint."""
ROUNDING: Final = 1e-6
"""Relative tolerance of velocities and accelerations [-], which are differences of setpoints."""
STOP_DECELERATION: Final = 4.0
"""Deceleration of the flange on the way to rest [m/s^2]: twice the largest command, which a
balancing arm follows with reserve."""
TRACK_LIMIT: Final = paper.X_LIMIT
"""Track limit: maximum distance of the flange from home [m]."""
ANGLE_RULE_LIMIT: Final = radians(paper.PHI_LIMIT_DEG)
"""Failure angle of the pendulum from upright [rad]."""
MAX_PENDULUM_RATE: Final = 20.0
"""Maximum plausible rate of a pendulum [rad/s]; a fall from upright reaches 2 sqrt(w2) = 17
rad/s."""
MAX_STAMP_ERROR: Final = 0.0003
"""Maximum error of a count's time stamp [s]: at the bottom of a swing-up 0.3 deg."""
MAX_PENDULUM_ACCELERATION: Final = 150.0
"""Maximum plausible acceleration of a pendulum [rad/s^2]: gravity 70, its pivot 15, a hand the
rest."""
TORQUE_FRACTION: Final = 0.10
"""Maximum change of an external torque from that at rest, as a fraction of the joint's limit [-]:
32 N m at A1 of an iiwa 14, a push of some 60 N at the flange."""
FOLLOWING_LIMIT: Final = 0.03
"""Maximum following error of a joint [rad]: 20 mm at the flange, seven times the largest difference
in 100 trials of 60 s on `twin:nominal`."""
FOLLOWING_TIME: Final = 0.05
"""Time for which a larger following error is tolerated [s]."""
STILL_ANGLE: Final = 5e-4
"""Maximum change of the measured angle of a joint at rest [rad]: ten times its noise."""
EXPECTED_MOTION: Final = 0.015
"""Expected motion of a joint after which it does not follow if it is still measured at rest [rad]:
emergency stop, enabling switch, protective stop, another mode, or an encoder that stands still. An
arm that responds 40 ms later than expected reaches 0.011 rad where its excitation turns around."""
SINGULAR_FRACTION: Final = 0.1
"""Minimum |det J| as a fraction of its value at home [-]: twice the fraction at which CLIK begins
to damp."""
DRIFT_LIMIT: Final = 0.015
"""Maximum distance of the flange from its line [m]; in 100 trials of 60 s on `twin:nominal` it is
0.7 mm, and a load unknown to the drives may be heavier."""
TILT_LIMIT: Final = radians(2.0)
"""Maximum tilt of the flange [rad]; its pitch adds to the measured angle. In 100 trials of 60 s on
`twin:nominal` it is 0.2 deg."""


NO_VIOLATION: Final = -1
"""Code for no broken rule."""
# Codes of the rules of a setpoint, of the flange, and of the whole run, as kernels return them.
POSITION_CODE, JUMP_CODE, VELOCITY_CODE, ACCELERATION_CODE = map(
    SAFETY_RULES.index, (Outcome.POSITION, Outcome.JUMP, Outcome.VELOCITY, Outcome.ACCELERATION)
)
SINGULAR_CODE, TRACK_CODE, SPEED_CODE, DRIFT_CODE, TILT_CODE = map(
    SAFETY_RULES.index,
    (Outcome.SINGULAR, Outcome.TRACK, Outcome.SPEED, Outcome.DRIFT, Outcome.TILT),
)
FOLLOWING_CODE, ANGLE_CODE = map(SAFETY_RULES.index, (Outcome.FOLLOWING, Outcome.ANGLE))

FROM_MEASURED: Final = frozenset(
    {Outcome.NOT_FOLLOWING, Outcome.FOLLOWING, Outcome.TORQUE, Outcome.FIRST}
)
"""Rules whose violation shows that the arm is not at its setpoint: after the ramp the targets go
back towards the measured joints."""


def _violation(outcome: Outcome, value: float, limit: float, **more: float | str) -> End:
    """Return the end by a broken rule, `more` being further evidence."""
    return End(outcome, {"value": value, "limit": limit, **more})


class Limits(NamedTuple):
    """Limits of setpoints, one entry per joint, the held one included."""

    lower: Numbers
    """Lower limits of the position, the margin taken off [rad]."""
    upper: Numbers
    """Upper limits of the position, the margin taken off [rad]."""
    velocity: Numbers
    """Limits of the velocity [rad/s]."""
    acceleration: Numbers
    """Limits of the acceleration [rad/s^2]."""


def limits_of(arm: Arm, *, margin: float = POSITION_MARGIN, speed_fraction: float = 1.0) -> Limits:
    """Return the limits of an arm's setpoints.

    Args:
        arm: The arm.
        margin: Margin of setpoints inside the joints' position limits [rad].
        speed_fraction: Usable fraction of the joints' velocity limits [-].
    """
    return Limits(
        lower=tuple(joint.lower + margin for joint in arm.joints),
        upper=tuple(joint.upper - margin for joint in arm.joints),
        velocity=tuple(speed_fraction * joint.velocity for joint in arm.joints),
        acceleration=tuple(joint.acceleration for joint in arm.joints),
    )


class SafetyParams(NamedTuple):
    """Safety limits of one rig."""

    limits: Limits
    """Limits of the joints."""
    torque: Numbers
    """Maximum change of the external torque from that at rest [N m], per joint."""
    reaction: float
    """Reaction time of the arm: transport delay and response time [s]."""
    min_manipulability: float
    """Minimum |det J| [m^3]."""
    h: float
    """Time between ticks [s]."""
    speed: float = inf
    """Flange speed limit [m/s]; inf for none."""


def make_safety_params(
    arm: Arm,
    *,
    reaction: float,
    h: float,
    speed: float = inf,
    margin: float = POSITION_MARGIN,
    speed_fraction: float = 1.0,
    torque_fraction: float = TORQUE_FRACTION,
) -> SafetyParams:
    """Return the safety limits of a rig.

    Args:
        arm: The rig's arm, with its home posture.
        reaction: Transport delay and response time of the arm [s].
        h: Time between ticks [s].
        speed: Flange speed limit [m/s]; inf for none.
        margin: Margin of setpoints inside the joints' position limits [rad].
        speed_fraction: Usable fraction of the joints' velocity limits [-].
        torque_fraction: Maximum change of an external torque from that at home, as a fraction of
            the joint's torque limit [-].
    """
    at_home = abs(float(np.linalg.det(arm.kinematics(arm.home_free).jacobian)))
    return SafetyParams(
        limits=limits_of(arm, margin=margin, speed_fraction=speed_fraction),
        torque=tuple(torque_fraction * joint.torque for joint in arm.joints),
        reaction=reaction,
        min_manipulability=SINGULAR_FRACTION * at_home,
        h=h,
        speed=speed,
    )


# Setpoints.


def check_setpoint(
    limits: Limits,
    q: Sequence[float],
    last: Sequence[float],
    before: Sequence[float],
    dt: float,
    to_rest: bool = False,
) -> End | None:
    """Return the rule that forbids a setpoint, or None.

    Args:
        limits: Limits of setpoints.
        q: The setpoint [rad], shape (n,).
        last: The one sent before [rad], shape (n,).
        before: The one before that [rad], shape (n,); the same as `last` where the arm is at rest.
        dt: Time between setpoints in the stream [s].
        to_rest: Whether it belongs to a way to rest that ends inside the limits; the stopping
            position is not checked then.
    """
    if invalid := _invalid_numbers(limits, q, "a setpoint"):
        return invalid
    code, joint, value, limit = broken_setpoint(limits, q, last, before, dt, to_rest)
    if code == NO_VIOLATION:
        return None
    more = {"joint": joint, "lower": limits.lower[joint - 1], "upper": limits.upper[joint - 1]}
    return _violation(SAFETY_RULES[code], value, limit, **more)


def check_first(limits: Limits, q: Sequence[float], measured: Sequence[float]) -> End | None:
    """Return the rule that forbids the first setpoint of a stream, or None.

    Args:
        limits: Limits of setpoints.
        q: The setpoint [rad], shape (n,).
        measured: The measured joints [rad], shape (n,).
    """
    for values, name in ((q, "a setpoint"), (measured, "the measured posture")):
        if invalid := _invalid_numbers(limits, values, name):
            return invalid
    distance, joint = largest_difference(q, measured)
    if distance > FIRST_LIMIT:
        return _violation(Outcome.FIRST, distance, FIRST_LIMIT, joint=joint)
    return check_setpoint(limits, q, q, q, inf)


def _invalid_numbers(limits: Limits, q: Sequence[float], name: str) -> End | None:
    if len(q) != len(limits.lower):
        return _violation(Outcome.COUNT, len(q), len(limits.lower), name=name)
    for joint, angle in enumerate(q, start=1):
        if not isfinite(angle):
            evidence = {"name": f"{name}, joint {joint},", "got": str(angle), "joint": joint}
            return End(Outcome.NUMBER, evidence)
    return None


@compilable
def broken_setpoint(
    limits: Limits, q: Row, last: Row, before: Row, dt: float, to_rest: bool = False
) -> tuple[int, int, float, float]:
    """Return the first rule that a setpoint breaks: its code, the joint, the value, the limit.

    Args:
        limits: Limits of setpoints.
        q: The setpoint [rad], shape (n,), finite numbers.
        last: The one sent before [rad], shape (n,).
        before: The one before that [rad], shape (n,).
        dt: Time between setpoints in the stream [s].
        to_rest: Whether it belongs to a way to rest that ends inside the limits.

    Returns:
        The joint is counted from one; `NO_VIOLATION` and zeros without a broken rule.
    """
    for i in range(len(q)):
        lower, upper = limits.lower[i], limits.upper[i]
        velocity = (q[i] - last[i]) / dt
        rest = q[i] + copysign(0.5 * velocity * velocity / limits.acceleration[i], velocity)
        for end in (q[i], q[i] if to_rest else rest):
            if not lower <= end <= upper:
                return POSITION_CODE, i + 1, end, lower if end < lower else upper
    for i in range(len(q)):
        step = abs(q[i] - last[i])
        if step > STEP_LIMIT:
            return JUMP_CODE, i + 1, step, STEP_LIMIT
    for i in range(len(q)):
        speed = abs(q[i] - last[i]) / dt
        if speed > limits.velocity[i] * (1.0 + ROUNDING):
            return VELOCITY_CODE, i + 1, speed, limits.velocity[i]
    for i in range(len(q)):
        acceleration = abs(q[i] - 2.0 * last[i] + before[i]) / dt**2
        if acceleration > limits.acceleration[i] * (1.0 + ROUNDING):
            return ACCELERATION_CODE, i + 1, acceleration, limits.acceleration[i]
    return NO_VIOLATION, 0, 0.0, 0.0


# The run.


class MonitorState(NamedTuple):
    """State of the checks that span several ticks."""

    unmeasured: int = 0
    """Number of ticks since the last one with measured joints."""
    error_time: float = 0.0
    """Duration of a following error beyond its limit [s]."""
    rest: Numbers = ()
    """Angle of each measured joint at its last motion [rad]; empty before the first measurement."""
    expected: Numbers = ()
    """Angle at which each joint was expected at that time [rad]."""
    expected_motion: Numbers = ()
    """Maximum expected motion of each joint since then [rad]."""


def update_monitor(
    params: SafetyParams, before: MonitorState, inputs: SafetyInputs
) -> MonitorState:
    """Return the state of the checks that span several ticks, a tick later.

    Args:
        params: Safety limits of the rig.
        before: The state at the tick before.
        inputs: State of the run now, checked for invalid numbers by `violations` in the same tick.
    """
    measured, expected = inputs.measured, inputs.expected
    if measured is None or expected is None:
        return before._replace(unmeasured=before.unmeasured + 1)
    error, _ = largest_difference(measured, expected)
    # An error before and after ticks without a measurement lasts during them, too.
    elapsed = (before.unmeasured + 1) * params.h if before.error_time > 0.0 else params.h
    error_time = next_error_time(before.error_time, error, elapsed)
    rest, then = list(before.rest or measured), list(before.expected or expected)
    motion = list(before.expected_motion or (0.0,) * len(measured))
    for i, angle in enumerate(measured):
        if abs(angle - rest[i]) > STILL_ANGLE:
            rest[i], then[i], motion[i] = angle, expected[i], 0.0
        motion[i] = max(motion[i], abs(expected[i] - then[i]))
    return MonitorState(0, error_time, tuple(rest), tuple(then), tuple(motion))


def violations(params: SafetyParams, monitor: MonitorState, inputs: SafetyInputs) -> list[End]:
    """Return the broken rules in the order of `SAFETY_RULES`; the first one stops the run.

    Args:
        params: Safety limits of the rig.
        monitor: State of the checks that span several ticks, this one included.
        inputs: State of the run now.
    """
    broken = [
        _violation(rule, float(value), bound.limit)
        for rule in SAFETY_RULES
        if (bound := rule.bound) and (value := getattr(inputs, bound.name)) > bound.limit
    ]
    for name, value in inputs._asdict().items():
        if value is None or (name == "manipulability" and value == inf):
            continue
        for number in value if isinstance(value, tuple) else (value,):
            if not isfinite(number):
                broken.append(End(Outcome.NUMBER, {"name": name, "got": str(number)}))
    if (motion := max(monitor.expected_motion, default=0.0)) > EXPECTED_MOTION:
        joint = monitor.expected_motion.index(motion) + 1
        broken.append(_violation(Outcome.NOT_FOLLOWING, motion, EXPECTED_MOTION, joint=joint))
    torques = zip(inputs.torque or (), params.torque, strict=False)
    for joint, (torque, limit) in enumerate(torques, start=1):
        if abs(torque) > limit:
            broken.append(_violation(Outcome.TORQUE, torque, limit, joint=joint))
    duration, measured, expected = monitor.error_time, inputs.measured, inputs.expected
    if duration > FOLLOWING_TIME and measured is not None and expected is not None:
        error, joint = largest_difference(measured, expected)
        evidence = {"joint": joint, "duration": duration}
        broken.append(_violation(Outcome.FOLLOWING, error, FOLLOWING_LIMIT, **evidence))
    if inputs.on_track:
        x, x_dot = inputs.x, inputs.x_dot
        code, value, limit = broken_flange(
            params, x, x_dot, inputs.drift, inputs.tilt, inputs.manipulability
        )
        if code != NO_VIOLATION:
            reach = stopping_reach(params, x, x_dot)
            evidence = {"x": x, "x_dot": x_dot, "reach": reach}
            broken.append(_violation(SAFETY_RULES[code], value, limit, **evidence))
    if inputs.balancing and has_fallen(inputs.phi):
        broken.append(_violation(Outcome.ANGLE, inputs.phi, ANGLE_RULE_LIMIT))
    return sorted(broken, key=lambda end: SAFETY_RULES.index(end.outcome))


@compilable
def next_error_time(before: float, error: float, h: float) -> float:
    """Return the duration of a following error beyond its limit [s], at a measurement.

    Args:
        before: The same at the measurement before [s].
        error: Maximum following error now [rad].
        h: Time since then [s].
    """
    return before + h if error > FOLLOWING_LIMIT else 0.0


@compilable
def newest_before(sent: Row, count: int, since: float) -> int:
    """Return the index of the setpoint in force at a time, in a ring of those sent.

    Args:
        sent: Time of each [s], at its number modulo the ring's length, which is the shape; -inf
            for an empty place.
        count: Number of setpoints sent.
        since: The time [s].

    Returns:
        The index; that of the oldest if all were sent later.
    """
    length = len(sent)
    for back in range(1, length):
        place = (count - back) % length
        if sent[place] <= since:
            return place
    return count % length


@compilable
def broken_flange(
    params: SafetyParams, x: float, x_dot: float, drift: float, tilt: float, manipulability: float
) -> tuple[int, float, float]:
    """Return the first broken rule of the flange: its code, the value, the limit.

    Args:
        params: Safety limits of the rig.
        x: Displacement from home along base x [m].
        x_dot: Its velocity [m/s].
        drift: Distance from its line [m].
        tilt: Angle from its orientation [rad].
        manipulability: |det J| [m^3].

    Returns:
        `NO_VIOLATION` and zeros without a broken rule.
    """
    if manipulability < params.min_manipulability:
        return SINGULAR_CODE, manipulability, params.min_manipulability
    reach = stopping_reach(params, x, x_dot)
    # Written so that NaN breaks the rule.
    if not (reach < TRACK_LIMIT and abs(x) < TRACK_LIMIT):
        return TRACK_CODE, max(reach, abs(x)), TRACK_LIMIT
    if abs(x_dot) >= params.speed:
        return SPEED_CODE, x_dot, params.speed
    if drift > DRIFT_LIMIT:
        return DRIFT_CODE, drift, DRIFT_LIMIT
    if abs(tilt) > TILT_LIMIT:
        return TILT_CODE, tilt, TILT_LIMIT
    return NO_VIOLATION, 0.0, 0.0


@compilable
def stopping_reach(params: SafetyParams, x: float, x_dot: float) -> float:
    r"""Return the distance from home at which the flange rests after a stop at the next tick [m].

    .. math:: s x + |\dot x| T + \tfrac12 u_{max} T^2 + \frac{(|\dot x| + u_{max} T)^2}{2 \cdot 4},
              \qquad s = \mathrm{sign}\,\dot x

    Until the stop takes effect, T from now, the command in flight may accelerate the flange
    outwards; then it slows down at 4 m/s^2. T is a tick, since the next check comes after one, and
    the reaction time of the arm. Negative where it moves inwards from the other end.

    Args:
        params: Safety limits of the rig.
        x: Displacement from home along base x [m].
        x_dot: Its velocity [m/s]; at rest the outward side counts.
    """
    s = copysign(1.0, x_dot if x_dot != 0.0 else x)
    speed, T, u_max = abs(x_dot), params.h + params.reaction, paper.U_MAX
    gained = speed * T + 0.5 * u_max * T**2
    return s * x + gained + (speed + u_max * T) ** 2 / (2.0 * STOP_DECELERATION)


@compilable
def has_fallen(phi: float) -> bool:
    """Return whether a pendulum at this angle from upright [rad] has fallen; NaN has."""
    return not abs(phi) < ANGLE_RULE_LIMIT


def unexplained_turn(times: Sequence[float], counts: Sequence[int], resolution: float) -> float:
    """Return the deviation of the newest of three counts from a pendulum's motion [rad].

    A pendulum continues the straight line of the two counts before, but for the encoder's
    resolution, errors of the times, and its acceleration, and turns no faster than
    `MAX_PENDULUM_RATE`.

    Args:
        times: Times of the counts [s], the oldest first.
        counts: The counts.
        resolution: Angle of one count [rad].

    Returns:
        Zero for a plausible count; inf where time does not increase.
    """
    steps = [(b - a) * resolution for a, b in pairwise(counts)]
    rate = min(abs(steps[0]) / max(times[1] - times[0], 1e-9), MAX_PENDULUM_RATE)
    noise = resolution + 2.0 * MAX_STAMP_ERROR * rate
    return unexplained_step(times, steps, noise, MAX_PENDULUM_RATE, MAX_PENDULUM_ACCELERATION)


def unexplained_step(
    times: Sequence[float], steps: Sequence[float], noise: float, rate: float, acceleration: float
) -> float:
    """Return the part of the newest of two steps of an angle that no motion explains [rad].

    An angle continues the straight line of the step before, but for noise and acceleration.

    Args:
        times: Times of the three angles [s], the oldest first.
        steps: The two steps between them [rad].
        noise: Noise of an angle [rad].
        rate: Maximum rate [rad/s].
        acceleration: Maximum acceleration [rad/s^2].

    Returns:
        Zero for a plausible step; inf where time does not increase.
    """
    first, dt = times[1] - times[0], times[2] - times[1]
    if not (first > 0.0 and dt > 0.0):
        return inf
    straight = steps[0] * dt / first
    allowed = noise * (1.0 + dt / first) + 0.5 * acceleration * dt * (dt + first)
    kink = abs(steps[1] - straight) - allowed
    return max(kink, abs(steps[1]) - noise - rate * dt, 0.0)


@compilable
def largest_difference(a: Row, b: Row) -> tuple[float, int]:
    """Return the largest difference of two postures, and its joint, counted from one."""
    largest, number = 0.0, 1
    for i in range(len(a)):
        if abs(a[i] - b[i]) > largest:
            largest, number = abs(a[i] - b[i]), i + 1
    return largest, number
