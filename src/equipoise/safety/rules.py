r"""Safety rules of a run on a rig: pure functions that return the first broken rule.

Two checks, both without a clock and without I/O:

`check_setpoint`, `check_first`
    Check of a setpoint, just before it is sent.
`check`
    Check of the run, once per tick, from its current state (`SafetyInputs`) and the state of the
    checks that span several ticks (`MonitorState`, from `update_monitor`).

Each returns the first broken rule in the order of `Rule`, or None. A broken rule leads to a latched
stop (`equipoise.control.states`, `equipoise.safety.stop`).

The deciding functions are `@compilable`: the same ones run in the trials of the digital twin
(`equipoise.safety.trial`), where a broken rule ends the trial. They return codes and
numbers; this module adds the messages.

Rules never clip: with a reduced setpoint the controller would continue a motion that does not
happen.

The joints' limits are those of the rig's arm; all other limits stand here with their reasons. These
rules are no safety functions in the sense of a standard: they run on a PC that may fail, and a KST
server then moves on to its last target. The rules keep that target near.

A setpoint is a reference plus a lead, which is zero unless the policy's settings ask for it
(`equipoise.model.actuator.leading_setpoint`). The arm follows the reference, whose jumps, velocity
and acceleration are judged. The setpoint is where the arm goes if nothing follows: its lead, its
jumps and its position of rest are judged.
"""

from collections.abc import Iterator, Sequence
from enum import Enum
from itertools import pairwise
from math import copysign, inf, isfinite, nan, pi, radians
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.jit import compilable
from equipoise.model.actuator import MAX_LEAD
from equipoise.model.arms.arm import Arm

Numbers = tuple[float, ...]
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
T1_SPEED: Final = 0.23
"""Flange speed limit in T1 [m/s]; the robot controller stops the arm with its brakes at 0.25 m/s,
and measured speeds are noisy."""
MAX_STALL: Final = 0.070
"""Maximum duration of a stall of the loop, of the encoder or of the link that is bridged [s]. On
the twin a balance outlasts 80 ms of each; the operator has to know within 100 ms that software can
no longer stop the robot."""
MAX_MEASUREMENT_AGE: Final = 0.120
"""Maximum age of the newest measured joints [s]: a bridged stall of 70 ms, up to 15 ms from the
last measurement to its start, up to 35 ms until a setpoint after it is answered with joints. Older
ones do not show whether the arm follows, or where its flange is."""
MAX_PENDULUM_RATE: Final = 20.0
"""Maximum plausible rate of a pendulum [rad/s]; a fall from upright reaches 2 sqrt(w2) = 17
rad/s."""
MAX_COUNT_JUMP: Final = radians(0.6)
"""Maximum unexplained deviation of a count from the straight line through the two before [rad],
beyond the encoder's resolution and gravity; time stamps are wrong by up to 0.3 ms."""
MAX_PENDULUM_ACCELERATION: Final = 150.0
"""Maximum plausible acceleration of a pendulum [rad/s^2]: gravity 70, its pivot 15, a hand the
rest."""
MAX_MISSED_TICKS: Final = 3
"""Number of successive ticks, each late by a tick or more, that stops the run."""
TORQUE_SHARE: Final = 0.10
"""Maximum change of an external torque from that at rest, as a share of the joint's limit [-]: 32 N
m at A1 of an iiwa 14, a push of some 60 N at the flange."""
FOLLOWING_LIMIT: Final = 0.03
"""Maximum following error of a joint [rad]: 20 mm at the flange, seven times the largest difference
in 100 trials of 60 s on `twin:nominal`."""
FOLLOWING_TIME: Final = 0.05
"""Time for which a larger following error is tolerated [s]."""
STILL_ANGLE: Final = 5e-4
"""Maximum change of the measured angle of a joint at rest [rad]: ten times its noise."""
EXPECTED_MOTION: Final = 0.01
"""Expected motion of a joint after which an arm at rest does not follow [rad]: emergency stop,
enabling switch, protective stop or another mode."""
SINGULAR_SHARE: Final = 0.1
"""Minimum |det J| as a share of its value at home [-]: twice the share at which CLIK begins to
damp."""
DRIFT_LIMIT: Final = 0.015
"""Maximum distance of the flange from its line [m]; in 100 trials of 60 s on `twin:nominal` it is
0.7 mm, and a load unknown to the drives may be heavier."""
TILT_LIMIT: Final = radians(2.0)
"""Maximum tilt of the flange [rad]; its pitch adds to the measured angle. In 100 trials of 60 s on
`twin:nominal` it is 0.2 deg."""


