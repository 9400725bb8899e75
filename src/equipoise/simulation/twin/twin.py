"""Digital twin for kernels and for Python: send setpoints, advance time, read the sensors.

Time advances in whole milliseconds. In each, the servo sets the torques of the joints, and the
physics engine takes a step. Positions and velocities of all bodies are valid at the end of each
millisecond, so that the true state can be read at any time.

The pendulum's angle in the engine, as the encoder's, is relative to the flange; phi in the truth
is in space. They differ by the flange's rotation about the spindle.

Encoder and joints are sampled each millisecond, and available after an age: the delay of the
board's line or of the robot's reply. Repeated reads return the same sample: its errors depend on
its own time.
"""

from collections.abc import Sequence
from math import atan2, ceil, copysign, pi
from typing import Any, Final

import numpy as np

from equipoise.arm.arm import FREE_JOINTS, Arm
from equipoise.arrays import Array
from equipoise.control.policy import Observation
from equipoise.jit import inlined, kernel
from equipoise.model.encoder import counts_from_theta
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.random import TWIN, normal_pair, philox, uniform
from equipoise.model.worlds import TwinSettings
from equipoise.physics_engine import mujoco
from equipoise.settings import GRAVITY
from equipoise.simulation.twin import physics
from equipoise.simulation.twin.physics import TICK
from equipoise.simulation.twin.servo_model import new_servo, send, serve, servo_type, start

HISTORY_MS: Final = 128
"""Length of the sensors' history [ms], above the maximum age."""
LINK, FLANGE, ROD = 1, -2, -1
"""First link of the arm, the flange and the pendulum among the bodies of the engine."""


def twin_type(n: int) -> np.dtype[Any]:
    """Return the type of a twin of `n` joints: a record of its constants and its state."""
    return np.dtype(
        [
            ("model_address", "i8"),  # model of the engine
            ("data_address", "i8"),  # state of the engine; one thread at a time may use it
            ("seed", "i8"),  # master seed
            ("index", "i8"),  # number of the trial
            ("now", "i8"),  # time [ms]
            ("home", "f8", n),  # all joints at x = 0 [rad]
            ("home_x", "f8"),  # position of the flange at home along base x [m]
            ("free", "i8", FREE_JOINTS),  # numbers of the free joints
            ("lower", "f8", n),  # lower ends of the joints' ranges [rad]
            ("upper", "f8", n),  # upper ends [rad]
            ("mass", "f8", n),  # masses of the links [kg]
            ("gravity", "f8", n),  # torques that balance the arm's own gravity [N m]
            ("setpoint", "f8", n),  # the newest setpoint of all joints [rad]
            ("servo", servo_type(n)),
            # The row of dry friction among the constraints of the engine.
            ("F", "f8"),  # maximum torque [N m]
            ("R", "f8"),  # regularization [1/(kg m^2)]
            ("B", "f8"),  # damping [1/s]
            ("torque", "f8", n + 1),  # unit torque on the pendulum
            ("response", "f8", n + 1),  # accelerations under it [1/(kg m^2)]
            # Encoder and replies. A sample is at its time modulo `HISTORY_MS`.
            ("counts_per_rev", "f8"),  # encoder counts per revolution
            ("zero", "f8"),  # encoder zero offset of the trial [rad]
            ("encoder_age", "i8"),  # age of the newest count [ms]
            ("encoder_jitter", "f8"),  # maximum error of a count's time stamp [s]
            ("reply_age", "i8"),  # age of the newest measured joints [ms]
            ("joint_noise", "f8"),  # standard deviation of the noise on a measured joint [rad]
            ("past_phi", "f8", HISTORY_MS),  # angles of the pendulum relative to the flange [rad]
            ("past_q", "f8", (HISTORY_MS, FREE_JOINTS)),  # free joints [rad]
        ],
        align=True,
    )


@inlined
def balance(twin: np.record, data: np.record) -> None:
    """Set the torques that balance the arm's own gravity; the drives apply the change at once."""
    # Mass and first moment of the links beyond the joint.
    m, sx, sy = 0.0, 0.0, 0.0
    for i in range(len(twin.mass) - 1, -1, -1):
        m += twin.mass[i]
        sx += twin.mass[i] * data.xipos[LINK + i, 0]
        sy += twin.mass[i] * data.xipos[LINK + i, 1]
        x, y = sx - m * data.xanchor[i, 0], sy - m * data.xanchor[i, 1]
        torque = data.xaxis[i, 0] * (y * GRAVITY) - data.xaxis[i, 1] * (x * GRAVITY)
        data.qfrc_applied[i] += torque - twin.gravity[i]
        twin.gravity[i] = torque


