r"""Load of bracket and swinging pendulum on the last joint of an arm, from measured motion.

The drive of the last joint does not know what it carries. With inertia J of the drive (rotor and
link), L of the load, and the acceleration a that the drive intends, the joint moves as

.. math:: (J + L)\, \ddot q = J a + \tau

The torque tau comes from the motion of the other joints and the swing of the pendulum. A log of the
joints and of the encoder gives L and tau, and the identification J: a heavy rotor hardly notices.

Bracket and rod are uniform bars, each replaced by masses at its ends and its middle, 1/6, 2/3 and
1/6 of its own (Simpson's rule), which have the same first and second moments. Their accelerations
are second derivatives of their measured positions.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from equipoise.errors import ArmError
from equipoise.logs.conditions import RunConditions
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.inertials import link_inertials
from equipoise.model.worlds import TwinSettings
from equipoise.settings import GRAVITY
from equipoise.worlds.twin.physics import pivot, rod_centre

Array = npt.NDArray[np.float64]

SAMPLE_PERIOD: Final = 0.005
"""Time between two evaluations of the load [s]: that of the measured joints."""
WINDOW: Final = 9
"""Number of samples of a fitted polynomial: 45 ms, a sixth of the shortest period of the motion."""
ORDER: Final = 4
"""Order of that polynomial."""
BAR: Final = ((0.0, 1.0 / 6.0), (0.5, 2.0 / 3.0), (1.0, 1.0 / 6.0))
"""Places of the masses of a uniform bar, from its first end, and their shares of its mass [-]."""


class WristLoad(NamedTuple):
    """What an arm carries on its last joint."""

    arm: Arm
    """The arm; its `pivot` is that of the load."""
    w2: float
    """w2 of the pendulum [1/s^2], which gives the length of a uniform rod."""
    pendulum_mass: float
    """Mass of the pendulum [kg]."""
    bracket_mass: float
    """Mass of the bracket from the flange to the pivot [kg]."""

    @property
    def link_inertia(self) -> float:
        """Inertia of the arm's own last link about its joint [kg m^2]; zero if not published."""
        try:
            link = link_inertials(self.arm)[-1]
        except ArmError:
            return 0.0
        xx, xy, xz, yy, yz, zz = link.inertia
        axis = np.array(self.arm.joints[-1].axis, np.float64)
        away = np.cross(axis, link.com)
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        return float(axis @ tensor @ axis + link.mass * (away @ away))


def wrist_load(conditions: RunConditions) -> WristLoad | None:
    """Return the load of a run; None where its masses are not known.

    Args:
        conditions: Conditions of the run. A twin knows its masses; on a rig they are those of
            `rig.toml`.
    """
    arm, w2 = conditions.arm, conditions.pendulum["w2"]
    if conditions.world_settings is not None:
        try:
            twin = TwinSettings.model_validate(conditions.world_settings)
        except ValidationError:  # a log that was changed by hand
            return None
        arm = arm.model_copy(update={"pivot": pivot(arm, twin.pivot_outward)})
        return WristLoad(arm, w2, twin.pendulum_mass, twin.bracket_mass)
    masses = [(conditions.rig or {}).get(name) for name in ("pendulum_mass_kg", "bracket_mass_kg")]
    if any(mass is None for mass in masses):
        return None
    pendulum_mass, bracket_mass = map(float, masses)  # pyright: ignore[reportArgumentType]
    return WristLoad(arm, w2, pendulum_mass, bracket_mass)


class LoadMotion(NamedTuple):
    """Load on the last joint over time, at equal intervals."""

    inertia: Array
    """L about the joint's axis [kg m^2], shape (n,)."""
    torque: Array
    """tau of all but the joint's own acceleration [N m], shape (n,)."""

    @property
    def at_rest(self) -> float:
        """L with the pendulum hanging [kg m^2]: a swing lifts the rod away from the axis."""
        return float(np.min(self.inertia))


def load_motion(
    load: WristLoad,
    time: Array,
    joint_time: Array,
    q: Array,
    encoder_time: Array,
    theta: Array,
) -> LoadMotion:
    """Return the load on the last joint at given times.

    Args:
        load: Masses and geometry.
        time: Times of the result, increasing [s], shape (n,).
        joint_time: Times of the measured joints [s], shape (p,).
        q: Measured free joints [rad], shape (p, 6).
        encoder_time: Times of the angles [s], shape (s,).
        theta: Angle of the pendulum from hanging [rad], shape (s,).
    """
    from scipy.signal import savgol_filter

    def derivative(values: Array, order: int) -> Array:
        result = savgol_filter(values, WINDOW, ORDER, order, SAMPLE_PERIOD, axis=0)
        return np.asarray(result, np.float64)

    grid = np.arange(time[0], time[-1] + SAMPLE_PERIOD, SAMPLE_PERIOD)
    joints = np.stack([np.interp(grid, joint_time, column) for column in q.T], axis=1)
    angle = np.interp(grid, encoder_time, theta)
    rod = 2.0 * rod_centre(load.w2)
    upright = load.arm.pose(load.arm.home_free).rotation.T
    at = np.array(load.arm.pivot)
    masses = np.array(
        [share * load.bracket_mass for _, share in BAR]
        + [share * load.pendulum_mass for _, share in BAR]
    )
    places = np.empty((len(grid), len(masses), 3))
    axis, origin = np.empty((2, len(grid), 3))
    for row, (posture, theta_now) in enumerate(zip(joints, angle, strict=True)):
        flange = load.arm.pose(posture)
        turning, turned = flange.jacobian[:3, -1], flange.jacobian[3:, -1]
        axis[row], origin[row] = turned, flange.position + np.cross(turned, turning)
        phi = np.pi - theta_now
        along = rod * (upright @ (np.sin(phi), 0.0, np.cos(phi)))
        local = [*(s * at for s, _ in BAR), *(at + s * along for s, _ in BAR)]
        places[row] = flange.position + np.array(local) @ flange.rotation.T
    arms = places - origin[:, None, :]
    force = masses[:, None] * (derivative(places, 2) + np.array((0.0, 0.0, GRAVITY)))
    torque = -np.einsum("nk,npk->n", axis, np.cross(arms, force))
    away = np.cross(axis[:, None, :], arms)
    inertia = np.einsum("p,npk,npk->n", masses, away, away)
    torque += inertia * derivative(joints[:, -1], 2)
    return LoadMotion(np.interp(time, grid, inertia), np.interp(time, grid, torque))
