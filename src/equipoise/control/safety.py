r"""Safety rules of a run on a rig: pure functions that return the first broken rule.

Two checks, both without a clock and without I/O:

`check_setpoint`, `check_first`
    Whether a setpoint may be sent; called for each, just before it is sent.
`check`
    Whether the run may go on; called once per tick with the current state (`SafetyInputs`) and the
    state of the checks that span several ticks (`MonitorState`, from `update_monitor`).

Each returns the first broken rule in the order of `Rule`, or None. A broken rule leads to a latched
stop (`equipoise.control.states`, `equipoise.control.stop`).

The deciding functions are `@compilable`: the same ones run in the trials of the digital twin
(`equipoise.control.trial_safety`), where a broken rule ends the trial. They return codes and
numbers; the messages are written here.

Rules never clip. Neither a forbidden setpoint nor a speed is reduced: the controller would go on
with a motion that does not happen.

The joints' limits are those of the rig's arm; all other limits stand here with their reasons. These
rules are no safety functions in the sense of a standard: they run on a PC that may fail, and a KST
server then goes on to its last target. The rules keep that target near.
"""

from collections.abc import Sequence
from enum import Enum
from math import copysign, inf, isfinite, nan, pi, radians
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.compiled import compilable
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
ENCODER_STALE: Final = 0.020
"""Maximum age of an encoder sample [s]: the observer bridges two ticks."""
MAX_PENDULUM_RATE: Final = 20.0
"""Maximum plausible rate of a pendulum [rad/s]; a fall from upright reaches 2 sqrt(w2) = 17
rad/s."""
MAX_COUNT_JUMP: Final = radians(0.6)
"""Maximum unexplained deviation of a count from the straight line through the two before [rad],
beyond the encoder's resolution and gravity; time stamps are wrong by up to 0.3 ms."""
MAX_PENDULUM_ACCELERATION: Final = 150.0
"""Maximum plausible acceleration of a pendulum [rad/s^2]: gravity 70, its pivot 15, a hand the
rest."""
MAX_TICK_LATENESS: Final = 0.020
"""Maximum lateness of a tick [s]: the observer and the last setpoints bridge two ticks."""
MAX_MISSED_TICKS: Final = 3
"""Number of successive ticks, each late by a tick or more, that stops the run."""
MAX_REPLY_TIME: Final = 0.050
"""Maximum time until a reply of the robot [s]: a round trip takes 1 to 4 ms, and the operator has
to know within 100 ms that software can no longer stop the robot."""
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
    SINGULAR = "near singularity"
    """The arm is close to a posture in which it cannot move the flange at will."""
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
TORQUE_CODE: Final = RULES.index(Rule.TORQUE)
FOLLOWING_CODE: Final = RULES.index(Rule.FOLLOWING)
POSITION_CODE: Final = RULES.index(Rule.POSITION)
JUMP_CODE: Final = RULES.index(Rule.JUMP)
VELOCITY_CODE: Final = RULES.index(Rule.VELOCITY)
ACCELERATION_CODE: Final = RULES.index(Rule.ACCELERATION)
SINGULAR_CODE: Final = RULES.index(Rule.SINGULAR)
TRACK_CODE: Final = RULES.index(Rule.TRACK)
SPEED_CODE: Final = RULES.index(Rule.SPEED)
DRIFT_CODE: Final = RULES.index(Rule.DRIFT)
TILT_CODE: Final = RULES.index(Rule.TILT)
ANGLE_CODE: Final = RULES.index(Rule.ANGLE)