@inlined
def within_limits(twin: np.record, data: np.record) -> bool:
    """Return whether no end of a joint's range acts."""
    q = data.qpos
    inside = True
    for i in range(len(twin.lower)):
        inside &= (twin.lower[i] < q[i]) & (q[i] < twin.upper[i])
    return inside


@inlined
def update(twin: np.record, data: np.record, inside: bool) -> None:
    """Compute what depends on positions and velocities, and balance the arm's gravity.

    Args:
        twin: Record of the twin; changed in place.
        data: The engine's arrays, likewise.
        inside: Whether no end of a joint's range acts.
    """
    model, state = twin.model_address, twin.data_address
    if inside:
        physics.mj_kinematics(model, state)
        physics.mj_comPos(model, state)
        physics.mj_crb(model, state)
        physics.mj_factorM(model, state)
        physics.mj_comVel(model, state)
        physics.mj_passive(model, state)
        physics.mj_rne(model, state, 0, data.qfrc_bias.ctypes.data)
    else:
        physics.mj_step1(model, state)
    balance(twin, data)


@inlined
def integrate(twin: np.record, data: np.record, inside: bool) -> None:
    """Advance positions and velocities by a step of the engine.

    Args:
        twin: Record of the twin; changed in place.
        data: The engine's arrays, likewise.
        inside: Argument of the last `update`. Outside, the engine's solver computes all forces of
            constraints. Inside, dry friction is the only one.
    """
    model, state = twin.model_address, twin.data_address
    if inside:
        physics.mj_fwdAcceleration(model, state)
        apply_dry_friction(twin, data)
        physics.mj_Euler(model, state)
    else:
        data.qfrc_applied[len(twin.home)] = 0.0
        physics.mj_step2(model, state)


@inlined
def apply_dry_friction(twin: np.record, data: np.record) -> None:
    r"""Compute the accelerations with dry friction, those of the engine's solver for one row.

    The friction f minimises the cost of MuJoCo's dual problem within the maximum F:

    .. math:: (A + R) f + \ddot\varphi_0 + B \dot\varphi = 0, \quad |f| \le F

    with the response A to a unit torque, the acceleration without friction, and regularization R
    and damping B of the row. The f of the step before is part of the applied torques; mostly the
    pendulum slides on, and it remains.

    Args:
        twin: Record of the twin; changed in place.
        data: The engine's arrays, likewise.
    """
    n = len(twin.home)
    f = data.qfrc_applied[n]
    slope = twin.R * f + data.qacc_smooth[n] + twin.B * data.qvel[n]
    for i in range(n + 1):
        data.qacc[i] = data.qacc_smooth[i]
    if f != -copysign(twin.F, slope):
        addresses = twin.response.ctypes.data, twin.torque.ctypes.data
        physics.mj_solveM(twin.model_address, twin.data_address, addresses[0], addresses[1], 1)
        new = min(max(f - slope / (twin.response[n] + twin.R), -twin.F), twin.F)
        data.qfrc_applied[n] = new
        for i in range(n + 1):
            data.qacc[i] += twin.response[i] * (new - f)


@kernel
def reset(twin: np.record, data: np.record, q: Array, phi: float, phi_dot: float) -> None:
    """Set time to zero, the arm at rest and held at its position.

    The history is that of a pendulum that moved at the same rate.

    Args:
        twin: Record of the twin; changed in place.
        data: The engine's arrays, likewise.
        q: All joints [rad], shape (n,).
        phi: Angle of the pendulum from upright, relative to the flange [rad].
        phi_dot: Its rate [rad/s].
    """
    n = len(twin.home)
    for i in range(n):
        data.qpos[i] = q[i]
    data.qpos[n] = phi
    data.qvel[:] = 0.0
    data.qvel[n] = phi_dot
    data.qfrc_applied[:] = 0.0
    data.qacc_warmstart[:] = 0.0
    twin.gravity[:] = 0.0
    twin.now = 0
    start(twin.servo, q)
    for tick in range(1 - HISTORY_MS, 1):
        twin.past_phi[tick % HISTORY_MS] = phi + tick * TICK * phi_dot
        for i in range(FREE_JOINTS):
            twin.past_q[tick % HISTORY_MS, i] = q[twin.free[i]]
    update(twin, data, within_limits(twin, data))


