r"""Servo of a twin's arm: from a setpoint that was sent to the torques of the joints.

Setpoints arrive after a transport that jitters, in the order in which they were sent. Each cycle of
the servo's loop the newest sets a destination, q plus the shaped step towards it (see
`equipoise.model.actuator`); each millisecond the joint drives follow that destination. The law of
KUKA's drives is not published. Two assumptions, with the bare arm's mass matrix at home M:

``velocity``: the velocity (destination - q) / `reach_time`, held over the cycle, through a
first-order lag T

.. math:: \tau = M\,(\dot q_c - \dot q)\,(1 - e^{-h/T}) / h

``pd``: a critically damped controller of the position

.. math:: \tau = M\,(\omega^2 (q_c - q) - 2 \omega \dot q)

The arm's own gravity is balanced beside it. What a joint passes on to its link keeps within the
torque that the joint can give: its limits are those of the output, behind gear and torque
sensor. The torque that accelerates the rotor stays inside the joint; the limits of the motors are
not published. The model ignores bracket and pendulum. The held joint runs through the same servo.
"""

from math import floor
from typing import Final, NamedTuple

import numpy as np

from equipoise.arrays import Array, IntArray
from equipoise.jit import called, inlined
from equipoise.model.actuator import AMPLITUDE, INTERVAL_WIDTH, Actuator, lag_share, shaped_step
from equipoise.model.arms.arm import Arm
from equipoise.model.random import TWIN, philox, uniform
from equipoise.model.worlds import Inner, TwinSettings, rotor_inertias
from equipoise.worlds.twin.physics import TICK, mass_matrix

VELOCITY, PD = range(2)
INNERS: Final[tuple[Inner, ...]] = ("velocity", "pd")
SLOTS: Final = 512
"""Maximum transport time of a setpoint [ms]: twice the longest transport."""

# Entries of `ServoState.clock`.
NOW, NEWEST, SATURATED = range(3)


class ServoParams(NamedTuple):
    """Constants of the servo; all arrays are over all joints of the arm."""

    inner: int
    """VELOCITY or PD."""
    cycle: int
    """Cycle of the servo's loop [ms]."""
    shaped: bool
    """Whether the loop shapes its steps."""
    rate: float
    """Reciprocal of the time to the destination [1/s]."""
    share: float
    """Share of a change that passes the drives' lag in a millisecond, per second [1/s]."""
    stiffness: float
    """omega^2 of `pd` [1/s^2]."""
    damping: float
    """2 omega of `pd` [1/s]."""
    inertia: Array
    """M of the links, without the rotors, shape (n, n) [kg m^2]."""
    rotors: Array
    """Inertias of the rotors, shape (n,) [kg m^2]."""
    torque: Array
    """Limits of the torques on the links [N m], shape (n,)."""
    transport: float
    """Time from sending to use [ms]."""
    jitter: float
    """Maximum deviation of a transport from that [ms]."""


class ServoState(NamedTuple):
    """State of the servo, changed in place."""

    clock: IntArray
    """Time [ms]; arrival of the newest setpoint [ms]; number of drive cycles with a torque at its
    limit; shape (3,)."""
    arriving: Array
    """Setpoint that arrives in each millisecond, NaN without one, shape (SLOTS, n) [rad]."""
    target: Array
    """The setpoint in force [rad], shape (n,)."""
    destination: Array
    """Destination set by the servo's loop [rad], shape (n,)."""
    wanted: Array
    """Velocity that the drives follow [rad/s], shape (n,)."""
    pull: Array
    """Scratch array: accelerations commanded by the drives [rad/s^2], shape (n,)."""


def make_servo_params(arm: Arm, settings: TwinSettings) -> ServoParams:
    """Return the constants of the servo of an arm.

    Args:
        arm: The arm.
        settings: Times, variant and rotor inertia.

    Raises:
        ArmError: The masses of the arm's links are not known.
    """
    return ServoParams(
        inner=INNERS.index(settings.inner),
        cycle=round(settings.cycle / TICK),
        shaped=settings.shaped,
        rate=1.0 / (settings.reach_time or settings.cycle),
        share=float(lag_share(settings.lag)) / TICK,
        stiffness=settings.pd_frequency**2,
        damping=2.0 * settings.pd_frequency,
        inertia=mass_matrix(arm),
        rotors=rotor_inertias(settings, len(arm.joints)),
        torque=np.array([joint.torque for joint in arm.joints]),
        transport=settings.transport / TICK,
        jitter=settings.transport_jitter / TICK,
    )