class Rule(Enum):
    """Safety rules; of several broken ones the first in this order is named.

    First the rules that make all other numbers meaningless, then limits of the robot, then harm,
    then the end of the balance.
    """

    NUMBER = "not a number"
    """A value is not a finite number."""
    COUNT = "wrong count"
    """A setpoint has more or fewer numbers than the arm has joints."""
    LINK = "link overdue"
    """The robot does not answer in time: software may be unable to stop it."""
    NOT_FOLLOWING = "robot not following"
    """The arm stands still while it should move: something else has stopped it."""
    TORQUE = "contact"
    """External torque: something touches the arm."""
    FOLLOWING = "following error"
    """The arm is not where it should be."""
    FIRST = "first setpoint"
    """The first setpoint is away from the measured posture."""
    POSITION = "joint position"
    """A setpoint is too near to a position limit, or could not be stopped before it."""
    JUMP = "jump"
    """A setpoint is far from the one before."""
    VELOCITY = "joint velocity"
    """A setpoint asks for more than the joint's velocity."""
    ACCELERATION = "joint acceleration"
    """A setpoint asks for more than the joint's acceleration."""
    LEAD = "setpoint lead"
    """A setpoint is too far from its reference: the arm goes there if nothing follows."""
    SINGULAR = "near singularity"
    """The arm is close to a singular posture."""
    TRACK = "track"
    """The flange could not be stopped within its track any more."""
    SPEED = "flange speed"
    """The flange reaches its speed limit, such as that of T1."""
    DRIFT = "flange drift"
    """The flange has left its line."""
    TILT = "flange tilt"
    """The flange has left its orientation."""
    TICK = "late tick"
    """The loop does not keep its time."""
    MEASUREMENT_STALE = "stale joints"
    """No measured joints came for too long: the robot answers too late, or without them."""
    ENCODER_STALE = "stale encoder"
    """No encoder sample came for too long."""
    ENCODER_ILLEGAL = "illegal transition"
    """The encoder's two lines changed at once: counts are lost."""
    ENCODER_GAP = "encoder gap"
    """Encoder samples are missing: how far it turned meanwhile is not known."""
    ENCODER_JUMP = "count jump"
    """The counts moved as no pendulum does."""
    ANGLE = "angle"
    """The pendulum has fallen."""


RULES: Final = tuple(Rule)
"""Rules by code: compiled functions name a rule by its index here."""
NO_VIOLATION: Final = -1
"""Code for no broken rule."""
FOLLOWING_CODE: Final = RULES.index(Rule.FOLLOWING)
POSITION_CODE: Final = RULES.index(Rule.POSITION)
JUMP_CODE: Final = RULES.index(Rule.JUMP)
VELOCITY_CODE: Final = RULES.index(Rule.VELOCITY)
ACCELERATION_CODE: Final = RULES.index(Rule.ACCELERATION)
LEAD_CODE: Final = RULES.index(Rule.LEAD)
SINGULAR_CODE: Final = RULES.index(Rule.SINGULAR)
TRACK_CODE: Final = RULES.index(Rule.TRACK)
SPEED_CODE: Final = RULES.index(Rule.SPEED)
DRIFT_CODE: Final = RULES.index(Rule.DRIFT)
TILT_CODE: Final = RULES.index(Rule.TILT)
ANGLE_CODE: Final = RULES.index(Rule.ANGLE)

