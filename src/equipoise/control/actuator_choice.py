"""Selection of one of several actuators, from the motion of the self-test.

A policy for an unknown servo carries several actuators. Before the pendulum is lifted, the flange
makes the move of the self-test, 40 mm in 0.8 s. Its setpoints go through the simulation of each
actuator (`equipoise.model.actuator.track`), and the one whose joints are nearest to the measured
ones is the controller's. On the twin the right one of t_c 1, 16 and 40 ms leaves 0.2 to 1.2 mrad
(root mean square) of 16 mrad, the next one 1.5 to 1.7 mrad.

Only setpoints and measured joints are used, which every run has.
"""

from collections.abc import Sequence
from math import sqrt
from typing import Final

import numpy as np
import numpy.typing as npt

from equipoise.control.control_step import ControllerParams
from equipoise.control.controller import Controller
from equipoise.control.minimum_jerk import Path
from equipoise.errors import RecordingError
from equipoise.model.actuator import Actuator, JointResponse, track
from equipoise.model.arms.arm import FREE_JOINTS, Arm
from equipoise.settings import BoxSettings

Array = npt.NDArray[np.float64]
Rows = Sequence[tuple[float, ...]]
"""Time [s] and free joints [rad] at each setpoint, or at each measurement."""

MOVE_DISTANCE: Final = 0.04
"""Distance of the flange's move [m]."""
MOVE_TIME: Final = 0.8
"""Duration of the move [s]."""
REST_BEFORE_MOVE: Final = 0.1
"""Record before the move [s]: the first setpoint has taken effect when the simulation begins."""
REST_AFTER_MOVE: Final = 0.2
"""Record after the move [s]: the slowest servo has come to rest."""
MIN_MOTION: Final = 0.02
"""Minimum range of the setpoints of any joint [rad]; the whole move has 0.06 rad."""


def describe_choice(residuals: Sequence[float], actuators: Sequence[Actuator]) -> str:
    """Return one line for the operator on the selection of the actuator with the least residual.

    Args:
        residuals: Of each actuator, as from `choose_actuator` [rad].
        actuators: The actuators of the selection.
    """
    chosen = int(np.argmin(residuals))
    others = ", ".join(f"{1e3 * r:.2f}" for i, r in enumerate(residuals) if i != chosen)
    return (
        f"The arm responds as actuator {chosen + 1} of {len(actuators)}, "
        f"{actuators[chosen].summary}: {1e3 * residuals[chosen]:.2f} mrad from its simulation; "
        f"the others {others} mrad"
    )


def flange_move(x: float, direction: float = 1.0) -> Path:
    """Return the path of the flange in the self-test, from x to 40 mm further [m].

    Args:
        x: Start of the path [m].
        direction: 1 or -1.
    """
    return Path((x,), (x + direction * MOVE_DISTANCE,), MOVE_TIME)


def motion_rows(rows: Rows) -> Array:
    """Return the rows of a motion in an array, shape (m, 7), each time once."""
    motion = np.array(rows).reshape(-1, 1 + FREE_JOINTS)
    return motion[np.unique(motion[:, 0], return_index=True)[1]]


def choose_actuator(actuators: Sequence[Actuator], sent: Array, measured: Array) -> list[float]:
    """Compare the simulation of each actuator with the measured joints; the nearest is selected.

    A constant difference of a joint counts for nothing: it is the load's.

    Args:
        actuators: At least one.
        sent: Rows of setpoints, as from `motion_rows`.
        measured: Rows of measurements; the arm is at rest at the first setpoint when they begin.

    Returns:
        Root mean square of measured less simulated joints behind each actuator [rad].

    Raises:
        RecordingError: The joints hardly move.
    """
    rows = measured[measured[:, 0] > sent[0, 0]] if len(sent) else measured[:0]
    most = float(np.ptp(sent[:, 1:], axis=0).max()) if len(rows) > 1 else 0.0
    if most < MIN_MOTION:
        raise RecordingError(
            f"the setpoints of the self-test's move range over {1e3 * most:.1f} mrad, expected at "
            f"least {1e3 * MIN_MOTION:g} mrad: a pause cut it short; run again"
        )
    stream, reply = np.ascontiguousarray(sent.T), np.ascontiguousarray(rows.T)
    simulated, residuals = np.empty(len(rows)), list[float]()
    for actuator in actuators:
        squares, law, delay = 0.0, actuator.parameters, actuator.delay.value
        for j, lag in enumerate(actuator.lags, start=1):
            times = stream[0], stream[j], reply[0], reply[j]
            response = JointResponse(delay, lag.value, law)
            track(*times, response, simulated)
            squares += float(np.var(reply[j] - simulated))
        residuals.append(sqrt(squares / FREE_JOINTS))
    return residuals


def move_setpoints(arm: Arm, params: ControllerParams) -> Array:
    """Return the setpoints of the self-test's move from home, as a run sends them.

    Args:
        arm: The arm with its home posture.
        params: Constants of the controller.

    Returns:
        Free joints [rad], h / 2 apart, from rest to rest, shape (m, 6).
    """
    controller, h = Controller(arm, params, BoxSettings()), params.h
    path = flange_move(0.0)
    first, last = -round(REST_BEFORE_MOVE / h), round((path.duration + REST_AFTER_MOVE) / h)
    rows = list[tuple[float, ...]]()
    for tick in range(first, last):
        change = path.at((tick + 1) * h).dq[0] - path.at(tick * h).dq[0]
        rows += map(arm.without_held, controller.command(change / h))
    return np.array(rows)