def equivalent_actuator(settings: TwinSettings) -> Actuator:
    """Return the actuator that responds as the servo of an arm without load does.

    `pd` is a drive with T = 1 / (2 omega) that reaches a destination in t_c = 2 / omega.

    Args:
        settings: Times and variant.
    """
    cycle, lag = settings.reach_time or settings.cycle, settings.lag
    if settings.inner == "pd":
        cycle, lag = 2.0 / settings.pd_frequency, 0.5 / settings.pd_frequency
    kind = "kst" if settings.shaped else "unshaped"
    return Actuator.assumed(kind, delay=settings.transport, lag=lag, cycle=cycle)


def new_servo_state(n: int) -> ServoState:
    """Return the state of a servo for `n` joints, for `start`."""
    rows = (np.zeros(n) for _ in range(4))
    return ServoState(np.zeros(3, np.int64), np.zeros((SLOTS, n)), *rows)


@called
def start(state: ServoState, q: Array) -> None:
    """Start a servo at time zero that holds the joints at their positions.

    Args:
        state: Changed in place.
        q: All joints [rad], shape (n,) or longer.
    """
    state.clock[:] = 0
    state.arriving[:] = np.nan
    for i in range(len(state.target)):
        state.target[i] = state.destination[i] = q[i]
        state.wanted[i] = 0.0


@inlined
def send(state: ServoState, servo: ServoParams, q: Array, seed: int, index: int) -> None:
    """Send a setpoint.

    Args:
        state: Changed in place.
        servo: Constants.
        q: All joints [rad], shape (n,).
        seed: Master seed.
        index: Number of the trial.
    """
    clock = state.clock
    now = clock[NOW]
    late = uniform(philox(seed, now, index, 0, TWIN)[0], -servo.jitter, servo.jitter)
    # Rounded to the nearest millisecond, so that the mean equals the transport time.
    arrival = now + max(floor(servo.transport + late + 0.5), 0)
    clock[NEWEST] = max(clock[NEWEST], arrival)
    slot = clock[NEWEST] % SLOTS
    for i in range(len(q)):
        state.arriving[slot, i] = q[i]


@inlined
def serve(
    state: ServoState, servo: ServoParams, q: Array, dq: Array, gravity: Array, force: Array
) -> None:
    """Set the torques of the millisecond that begins.

    Args:
        state: Changed in place.
        servo: Constants.
        q: Joint positions [rad], all joints first, shape (n,) or longer.
        dq: Their velocities [rad/s], likewise.
        gravity: Torques that balance the arm's own gravity [N m].
        force: Receives the torques of the drives [N m].
    """
    clock, arriving, target = state.clock, state.arriving, state.target
    destination, wanted, pull = state.destination, state.wanted, state.pull
    inertia, torque = servo.inertia, servo.torque
    n = len(target)
    now = clock[NOW]
    slot = now % SLOTS
    if not np.isnan(arriving[slot, 0]):
        for i in range(n):
            target[i] = arriving[slot, i]
            arriving[slot, i] = np.nan
    if now % servo.cycle == 0:
        for i in range(n):
            step = target[i] - q[i]
            if servo.shaped:
                step = shaped_step(step, AMPLITUDE, INTERVAL_WIDTH)
            destination[i] = q[i] + step
            wanted[i] = step * servo.rate
    for i in range(n):
        if servo.inner == PD:
            pull[i] = servo.stiffness * (destination[i] - q[i]) - servo.damping * dq[i]
        else:
            pull[i] = servo.share * (wanted[i] - dq[i])
    saturated = 0
    for i in range(n):
        wish = gravity[i]
        for j in range(n):
            wish += inertia[i, j] * pull[j]
        given = min(max(wish, -torque[i]), torque[i])
        saturated = saturated if given == wish else 1
        force[i] = given + servo.rotors[i] * pull[i]
    clock[SATURATED] += saturated