FROM_MEASURED: Final = frozenset({Rule.NOT_FOLLOWING, Rule.FOLLOWING, Rule.TORQUE, Rule.FIRST})
"""Rules whose violation shows that the arm is not at its setpoint: after the ramp the targets go
back towards the measured joints."""


class Violation(NamedTuple):
    """A broken rule."""

    rule: Rule
    """The rule."""
    reason: str
    """Message for the operator: the value, and the expected one."""
    value: float
    """Value that violates the rule, in SI units."""
    limit: float
    """Limit of the rule."""
    joint: int | None = None
    """Number of the joint, from one; None for a rule about the whole arm or rig."""

    @property
    def from_measured(self) -> bool:
        """Whether the targets go back towards the measured posture after the ramp."""
        return self.rule in FROM_MEASURED


MESSAGES: Final = {
    Rule.NUMBER: "{what}, expected a finite number",
    Rule.COUNT: "{what} has {value:g} numbers, expected {limit:g}, one per joint",
    Rule.LINK: "the robot has not answered for {milli:.0f} ms, expected at most {max_milli:.0f} "
    "ms; software may be unable to stop it: use the emergency stop",
    Rule.NOT_FOLLOWING: "the arm stands still where a joint should have moved by {value:.3f} rad: "
    "emergency stop, enabling switch, protective stop or another mode",
    Rule.TORQUE: "the external torque at joint {joint} is {value:.1f} N m from that at rest, "
    "expected at most {limit:.1f} N m: something touches the arm",
    Rule.FOLLOWING: "joint {joint} is {value:.3f} rad from where it is expected for "
    "{lasted:.0f} ms, expected at most {limit:g} rad",
    Rule.FIRST: "the first setpoint of joint {joint} is {value:.4f} rad from where it is "
    "measured, expected at most {limit:g} rad",
    Rule.POSITION: "the setpoint of joint {joint} {what} at {value:.4f} rad, expected {lower:.4f} "
    "to {upper:.4f} rad: its limits less the margin of the rig",
    Rule.JUMP: "the setpoint of joint {joint} jumps by {value:.4f} rad, expected at most "
    "{limit:.4f} rad; are its units right?",
    Rule.VELOCITY: "the setpoint of joint {joint} asks for {value:.3f} rad/s, expected at most "
    "{limit:.3f} rad/s",
    Rule.ACCELERATION: "the setpoint of joint {joint} asks for {value:.2f} rad/s^2, expected at "
    "most {limit:.2f} rad/s^2",
    Rule.LEAD: "the setpoint of joint {joint} leads its reference by {value:.4f} rad, expected at "
    "most {limit:.4f} rad",
    Rule.SINGULAR: "the arm is near a singularity: |det J| is {value:.2g} m^3, expected at least "
    "{limit:.2g} m^3",
    Rule.TRACK: "the flange is at {x:.3f} m with {x_dot:.3f} m/s and could be stopped at "
    "{reach:.3f} m, expected less than {limit:g} m from home",
    Rule.SPEED: "the flange moves at {value:.3f} m/s, expected less than {limit:.3g} m/s",
    Rule.DRIFT: "the flange is {milli:.1f} mm off its line, expected at most {max_milli:g} mm",
    Rule.TILT: "the flange is tilted by {degrees:.2f} deg, expected at most {max_degrees:g} deg",
    Rule.TICK: "the loop {what}; `equipoise rig doctor` looks for the cause",
    Rule.MEASUREMENT_STALE: "the joints were last measured {milli:.0f} ms ago, expected at most "
    "{max_milli:g} ms: the robot's link is too slow; look at its cable and its network",
    Rule.ENCODER_STALE: "the newest encoder sample is {milli:.1f} ms old, expected at most "
    "{max_milli:g} ms; look at its cable",
    Rule.ENCODER_ILLEGAL: "the encoder's lines changed both at once: counts are lost; look at its "
    "wiring",
    Rule.ENCODER_GAP: "{value:g} encoder samples are missing, expected one at most, and that "
    "seldom; look at its cable and at the load of this machine",
    Rule.ENCODER_JUMP: "the encoder jumped by {degrees:.2f} deg more than a pendulum moves, "
    "expected at most {max_degrees:g} deg; look at its coupling",
    Rule.ANGLE: "the pendulum leans by {degrees:.1f} deg, expected less than {max_degrees:g} deg",
}
"""Message of each rule; `milli` is the value in thousandths, `degrees` converted from radians."""