FROM_MEASURED: Final = frozenset({Rule.NOT_FOLLOWING, Rule.FOLLOWING, Rule.TORQUE, Rule.FIRST})
"""Rules whose violation shows that the arm is not at its setpoint: targets restart from the
measured joints."""


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
    """Number of the joint, from one; None for a rule that concerns no single joint."""

    @property
    def from_measured(self) -> bool:
        """Whether the targets have to restart from the measured posture."""
        return self.rule in FROM_MEASURED


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
        margin: Setpoints stay so far inside the joints' limits [rad].
        speed_share: ... and below this share of their velocity limits.
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
    """Reaction time T of the track rule: transport delay and lag of the arm [s]."""
    u_max: float
    """Largest acceleration that the policy commands [m/s^2]."""
    least_manipulability: float
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
        reaction: Transport delay and lag of the arm [s].
        u_max: Largest acceleration that the policy commands [m/s^2].
        h: Time between ticks [s].
        counts_per_rev: Encoder counts per revolution, after x4.
        speed: The flange stays below this [m/s].
        margin: Setpoints stay so far inside the joints' limits [rad].
        speed_share: ... and below this share of their velocity limits.
        torque_share: Of the torque that a joint can give: how far an external one may be from that
            at home.
    """
    at_home = abs(float(np.linalg.det(arm.kinematics(arm.home_free).jacobian)))
    return SafetyParams(
        limits=limits_of(arm, margin=margin, speed_share=speed_share),
        torque=tuple(torque_share * joint.torque for joint in arm.joints),
        reaction=reaction,
        u_max=u_max,
        least_manipulability=SINGULAR_SHARE * at_home,
        h=h,
        resolution=2.0 * pi / counts_per_rev,
        speed=speed,
    )


# Setpoints.


def check_setpoint(
    limits: Limits,
    q: Sequence[float],
    last: Numbers,
    before: Numbers,
    dt: float,
    to_rest: bool = False,
) -> Violation | None:
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
    broken = _not_numbers(limits, q)
    return broken or _worded_setpoint(
        limits, q, broken_setpoint(limits, q, last, before, dt, to_rest)
    )


def check_first(limits: Limits, q: Sequence[float], measured: Sequence[float]) -> Violation | None:
    """Return the rule that forbids the first setpoint of a stream, or None.

    Args:
        limits: What it has to keep to.
        q: The setpoint [rad], shape (n,).
        measured: The measured joints [rad], shape (n,).
    """
    broken = _not_numbers(limits, q) or _not_numbers(limits, measured, "the measured posture")
    if broken is not None:
        return broken
    for number, (place, there) in enumerate(zip(q, measured, strict=True), start=1):
        away = abs(place - there)
        if away > FIRST_LIMIT:
            return Violation(
                Rule.FIRST,
                f"the first setpoint of joint {number} is {away:.4f} rad from where it is "
                f"measured, expected at most {FIRST_LIMIT:g} rad",
                away,
                FIRST_LIMIT,
                number,
            )
    return _worded_setpoint(limits, q, broken_setpoint(limits, q, q, q, inf))


def _not_numbers(limits: Limits, q: Sequence[float], name: str = "a setpoint") -> Violation | None:
    if len(q) != limits.joints:
        return Violation(
            Rule.COUNT,
            f"{name} has {len(q)} numbers, expected {limits.joints}, one per joint",
            float(len(q)),
            float(limits.joints),
        )
    for number, place in enumerate(q, start=1):
        if not isfinite(place):
            return Violation(
                Rule.NUMBER,
                f"{name} has {place} for joint {number}, expected a finite number",
                place,
                nan,
                number,
            )
    return None


@compilable
def broken_setpoint(
    limits: Limits, q: Row, last: Row, before: Row, dt: float, to_rest: bool = False
) -> tuple[int, int, float, float]:
    """Return the first rule that a setpoint breaks: its code, the joint, the value, the limit.

    Args:
        limits: What it has to keep to.
        q: The setpoint [rad], shape (n,), finite numbers.
        last: The one sent before [rad], shape (n,).
        before: The one before that [rad], shape (n,).
        dt: Time between setpoints in the stream [s].
        to_rest: Whether it is on a way to rest that ends inside the limits.

    Returns:
        The joint is counted from one; `NO_VIOLATION` and zeros where none is broken.
    """
    for i in range(len(q)):
        lower, upper = limits.lower[i], limits.upper[i]
        velocity = (q[i] - last[i]) / dt
        # Position of rest at the joint's maximum deceleration.
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


def _worded_setpoint(
    limits: Limits, q: Sequence[float], broken: tuple[int, int, float, float]
) -> Violation | None:
    code, joint, value, limit = broken
    if code == NO_VIOLATION:
        return None
    where = f"the setpoint of joint {joint}"
    if code == POSITION_CODE:
        what = "is" if value == q[joint - 1] else "could only be stopped"
        lower, upper = limits.lower[joint - 1], limits.upper[joint - 1]
        reason = (
            f"{where} {what} at {value:.4f} rad, expected {lower:.4f} to {upper:.4f} rad: its "
            "limits less the margin of the rig"
        )
    elif code == JUMP_CODE:
        reason = (
            f"{where} jumps by {value:.4f} rad, expected at most {limit:.4f} rad; are its units "
            "right?"
        )
    elif code == VELOCITY_CODE:
        reason = f"{where} asks for {value:.3f} rad/s, expected at most {limit:.3f} rad/s"
    else:
        reason = f"{where} asks for {value:.2f} rad/s^2, expected at most {limit:.2f} rad/s^2"
    return Violation(RULES[code], reason, value, limit, joint)


# The run.


class SafetyInputs(NamedTuple):
    """State of a run at a tick; the defaults break no rule."""

    lateness: float = 0.0
    """Lateness of the tick [s]."""
    overdue: float = 0.0
    """Time since the oldest setpoint without a reply [s]."""
    measured: Numbers | None = None
    """Measured joints [rad], all of them; None without a new measurement."""
    expected: Numbers | None = None
    """Joints of the arm's model at the time of `measured` [rad]."""
    torque: Numbers | None = None
    """External torques less those at rest [N m]; None without a new measurement."""
    encoder_age: float = 0.0
    """Age of the newest encoder sample [s]."""
    encoder_illegal: bool = False
    """Whether the board has seen an illegal transition since the tick before."""
    encoder_missing: int = 0
    """Encoder samples lost since the tick before."""
    encoder_jump: float = 0.0
    """Maximum `unexplained` turn since the tick before [rad]."""
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
    """|det J| [m^3]; inf where it is not checked."""
    drift: float = 0.0
    """Distance of the flange from its line [m]."""
    tilt: float = 0.0
    """Angle of the flange from its orientation [rad]."""