@inlined
def advance(twin: np.record, data: np.record, ticks: int) -> None:
    """Advance by a number of milliseconds.

    Args:
        twin: Record of the twin; changed in place.
        data: The engine's arrays, likewise.
        ticks: Number of milliseconds.
    """
    inside = within_limits(twin, data)
    for _ in range(ticks):
        serve(twin.servo, twin.now, data.qpos, data.qvel, twin.gravity, data.qfrc_applied)
        integrate(twin, data, inside)
        inside = within_limits(twin, data)
        update(twin, data, inside)
        twin.now += 1
        slot = twin.now % HISTORY_MS
        twin.past_phi[slot] = data.qpos[len(twin.home)]
        for i in range(FREE_JOINTS):
            twin.past_q[slot, i] = data.qpos[twin.free[i]]


@inlined
def send_free(twin: np.record, q: Array) -> None:
    """Send a setpoint of the free joints [rad], shape (6,), now; the held joint stays."""
    for i in range(FREE_JOINTS):
        twin.setpoint[twin.free[i]] = q[i]
    send(twin.servo, twin.setpoint, twin.now, twin.seed, twin.index)


@inlined
def encoder(twin: np.record) -> tuple[float, float]:
    """Return the newest encoder counts, and their time stamp [s]."""
    tick = twin.now - twin.encoder_age
    theta = pi - (twin.past_phi[tick % HISTORY_MS] + twin.zero)
    word = philox(twin.seed, tick, twin.index, 0, TWIN)[1]
    stamp = tick * TICK + uniform(word, -twin.encoder_jitter, twin.encoder_jitter)
    return counts_from_theta(theta, twin.counts_per_rev, 1.0), stamp


@kernel
def reply(twin: np.record, q: Array) -> float:
    """Write the newest measured free joints into q [rad], shape (6,), and return their time [s]."""
    tick = twin.now - twin.reply_age
    w0, w1, w2, w3 = philox(twin.seed, tick, twin.index, 0, TWIN + 2)
    v0, v1, _, _ = philox(twin.seed, tick, twin.index, 0, TWIN + 3)
    noise = (*normal_pair(w0, w1), *normal_pair(w2, w3), *normal_pair(v0, v1))
    for i in range(FREE_JOINTS):
        q[i] = twin.past_q[tick % HISTORY_MS, i] + twin.joint_noise * noise[i]
    return tick * TICK


@kernel
def truth(twin: np.record, data: np.record) -> Observation:
    """Return the true state of flange and pendulum; its phi is in space."""
    xpos, xmat, cvel, centre = data.xpos, data.xmat, data.cvel, data.subtree_com[LINK]
    y, z = xpos[FLANGE, 1] - centre[1], xpos[FLANGE, 2] - centre[2]
    x_dot = cvel[FLANGE, 3] + cvel[FLANGE, 1] * z - cvel[FLANGE, 2] * y
    # The rod's direction d turns with omega: its change is omega x d.
    dx, dy, dz = xmat[ROD, 2], xmat[ROD, 5], xmat[ROD, 8]
    wx, wy, wz = cvel[ROD, 0], cvel[ROD, 1], cvel[ROD, 2]
    change_x, change_z = wy * dz - wz * dy, wx * dy - wy * dx
    phi_dot = (change_x * dz - change_z * dx) / (dx * dx + dz * dz)
    return Observation(xpos[FLANGE, 0] - twin.home_x, x_dot, atan2(dx, dz), phi_dot)


@kernel
def advance_twin(twin: Any, data: Any, ticks: int) -> None:
    """Advance the twin of `Twin.args` by a number of milliseconds."""
    advance(twin[0], data[0], ticks)