def _violation(
    rule: Rule, value: float, limit: float, joint: int | None = None, **more: object
) -> Violation:
    """Return the violation of a rule, `more` being further values of its message."""
    milli, degrees = (1e3 * value, 1e3 * limit), (np.rad2deg(value), np.rad2deg(limit))
    more |= {"milli": milli[0], "max_milli": milli[1]}
    more |= {"degrees": degrees[0], "max_degrees": degrees[1]}
    reason = MESSAGES[rule].format(value=value, limit=limit, joint=joint, **more)
    return Violation(rule, reason, value, limit, joint)


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

    @property
    def joints(self) -> int:
        """Number of joints."""
        return len(self.lower)


def limits_of(arm: Arm, *, margin: float = POSITION_MARGIN, speed_share: float = 1.0) -> Limits:
    """Return the limits of an arm's setpoints.

    Args:
        arm: The arm.
        margin: Margin of setpoints inside the joints' position limits [rad].
        speed_share: Usable share of the joints' velocity limits [-].
    """
    return Limits(
        lower=tuple(joint.lower + margin for joint in arm.joints),
        upper=tuple(joint.upper - margin for joint in arm.joints),
        velocity=tuple(speed_share * joint.velocity for joint in arm.joints),
        acceleration=tuple(joint.acceleration for joint in arm.joints),
    )


class SafetyParams(NamedTuple):
    """Safety limits of one rig."""

    limits: Limits
    """Limits of the joints."""
    torque: Numbers
    """Maximum change of the external torque from that at rest [N m], per joint."""
    reaction: float
    """Reaction time T of the track rule: transport delay and response time of the arm [s]."""
    u_max: float
    """Largest acceleration that the policy commands [m/s^2]."""
    min_manipulability: float
    """Minimum |det J| [m^3]."""
    h: float
    """Time between ticks [s]."""
    resolution: float
    """Angle of one encoder count [rad]."""
    speed: float = inf
    """Flange speed limit [m/s]; inf for none."""