class MonitorState(NamedTuple):
    """State of the checks that span several ticks."""

    missed: int = 0
    """Number of successive ticks late by a tick or more."""
    astray: float = 0.0
    """Duration of a following error beyond its limit [s]."""
    rest: Numbers | None = None
    """Measured joints at the arm's last motion [rad]."""
    expected: Numbers | None = None
    """Expected joints at that time [rad]."""
    farthest: float = 0.0
    """Maximum expected motion of a joint since then [rad]."""


def update_monitor(guard: SafetyParams, before: MonitorState, view: SafetyInputs) -> MonitorState:
    """Return the state of the checks that span several ticks, a tick later.

    Args:
        guard: The rules.
        before: The state at the tick before.
        view: State of the run now; call `check` first, which finds invalid numbers.
    """
    missed = before.missed + 1 if view.lateness >= guard.h else 0
    measured, expected = view.measured, view.expected
    if measured is None or expected is None:
        return before._replace(missed=missed)
    error, _ = largest_difference(measured, expected)
    astray = time_astray(before.astray, error, guard.h)
    if (
        before.rest is None
        or before.expected is None
        or largest_difference(measured, before.rest)[0] > STILL_ANGLE
    ):
        return MonitorState(missed, astray, measured, expected)
    farthest = max(before.farthest, largest_difference(expected, before.expected)[0])
    return MonitorState(missed, astray, before.rest, before.expected, farthest)


def check(guard: SafetyParams, watched: MonitorState, view: SafetyInputs) -> Violation | None:
    """Return the broken rule that stops the run, or None; of several the first of `Rule`.

    Args:
        guard: The rules.
        watched: State of the checks that span several ticks, this one included.
        view: State of the run now.
    """
    return (
        _numbers(view)
        or _link(view)
        or _motion(guard, watched, view)
        or (_flange(guard, view) if view.on_track else None)
        or _tick(watched, view)
        or _encoder(view)
        or (_angle(view) if view.balancing else None)
    )


def _numbers(view: SafetyInputs) -> Violation | None:
    for name, value in zip(view._fields, view, strict=True):
        if value is None:
            continue
        if name == "manipulability" and value == inf:
            continue
        for number in value if isinstance(value, tuple) else (value,):
            if not isfinite(number):
                return Violation(
                    Rule.NUMBER,
                    f"{name} is {number}, expected a finite number",
                    number,
                    nan,
                )
    return None


def _link(view: SafetyInputs) -> Violation | None:
    if view.overdue <= MAX_REPLY_TIME:
        return None
    return Violation(
        Rule.LINK,
        f"the robot has not answered for {1e3 * view.overdue:.0f} ms, expected at most "
        f"{1e3 * MAX_REPLY_TIME:.0f} ms; software may be unable to stop it: use the emergency stop",
        view.overdue,
        MAX_REPLY_TIME,
    )