class Twin:
    """An arm with servo, pendulum and encoder, which Python drives through time.

    The same kernels run the compiled trials. Setpoints, counts and measured joints go by the clock
    of the twin, which begins at zero with `reset`.
    """

    def __init__(
        self, arm: Arm, pendulum: PendulumParameters, settings: TwinSettings, *, seed: int = 0
    ) -> None:
        """Build a twin, at home and with the pendulum hanging.

        Args:
            arm: The arm with its home posture.
            pendulum: The pendulum of this trial, with the friction that acts in the twin.
            settings: The world's numbers.
            seed: Master seed of jitter, noise and the error of the encoder's zero.

        Raises:
            ArmError: The masses of the arm's links are not known.
        """
        physics.load_library()
        self.arm, self._settings, n = arm, settings, len(arm.joints)
        self.model = physics.build(arm, pendulum, settings)
        """The engine's model."""
        self.model.body_gravcomp[:] = 0.0  # `balance` takes a tenth of the time
        self.data = mujoco().MjData(self.model)
        """The engine's state."""
        own: Any = np.zeros(1, np.dtype((np.record, twin_type(n))))
        self.args = own, physics.arrays_of(self.data)
        """Constants and state, see `twin_type`, and the engine's arrays, as arguments of kernels:
        one record each. As an array of one it takes a microsecond, by itself it takes forty."""
        self.state = state = own[0]
        """Constants and state."""
        self._now = own["now"]
        state.model_address, state.data_address = physics.addresses(self.model, self.data)
        state.home = state.setpoint = arm.home
        state.home_x = arm.kinematics(arm.home_free).position[0]
        state.free = arm.free
        state.lower, state.upper = self.model.jnt_range[:n].T
        state.mass = self.model.body_mass[LINK : LINK + n]
        state.servo = new_servo(arm, settings)
        state.torque[n] = 1.0
        state.counts_per_rev = settings.counts_per_rev
        # Rounded up, but for the rounding of a whole number of milliseconds.
        state.encoder_age = ceil(settings.encoder_age / TICK - 1e-9)
        state.encoder_jitter = settings.encoder_jitter
        state.reply_age = ceil(settings.reply_age / TICK - 1e-9)
        state.joint_noise = settings.joint_noise
        self.set_trial(pendulum, seed, 0)
        self.reset()

    def set_trial(self, pendulum: PendulumParameters, seed: int, index: int) -> None:
        """Change pendulum, seed and number of the trial; `reset` or `release` has to follow.

        Args:
            pendulum: The pendulum of this trial, with the friction that acts in the twin.
            seed: Master seed of jitter, noise and the error of the encoder's zero.
            index: Number of the trial.
        """
        state, data = self.state, self.data
        state.seed, state.index = seed, index
        word, error = philox(seed, 0, index, 0, TWIN + 1)[0], self._settings.zero_error
        state.zero = self._settings.zero_offset + float(uniform(word, -error, error))
        physics.set_pendulum(self.model, data, pendulum)
        data.qpos[:-1] = state.home
        mujoco().mj_step1(self.model, data)
        state.F, state.R, state.B = self.model.dof_frictionloss[-1], 0.0, 0.0
        if state.F > 0.0:  # the only constraint at home
            state.R, state.B = data.efc_R[0], data.efc_KBIP[0, 1]

    def reset(
        self, q: Sequence[float] | Array | None = None, phi: float = np.pi, phi_dot: float = 0.0
    ) -> None:
        """Set time to zero, the arm at rest.

        Args:
            q: Free joints [rad], shape (6,); home if not given.
            phi: Angle of the pendulum from upright, relative to the flange [rad].
            phi_dot: Its rate [rad/s].
        """
        posture = np.array(self.state.home) if q is None else self.arm.with_held(q)
        reset(self.state, self.args[1][0], posture, float(phi), float(phi_dot))

    @property
    def now(self) -> float:
        """The time [s]."""
        return float(self._now[0]) * TICK

    def send(self, q: Sequence[float] | Array) -> None:
        """Send a setpoint of the free joints [rad], shape (6,), now."""
        send_free(self.state, np.array(q, np.float64))

    def advance(self, seconds: float) -> None:
        """Advance time, in whole milliseconds [s]."""
        advance_twin(*self.args, round(seconds / TICK))

    def encoder(self) -> tuple[float, float]:
        """Return the newest encoder counts and their time stamp [s]."""
        counts, stamp = encoder(self.state)
        return float(counts), float(stamp)

    def measured(self) -> tuple[Array, float]:
        """Return the newest measured free joints [rad], shape (6,), and their time [s]."""
        q = np.zeros(FREE_JOINTS)
        stamp = reply(self.state, q)
        return q, float(stamp)

    def truth(self) -> Observation:
        """Return the true state of flange and pendulum; its phi is in space."""
        return Observation(*map(float, truth(self.state, self.args[1][0])))