def make_safety_params(
    arm: Arm,
    *,
    reaction: float,
    u_max: float,
    h: float,
    counts_per_rev: int,
    speed: float = inf,
    margin: float = POSITION_MARGIN,
    speed_share: float = 1.0,
    torque_share: float = TORQUE_SHARE,
) -> SafetyParams:
    """Return the safety limits of a rig.

    Args:
        arm: The rig's arm, with its home posture.
        reaction: Transport delay and response time of the arm [s].
        u_max: Largest acceleration that the policy commands [m/s^2].
        h: Time between ticks [s].
        counts_per_rev: Encoder counts per revolution, after x4.
        speed: Flange speed limit [m/s]; inf for none.
        margin: Margin of setpoints inside the joints' position limits [rad].
        speed_share: Usable share of the joints' velocity limits [-].
        torque_share: Maximum change of an external torque from that at home, as a share of the
            joint's torque limit [-].
    """
    at_home = abs(float(np.linalg.det(arm.kinematics(arm.home_free).jacobian)))
    return SafetyParams(
        limits=limits_of(arm, margin=margin, speed_share=speed_share),
        torque=tuple(torque_share * joint.torque for joint in arm.joints),
        reaction=reaction,
        u_max=u_max,
        min_manipulability=SINGULAR_SHARE * at_home,
        h=h,
        resolution=2.0 * pi / counts_per_rev,
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
    setpoints: tuple[Sequence[float], Sequence[float]] | None = None,
) -> Violation | None:
    """Return the rule that forbids a setpoint, or None.

    Args:
        limits: Limits of setpoints.
        q: The setpoint's reference [rad], shape (n,).
        last: The reference before [rad], shape (n,).
        before: The one before that [rad], shape (n,); the same as `last` where the arm is at rest.
        dt: Time between setpoints in the stream [s].
        to_rest: Whether it belongs to a way to rest that ends inside the limits; the stopping
            position is not checked then.
        setpoints: The setpoint and the one sent before [rad], shape (n,) each; None where they
            equal their references.
    """
    if invalid := _invalid_numbers(limits, q, "a setpoint"):
        return invalid
    code, joint, value, limit = broken_setpoint(limits, q, last, before, dt, to_rest)
    if code == NO_VIOLATION and setpoints is not None:
        code, joint, value, limit = broken_lead(limits, *setpoints, q, last, dt, to_rest)
    if code == NO_VIOLATION:
        return None
    what = "is" if value == q[joint - 1] else "could only be stopped"
    lower, upper = limits.lower[joint - 1], limits.upper[joint - 1]
    return _violation(RULES[code], value, limit, joint, what=what, lower=lower, upper=upper)


def check_first(limits: Limits, q: Sequence[float], measured: Sequence[float]) -> Violation | None:
    """Return the rule that forbids the first setpoint of a stream, or None.

    Args:
        limits: Limits of setpoints.
        q: The setpoint [rad], shape (n,).
        measured: The measured joints [rad], shape (n,).
    """
    for values, name in ((q, "a setpoint"), (measured, "the measured posture")):
        if invalid := _invalid_numbers(limits, values, name):
            return invalid
    for joint, (angle, measured_angle) in enumerate(zip(q, measured, strict=True), start=1):
        distance = abs(angle - measured_angle)
        if distance > FIRST_LIMIT:
            return _violation(Rule.FIRST, distance, FIRST_LIMIT, joint)
    return check_setpoint(limits, q, q, q, inf)


def _invalid_numbers(limits: Limits, q: Sequence[float], name: str) -> Violation | None:
    if len(q) != limits.joints:
        return _violation(Rule.COUNT, float(len(q)), float(limits.joints), what=name)
    for joint, angle in enumerate(q, start=1):
        if not isfinite(angle):
            what = f"{name} has {angle} for joint {joint}"
            return _violation(Rule.NUMBER, angle, nan, joint, what=what)
    return None


@compilable
def rest_position(limits: Limits, i: int, q: float, velocity: float) -> float:
    """Return where joint i stops from q [rad] and a velocity [rad/s] at its acceleration limit."""
    return q + copysign(0.5 * velocity * velocity / limits.acceleration[i], velocity)


@compilable
def broken_jump(q: Row, last: Row) -> tuple[int, int, float, float]:
    """Return the first joint that jumps from `last` to `q` [rad], as `broken_setpoint`."""
    for i in range(len(q)):
        step = abs(q[i] - last[i])
        if step > STEP_LIMIT:
            return JUMP_CODE, i + 1, step, STEP_LIMIT
    return NO_VIOLATION, 0, 0.0, 0.0


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
        rest = rest_position(limits, i, q[i], (q[i] - last[i]) / dt)
        for end in (q[i], q[i] if to_rest else rest):
            if not lower <= end <= upper:
                return POSITION_CODE, i + 1, end, lower if end < lower else upper
    code, joint, step, limit = broken_jump(q, last)
    if code != NO_VIOLATION:
        return code, joint, step, limit
    for i in range(len(q)):
        speed = abs(q[i] - last[i]) / dt
        if speed > limits.velocity[i] * (1.0 + ROUNDING):
            return VELOCITY_CODE, i + 1, speed, limits.velocity[i]
    for i in range(len(q)):
        acceleration = abs(q[i] - 2.0 * last[i] + before[i]) / dt**2
        if acceleration > limits.acceleration[i] * (1.0 + ROUNDING):
            return ACCELERATION_CODE, i + 1, acceleration, limits.acceleration[i]
    return NO_VIOLATION, 0, 0.0, 0.0


