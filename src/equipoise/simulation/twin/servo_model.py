r"""Servo of a twin's arm: from a setpoint that was sent to the torques of the joints.

Setpoints arrive after a transport that jitters, in the order in which they were sent. Each cycle of
the servo's loop the newest sets a destination, q plus the shaped step towards it (see
`equipoise.model.actuator`); each millisecond the joint drives follow that destination. The law of
KUKA's drives is not published. Assumed: the velocity (destination - q) / `reach_time`, held over
the cycle, through a first-order lag T, with the bare arm's mass matrix at home M

.. math:: \tau = M\,(\dot q_c - \dot q)\,(1 - e^{-h/T}) / h

The arm's own gravity is balanced beside it. What a joint passes on to its link keeps within the
torque that the joint can give: its limits are those of the output, behind gear and torque
sensor. The torque that accelerates the rotor stays inside the joint; the limits of the motors are
not published. The model ignores bracket and pendulum. The held joint runs through the same servo.
"""

from math import floor
from typing import Any, Final

import numpy as np

from equipoise.arm.arm import Arm
from equipoise.arrays import Array
from equipoise.jit import inlined
from equipoise.model.actuator import AMPLITUDE, INTERVAL_WIDTH, Actuator, lag_fraction, shaped_step
from equipoise.model.random import TWIN, philox, uniform
from equipoise.model.worlds import TwinSettings, rotor_inertias
from equipoise.simulation.twin.physics import TICK, mass_matrix

SLOTS: Final = 512
"""Maximum transport time of a setpoint [ms]: twice the longest transport."""


def servo_type(n: int) -> np.dtype[Any]:
    """Return the type of a servo of `n` joints: a record of its constants and its state."""
    return np.dtype(
        [
            ("cycle", "i8"),  # cycle of the servo's loop [ms]
            ("shaped", "?"),  # whether the loop shapes its steps
            ("rate", "f8"),  # reciprocal of the time to the destination [1/s]
            ("gain", "f8"),  # (1 - exp(-h / T)) / h [1/s]
            ("M", "f8", (n, n)),  # mass matrix of the links, without the rotors [kg m^2]
            ("rotors", "f8", n),  # inertias of the rotors [kg m^2]
            ("limit", "f8", n),  # limits of the torques on the links [N m]
            ("transport", "f8"),  # time from sending to use [ms]
            ("jitter", "f8"),  # maximum deviation of a transport from that [ms]
            ("newest", "i8"),  # arrival of the newest setpoint [ms]
            ("arriving", "f8", (SLOTS, n)),  # setpoint of each millisecond, NaN without one [rad]
            ("target", "f8", n),  # setpoint in force [rad]
            ("velocity", "f8", n),  # velocity that the drives follow [rad/s]
            ("ddq", "f8", n),  # accelerations commanded by the drives [rad/s^2]
        ],
        align=True,
    )


def new_servo(arm: Arm, settings: TwinSettings) -> np.record:
    """Return the record of an arm's servo, for `start`.

    Args:
        arm: The arm.
        settings: Times, shaping law and rotor inertia.

    Raises:
        ArmError: The masses of the arm's links are not known.
    """
    n = len(arm.joints)
    servo: Any = np.zeros(1, np.dtype((np.record, servo_type(n))))[0]
    servo.cycle = round(settings.cycle / TICK)
    servo.shaped = settings.shaped
    servo.rate = 1.0 / (settings.reach_time or settings.cycle)
    servo.gain = lag_fraction(settings.lag) / TICK
    servo.M = mass_matrix(arm)
    servo.rotors = rotor_inertias(settings, n)
    servo.limit = [joint.torque for joint in arm.joints]
    servo.transport = settings.transport / TICK
    servo.jitter = settings.transport_jitter / TICK
    return servo


def equivalent_actuator(settings: TwinSettings) -> Actuator:
    """Return the actuator that responds as the servo of an arm without load does.

    Args:
        settings: Times and shaping law.
    """
    cycle, lag = settings.reach_time or settings.cycle, settings.lag
    kind = "kst" if settings.shaped else "unshaped"
    return Actuator.assumed(kind, delay=settings.transport, lag=lag, cycle=cycle)


@inlined
def start(servo: np.record, q: Array) -> None:
    """Start a servo at time zero that holds the joints at their positions.

    Args:
        servo: Changed in place.
        q: All joints [rad], shape (n,).
    """
    servo.newest = 0
    servo.arriving[:] = np.nan
    servo.velocity[:] = 0.0
    for i in range(len(servo.target)):
        servo.target[i] = q[i]


@inlined
def send(servo: np.record, q: Array, now: int, seed: int, index: int) -> None:
    """Send a setpoint.

    Args:
        servo: Changed in place.
        q: All joints [rad], shape (n,).
        now: The time [ms].
        seed: Master seed.
        index: Number of the trial.
    """
    late = uniform(philox(seed, now, index, 0, TWIN)[0], -servo.jitter, servo.jitter)
    # Rounded to the nearest millisecond, so that the mean equals the transport time.
    arrival = now + max(floor(servo.transport + late + 0.5), 0)
    servo.newest = max(servo.newest, arrival)
    for i in range(len(q)):
        servo.arriving[servo.newest % SLOTS, i] = q[i]


@inlined
def serve(servo: np.record, now: int, q: Array, dq: Array, gravity: Array, force: Array) -> None:
    """Set the torques of the millisecond that begins.

    Args:
        servo: Changed in place.
        now: The time [ms].
        q: Joint positions [rad], all joints first, shape (n,) or longer.
        dq: Their velocities [rad/s], likewise.
        gravity: Torques that balance the arm's own gravity [N m].
        force: Receives the torques of the drives [N m].
    """
    n, slot = len(servo.target), now % SLOTS
    if not np.isnan(servo.arriving[slot, 0]):
        for i in range(n):
            servo.target[i] = servo.arriving[slot, i]
            servo.arriving[slot, i] = np.nan
    if now % servo.cycle == 0:
        for i in range(n):
            step = servo.target[i] - q[i]
            if servo.shaped:
                step = shaped_step(step, AMPLITUDE, INTERVAL_WIDTH)
            servo.velocity[i] = step * servo.rate
    for i in range(n):
        servo.ddq[i] = servo.gain * (servo.velocity[i] - dq[i])
    for i in range(n):
        torque = gravity[i]
        for j in range(n):
            torque += servo.M[i, j] * servo.ddq[j]
        on_link = min(max(torque, -servo.limit[i]), servo.limit[i])
        force[i] = on_link + servo.rotors[i] * servo.ddq[i]