def _motion(guard: SafetyParams, watched: MonitorState, view: SafetyInputs) -> Violation | None:
    if watched.farthest > EXPECTED_MOTION:
        return Violation(
            Rule.NOT_FOLLOWING,
            f"the arm stands still where a joint should have moved by {watched.farthest:.3f} rad: "
            "emergency stop, enabling switch, protective stop or another mode",
            watched.farthest,
            EXPECTED_MOTION,
        )
    if view.torque is not None:
        number = pushed(view.torque, guard.torque)
        if number > 0:
            torque, limit = view.torque[number - 1], guard.torque[number - 1]
            return Violation(
                Rule.TORQUE,
                f"the external torque at joint {number} is {torque:.1f} N m from that at rest, "
                f"expected at most {limit:.1f} N m: something touches the arm",
                torque,
                limit,
                number,
            )
    if is_astray(watched.astray) and view.measured is not None and view.expected is not None:
        error, number = largest_difference(view.measured, view.expected)
        return Violation(
            Rule.FOLLOWING,
            f"joint {number} is {error:.3f} rad from where it is expected for "
            f"{1e3 * watched.astray:.0f} ms, expected at most {FOLLOWING_LIMIT:g} rad",
            error,
            FOLLOWING_LIMIT,
            number,
        )
    return None


@compilable
def time_astray(before: float, error: float, h: float) -> float:
    """Return the duration of a following error beyond its limit [s], a tick later.

    Args:
        before: The same at the tick before [s].
        error: Maximum following error now [rad].
        h: Time between ticks [s].
    """
    return before + h if error > FOLLOWING_LIMIT else 0.0


@compilable
def is_astray(time: float) -> bool:
    """Return whether a following error has lasted too long [s]."""
    return time > FOLLOWING_TIME


@compilable
def pushed(torque: Row, limit: Row) -> int:
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


def _flange(guard: SafetyParams, view: SafetyInputs) -> Violation | None:
    code, value, limit = broken_flange(
        guard, view.x, view.x_dot, view.drift, view.tilt, view.manipulability
    )
    if code == NO_VIOLATION:
        return None
    if code == SINGULAR_CODE:
        reason = (
            f"the arm is near a singularity: |det J| is {value:.2g} m^3, expected at least "
            f"{limit:.2g} m^3"
        )
    elif code == TRACK_CODE:
        reach = stopping_reach(view.x, view.x_dot, guard.reaction, guard.u_max)
        reason = (
            f"the flange is at {view.x:.3f} m with {view.x_dot:.3f} m/s and could be stopped at "
            f"{reach:.3f} m, expected less than {limit:g} m from home"
        )
    elif code == SPEED_CODE:
        reason = f"the flange moves at {value:.3f} m/s, expected less than {limit:.3g} m/s"
    elif code == DRIFT_CODE:
        reason = (
            f"the flange is {1e3 * value:.1f} mm off its line, expected at most {1e3 * limit:g} mm"
        )
    else:
        reason = (
            f"the flange is tilted by {np.rad2deg(value):.2f} deg, expected at most "
            f"{np.rad2deg(limit):g} deg"
        )
    return Violation(RULES[code], reason, value, limit)