@compilable
def broken_lead(
    limits: Limits, q: Row, sent: Row, reference: Row, last: Row, dt: float, to_rest: bool = False
) -> tuple[int, int, float, float]:
    """Return the first rule that a setpoint ahead of its reference breaks, as `broken_setpoint`.

    Args:
        limits: Limits of setpoints.
        q: The setpoint [rad], shape (n,).
        sent: The setpoint before [rad], shape (n,).
        reference: The setpoint's reference [rad], shape (n,), which breaks no rule.
        last: The reference before [rad], shape (n,).
        dt: Time between setpoints in the stream [s].
        to_rest: Whether it belongs to a way to rest that ends inside the limits.
    """
    for i in range(len(q)):
        lower, upper = limits.lower[i], limits.upper[i]
        rest = rest_position(limits, i, q[i], (reference[i] - last[i]) / dt)
        for end in (q[i], q[i] if to_rest else rest):
            if q[i] != reference[i] and not lower <= end <= upper:
                return POSITION_CODE, i + 1, end, lower if end < lower else upper
    for i in range(len(q)):
        lead = abs(q[i] - reference[i])
        # Written so that NaN breaks the rule.
        if not lead <= MAX_LEAD * (1.0 + ROUNDING):
            return LEAD_CODE, i + 1, lead, MAX_LEAD
    return broken_jump(q, sent)


# The run.


class SafetyInputs(NamedTuple):
    """State of a run at a tick; the defaults break no rule."""

    lateness: float = 0.0
    """Lateness of the tick [s]."""
    overdue: float = 0.0
    """Time since the oldest setpoint without a reply [s]."""
    measured_age: float = 0.0
    """Age of the newest measured joints [s]."""
    measured: Numbers | None = None
    """Measured joints [rad], all of them; None without a new measurement."""
    expected: Numbers | None = None
    """Joints of the arm's model at the time of `measured` [rad]."""
    torque: Numbers | None = None
    """External torques less those at rest [N m]; None without a new measurement."""
    encoder_age: float = 0.0
    """Age of the newest encoder sample [s]."""
    encoder_illegal: bool = False
    """Whether the board found an illegal transition since the tick before."""
    encoder_missing: int = 0
    """Encoder samples lost since the tick before."""
    encoder_jump: float = 0.0
    """Maximum `unexplained_turn` since the tick before [rad]."""
    balancing: bool = False
    """Whether the policy commands."""
    x: float = 0.0
    """Displacement of the flange from home along base x [m]."""
    x_dot: float = 0.0
    """Its velocity [m/s]."""
    phi: float = 0.0
    """Angle of the pendulum from upright [rad]."""
    on_track: bool = False
    """Whether the flange has to be on its track, in line and orientation; not on the way home."""
    manipulability: float = inf
    """Manipulability |det J| [m^3]; inf if unchecked."""
    drift: float = 0.0
    """Distance of the flange from its line [m]."""
    tilt: float = 0.0
    """Angle of the flange from its orientation [rad]."""


class MonitorState(NamedTuple):
    """State of the checks that span several ticks."""

    missed: int = 0
    """Number of successive ticks late by a tick or more."""
    unmeasured: int = 0
    """Number of ticks since the last one with measured joints."""
    error_time: float = 0.0
    """Duration of a following error beyond its limit [s]."""
    rest: Numbers | None = None
    """Measured joints at the arm's last motion [rad]."""
    expected: Numbers | None = None
    """Expected joints at that time [rad]."""
    expected_motion: float = 0.0
    """Maximum expected motion of a joint since then [rad]."""