@compilable
def broken_flange(
    guard: SafetyParams, x: float, x_dot: float, drift: float, tilt: float, manipulability: float
) -> tuple[int, float, float]:
    """Return the first broken rule of the flange: its code, the value, the limit.

    Args:
        guard: The rules.
        x: Displacement from home along base x [m].
        x_dot: Its velocity [m/s].
        drift: Distance from its line [m].
        tilt: Angle from its orientation [rad].
        manipulability: |det J| [m^3].

    Returns:
        `NO_VIOLATION` and zeros where none is broken.
    """
    if manipulability < guard.least_manipulability:
        return SINGULAR_CODE, manipulability, guard.least_manipulability
    reach = stopping_reach(x, x_dot, guard.reaction, guard.u_max)
    # Written so that NaN breaks the rule.
    if not (reach < TRACK_LIMIT and abs(x) < TRACK_LIMIT):
        return TRACK_CODE, max(reach, abs(x)), TRACK_LIMIT
    if abs(x_dot) >= guard.speed:
        return SPEED_CODE, x_dot, guard.speed
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
        x_dot: Its velocity [m/s]; at rest it may go out on the side where it is.
        reaction: T, transport delay and lag of the arm [s].
        u_max: Largest acceleration commanded [m/s^2].
    """
    s = copysign(1.0, x_dot if x_dot != 0.0 else x)
    speed, T = abs(x_dot), reaction
    gained = speed * T + 0.5 * u_max * T**2
    return s * x + gained + (speed + u_max * T) ** 2 / (2.0 * STOP_DECELERATION)


def _tick(watched: MonitorState, view: SafetyInputs) -> Violation | None:
    if view.lateness > MAX_TICK_LATENESS:
        return Violation(
            Rule.TICK,
            f"the loop was {1e3 * view.lateness:.1f} ms late, expected at most "
            f"{1e3 * MAX_TICK_LATENESS:g} ms; `equipoise rig doctor` looks for the cause",
            view.lateness,
            MAX_TICK_LATENESS,
        )
    if watched.missed >= MAX_MISSED_TICKS:
        return Violation(
            Rule.TICK,
            f"the loop missed {watched.missed} ticks in a row, expected fewer than "
            f"{MAX_MISSED_TICKS}; `equipoise rig doctor` looks for the cause",
            float(watched.missed),
            float(MAX_MISSED_TICKS),
        )
    return None


def _encoder(view: SafetyInputs) -> Violation | None:
    if view.encoder_age > ENCODER_STALE:
        return Violation(
            Rule.ENCODER_STALE,
            f"the newest encoder sample is {1e3 * view.encoder_age:.1f} ms old, expected at most "
            f"{1e3 * ENCODER_STALE:g} ms; look at its cable",
            view.encoder_age,
            ENCODER_STALE,
        )
    if view.encoder_illegal:
        return Violation(
            Rule.ENCODER_ILLEGAL,
            "the encoder's lines changed both at once: counts are lost; look at its wiring",
            1.0,
            0.0,
        )
    if view.encoder_missing > 0:
        return Violation(
            Rule.ENCODER_GAP,
            f"{view.encoder_missing} encoder samples are missing, expected one at most, and that "
            "seldom; look at its cable and at the load of this machine",
            float(view.encoder_missing),
            0.0,
        )
    if view.encoder_jump > MAX_COUNT_JUMP:
        return Violation(
            Rule.ENCODER_JUMP,
            f"the encoder jumped by {np.rad2deg(view.encoder_jump):.2f} deg more than a pendulum "
            f"moves, expected at most {np.rad2deg(MAX_COUNT_JUMP):g} deg; look at its coupling",
            view.encoder_jump,
            MAX_COUNT_JUMP,
        )
    return None


def _angle(view: SafetyInputs) -> Violation | None:
    if not has_fallen(view.phi):
        return None
    return Violation(
        Rule.ANGLE,
        f"the pendulum leans by {np.rad2deg(view.phi):.1f} deg, expected less than "
        f"{paper.PHI_LIMIT_DEG:g} deg",
        view.phi,
        ANGLE_RULE_LIMIT,
    )


@compilable
def has_fallen(phi: float) -> bool:
    """Return whether a pendulum at this angle from upright [rad] has fallen; NaN has."""
    return not abs(phi) < ANGLE_RULE_LIMIT


def unexplained(
    times: tuple[float, float, float], counts: tuple[int, int, int], resolution: float
) -> float:
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
    first, dt = times[1] - times[0], times[2] - times[1]
    if not (first > 0.0 and dt > 0.0):
        return inf
    turned = (counts[2] - counts[1]) * resolution
    straight = (counts[1] - counts[0]) * resolution * dt / first
    allowed = resolution * (1.0 + dt / first) + 0.5 * MAX_PENDULUM_ACCELERATION * dt * (dt + first)
    kink = abs(turned - straight) - allowed
    return max(kink, abs(turned) - resolution - MAX_PENDULUM_RATE * dt, 0.0)


@compilable
def largest_difference(a: Row, b: Row) -> tuple[float, int]:
    """Return the largest difference of two postures, and its joint, counted from one."""
    largest, number = 0.0, 1
    for i in range(len(a)):
        if abs(a[i] - b[i]) > largest:
            largest, number = abs(a[i] - b[i]), i + 1
    return largest, number