def update_monitor(
    params: SafetyParams, before: MonitorState, inputs: SafetyInputs
) -> MonitorState:
    """Return the state of the checks that span several ticks, a tick later.

    Args:
        params: Safety limits of the rig.
        before: The state at the tick before.
        inputs: State of the run now, checked for invalid numbers by `check` in the same tick.
    """
    missed = before.missed + 1 if inputs.lateness >= params.h else 0
    measured, expected = inputs.measured, inputs.expected
    if measured is None or expected is None:
        return before._replace(missed=missed, unmeasured=before.unmeasured + 1)
    error, _ = largest_difference(measured, expected)
    # An error before and after ticks without a measurement lasts during them, too.
    elapsed = (before.unmeasured + 1) * params.h if before.error_time > 0.0 else params.h
    error_time = next_error_time(before.error_time, error, elapsed)
    rest, then = before.rest, before.expected
    if rest is None or then is None or largest_difference(measured, rest)[0] > STILL_ANGLE:
        return MonitorState(missed, 0, error_time, measured, expected)
    expected_motion = max(before.expected_motion, largest_difference(expected, then)[0])
    return MonitorState(missed, 0, error_time, rest, then, expected_motion)


def check(params: SafetyParams, monitor: MonitorState, inputs: SafetyInputs) -> Violation | None:
    """Return the broken rule that stops the run, or None; of several the first of `Rule`.

    Args:
        params: Safety limits of the rig.
        monitor: State of the checks that span several ticks, this one included.
        inputs: State of the run now.
    """
    return next(violations(params, monitor, inputs), None)


def violations(
    params: SafetyParams, monitor: MonitorState, inputs: SafetyInputs
) -> Iterator[Violation]:
    """Yield the broken rules in the order of `Rule`; arguments as of `check`."""
    for name, value in zip(inputs._fields, inputs, strict=True):
        if value is None or (name == "manipulability" and value == inf):
            continue
        for number in value if isinstance(value, tuple) else (value,):
            if not isfinite(number):
                yield _violation(Rule.NUMBER, number, nan, what=f"{name} is {number}")
    if inputs.overdue > MAX_STALL:
        yield _violation(Rule.LINK, inputs.overdue, MAX_STALL)
    if monitor.expected_motion > EXPECTED_MOTION:
        yield _violation(Rule.NOT_FOLLOWING, monitor.expected_motion, EXPECTED_MOTION)
    if inputs.torque is not None and (joint := overloaded_joint(inputs.torque, params.torque)):
        yield _violation(Rule.TORQUE, inputs.torque[joint - 1], params.torque[joint - 1], joint)
    lasted, measured, expected = monitor.error_time, inputs.measured, inputs.expected
    if error_time_exceeded(lasted) and measured is not None and expected is not None:
        error, joint = largest_difference(measured, expected)
        yield _violation(Rule.FOLLOWING, error, FOLLOWING_LIMIT, joint, lasted=1e3 * lasted)
    if inputs.on_track:
        x, x_dot = inputs.x, inputs.x_dot
        code, value, limit = broken_flange(
            params, x, x_dot, inputs.drift, inputs.tilt, inputs.manipulability
        )
        if code != NO_VIOLATION:
            reach = stopping_reach(x, x_dot, params.reaction, params.u_max)
            yield _violation(RULES[code], value, limit, x=x, x_dot=x_dot, reach=reach)
    if inputs.lateness > MAX_STALL:
        late, most = 1e3 * inputs.lateness, 1e3 * MAX_STALL
        what = f"was {late:.1f} ms late, expected at most {most:g} ms"
        yield _violation(Rule.TICK, inputs.lateness, MAX_STALL, what=what)
    if monitor.missed >= MAX_MISSED_TICKS:
        what = f"missed {monitor.missed} ticks in a row, expected fewer than {MAX_MISSED_TICKS}"
        yield _violation(Rule.TICK, float(monitor.missed), float(MAX_MISSED_TICKS), what=what)
    if inputs.measured_age > MAX_MEASUREMENT_AGE:
        yield _violation(Rule.MEASUREMENT_STALE, inputs.measured_age, MAX_MEASUREMENT_AGE)
    if inputs.encoder_age > MAX_STALL:
        yield _violation(Rule.ENCODER_STALE, inputs.encoder_age, MAX_STALL)
    if inputs.encoder_illegal:
        yield _violation(Rule.ENCODER_ILLEGAL, 1.0, 0.0)
    if inputs.encoder_missing > 0:
        yield _violation(Rule.ENCODER_GAP, float(inputs.encoder_missing), 0.0)
    if inputs.encoder_jump > MAX_COUNT_JUMP:
        yield _violation(Rule.ENCODER_JUMP, inputs.encoder_jump, MAX_COUNT_JUMP)
    if inputs.balancing and has_fallen(inputs.phi):
        yield _violation(Rule.ANGLE, inputs.phi, ANGLE_RULE_LIMIT)


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
def error_time_exceeded(time: float) -> bool:
    """Return whether a following error has lasted too long [s]."""
    return time > FOLLOWING_TIME


@compilable
def overloaded_joint(torque: Row, limit: Row) -> int:
    """Return the first joint whose external torque is beyond its limit, counted from one; or 0.

    Args:
        torque: External torques less those at rest [N m], shape (n,).
        limit: Their limits [N m], shape (n,).
    """
    for i in range(len(limit)):
        if abs(torque[i]) > limit[i]:
            return i + 1
    return 0


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
    reach = stopping_reach(x, x_dot, params.reaction, params.u_max)
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
def stopping_reach(x: float, x_dot: float, reaction: float, u_max: float) -> float:
    r"""Return the distance from home at which the flange comes to rest after a stop now [m].

    .. math:: s x + |\dot x| T + \tfrac12 u_{max} T^2 + \frac{(|\dot x| + u_{max} T)^2}{2 \cdot 4},
              \qquad s = \mathrm{sign}\,\dot x

    Until the stop takes effect, T from now, the command in flight may accelerate the flange
    outwards; then it slows down at 4 m/s^2. Negative where it moves inwards from the other end.

    Args:
        x: Displacement from home along base x [m].
        x_dot: Its velocity [m/s]; at rest the outward side counts.
        reaction: T, transport delay and lag of the arm [s].
        u_max: Largest acceleration commanded [m/s^2].
    """
    s = copysign(1.0, x_dot if x_dot != 0.0 else x)
    speed, T = abs(x_dot), reaction
    gained = speed * T + 0.5 * u_max * T**2
    return s * x + gained + (speed + u_max * T) ** 2 / (2.0 * STOP_DECELERATION)


@compilable
def has_fallen(phi: float) -> bool:
    """Return whether a pendulum at this angle from upright [rad] has fallen; NaN has."""
    return not abs(phi) < ANGLE_RULE_LIMIT


def unexplained_turn(times: Sequence[float], counts: Sequence[int], resolution: float) -> float:
    """Return the deviation of the newest of three counts from a pendulum's motion [rad].

    A pendulum continues the straight line of the two counts before, but for the encoder's
    resolution and its acceleration, and turns no faster than `MAX_PENDULUM_RATE`.

    Args:
        times: Times of the counts [s], the oldest first.
        counts: The counts.
        resolution: Angle of one count [rad].

    Returns:
        Zero for a plausible count; inf where time does not increase.
    """
    steps = [(b - a) * resolution for a, b in pairwise(counts)]
    return unexplained_step(times, steps, resolution, MAX_PENDULUM_RATE, MAX_PENDULUM_ACCELERATION)


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
