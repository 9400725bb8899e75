"""Digital twin for kernels and for Python: send setpoints, advance time, read the sensors.

Time advances in whole milliseconds. In each, the servo sets the torques of the joints, and the
physics engine takes its steps. Positions and velocities of all bodies are valid at the end of each
millisecond, so that the true state can be read at any time.

The pendulum's angle in the engine, as the encoder's, is relative to the flange; phi in the truth
is in space. They differ by the flange's rotation about the spindle.
"""

from collections.abc import Sequence
from importlib import import_module
from math import atan2, copysign
from typing import Any, NamedTuple

import numpy as np

from equipoise.arrays import Array, IntArray
from equipoise.jit import called, inlined
from equipoise.model.arms.arm import FREE_JOINTS, Arm
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.random import TWIN, normal_pair, philox
from equipoise.model.worlds import TwinSettings
from equipoise.worlds.twin.engine import Engine, call, engine
from equipoise.worlds.twin.physics import TICK, build, set_pendulum
from equipoise.worlds.twin.sensors import (
    HISTORY_MS,
    Sensors,
    encoder,
    encoder_zero,
    make_sensors,
    reply,
)
from equipoise.worlds.twin.servo_model import (
    NOW,
    SATURATED,
    ServoParams,
    ServoState,
    make_servo_params,
    new_servo_state,
    send,
    serve,
    start,
)


class Bodies(NamedTuple):
    """Views of MuJoCo's arrays of a model's state."""

    qpos: Array
    """All joints of the arm, then phi relative to the flange [rad]."""
    qvel: Array
    """Their velocities [rad/s]."""
    applied: Array
    """Torques of the drives, and the dry friction of the pendulum [N m]."""
    gravity: Array
    """Torques that balance the arm's own gravity, from `balance` [N m], shape (n,)."""
    smooth: Array
    """Accelerations under all forces but those of constraints [rad/s^2]."""
    acceleration: Array
    """Accelerations [rad/s^2]."""
    warmstart: Array
    """Initial guess of the engine's solver [rad/s^2]."""
    lower: Array
    """Lower ends of the joints' ranges [rad], shape (n,)."""
    upper: Array
    """Upper ends [rad], likewise."""
    xpos: Array
    """Origins of the bodies [m], shape (n, 3)."""
    xmat: Array
    """Their rotations, row by row, shape (n, 9)."""
    cvel: Array
    """Angular velocity [rad/s], then linear at the tree's centre of mass [m/s], shape (n, 6)."""
    centre: Array
    """Centre of mass of the tree below each body [m], shape (n, 3)."""
    axis: Array
    """Axes of the joints, shape (n + 1, 3)."""
    anchor: Array
    """Points on them [m], likewise."""
    mass_centre: Array
    """Centres of mass of the bodies [m], shape (n, 3)."""
    mass: Array
    """Masses of the arm's links [kg], shape (n,)."""
    weight: Array
    """Acceleration of gravity [m/s^2], shape (3,)."""
    root: int
    """First body of the arm; each of its joints has one."""
    flange: int
    """The flange."""
    pendulum: int
    """The pendulum."""
    friction: Array
    """Dry friction of the pendulum, a row of the engine's constraints: maximum torque [N m],
    regularization [1/(kg m^2)] and damping [1/s]."""
    torque: Array
    """Unit torque on the pendulum, shape (n + 1,)."""
    response: Array
    """Scratch array: accelerations under it [1/(kg m^2)], likewise."""
    torque_address: int
    """Address of `torque`."""
    response_address: int
    """Address of `response`."""


class TwinKernel(NamedTuple):
    """A twin as kernels take it: constants, and the state, which they change in place."""

    engine: Engine
    """The engine's functions, model and data."""
    substeps: int
    """Steps of the engine in a millisecond."""
    bodies: Bodies
    """State of the bodies."""
    servo: ServoParams
    """Constants of the servo."""
    servo_state: ServoState
    """Its state, and the time."""
    sensors: Sensors
    """Encoder and replies."""
    home: Array
    """All joints at x = 0 [rad], shape (n,)."""
    free: IntArray
    """Numbers of the free joints, shape (6,)."""
    home_x: float
    """Position of the flange at home along base x [m]."""
    setpoint: Array
    """Scratch array: all joints of a setpoint [rad], shape (n,)."""
    key: IntArray
    """Master seed and number of the trial, which determine all random numbers, shape (2,)."""


class TrueState(NamedTuple):
    """True state of a twin."""

    x: float
    """Displacement of the flange from home along base x [m]."""
    x_dot: float
    """Its velocity [m/s]."""
    phi: float
    """Angle of the pendulum from upright, in space [rad]."""
    phi_dot: float
    """Its rate [rad/s]."""


@inlined
def balance(bodies: Bodies) -> None:
    """Set the torques that balance the arm's own gravity; the drives apply the change at once."""
    axis, anchor, centre, mass = bodies.axis, bodies.anchor, bodies.mass_centre, bodies.mass
    gravity, applied, root = bodies.gravity, bodies.applied, bodies.root
    gx, gy, gz = bodies.weight[0], bodies.weight[1], bodies.weight[2]
    # Mass and first moment of the links beyond the joint.
    m, sx, sy, sz = 0.0, 0.0, 0.0, 0.0
    for i in range(len(mass) - 1, -1, -1):
        own = mass[i]
        m += own
        sx += own * centre[root + i, 0]
        sy += own * centre[root + i, 1]
        sz += own * centre[root + i, 2]
        x, y, z = sx - m * anchor[i, 0], sy - m * anchor[i, 1], sz - m * anchor[i, 2]
        torque = -(
            axis[i, 0] * (y * gz - z * gy)
            + axis[i, 1] * (z * gx - x * gz)
            + axis[i, 2] * (x * gy - y * gx)
        )
        applied[i] += torque - gravity[i]
        gravity[i] = torque


@inlined
def within_limits(bodies: Bodies) -> bool:
    """Return whether no end of a joint's range acts."""
    q, lower, upper = bodies.qpos, bodies.lower, bodies.upper
    inside = True
    for i in range(len(lower)):
        inside &= (lower[i] < q[i]) & (q[i] < upper[i])
    return inside


@inlined
def update(twin: TwinKernel, inside: bool) -> None:
    """Compute what depends on positions and velocities, and balance the arm's gravity.

    Args:
        twin: Changed in place.
        inside: Whether no end of a joint's range acts.
    """
    engine = twin.engine
    if inside:
        for stage in engine.update:
            call(stage, (engine.model, engine.data))
        call(engine.bias, (engine.model, engine.data, 0, engine.forces))
    else:
        call(engine.before, (engine.model, engine.data))
    balance(twin.bodies)


@inlined
def integrate(twin: TwinKernel, inside: bool) -> None:
    """Advance positions and velocities by a step of the engine.

    Args:
        twin: Changed in place.
        inside: Argument of the last `update`. Outside, the engine's solver computes all forces of
            constraints. Inside, dry friction is the only one.
    """
    engine, n = twin.engine, len(twin.home)
    if inside:
        call(engine.accelerate, (engine.model, engine.data))
        apply_dry_friction(twin)
        call(engine.integrate, (engine.model, engine.data))
    else:
        twin.bodies.applied[n] = 0.0
        call(engine.after, (engine.model, engine.data))


@inlined
def apply_dry_friction(twin: TwinKernel) -> None:
    r"""Compute the accelerations with dry friction, those of the engine's solver for one row.

    The friction f minimises the cost of MuJoCo's dual problem within the maximum F:

    .. math:: (A + R) f + \ddot\varphi_0 + B \dot\varphi = 0, \quad |f| \le F

    with the response A to a unit torque, the acceleration without friction, and regularization R
    and damping B of the row. The f of the step before is part of the applied torques; mostly the
    pendulum slides on, and it remains.

    Args:
        twin: Changed in place.
    """
    bodies, engine, n = twin.bodies, twin.engine, len(twin.home)
    smooth, acceleration, response = bodies.smooth, bodies.acceleration, bodies.response
    most, R, B = bodies.friction[0], bodies.friction[1], bodies.friction[2]
    f = bodies.applied[n]
    slope = R * f + smooth[n] + B * bodies.qvel[n]
    for i in range(n + 1):
        acceleration[i] = smooth[i]
    if f != -copysign(most, slope):
        addresses = bodies.response_address, bodies.torque_address
        call(engine.solve, (engine.model, engine.data, *addresses, 1))
        bodies.applied[n] = min(max(f - slope / (response[n] + R), -most), most)
        for i in range(n + 1):
            acceleration[i] += response[i] * (bodies.applied[n] - f)


@called
def reset(twin: TwinKernel, q: Array, phi: float, phi_dot: float) -> None:
    """Set time to zero, the arm at rest and held at its position.

    The history is that of a pendulum that moved at the same rate.

    Args:
        twin: Changed in place.
        q: All joints [rad], shape (n,).
        phi: Angle of the pendulum from upright, relative to the flange [rad].
        phi_dot: Its rate [rad/s].
    """
    bodies, free, past = twin.bodies, twin.free, twin.sensors
    n = len(q)
    for i in range(n):
        bodies.qpos[i] = q[i]
    bodies.qpos[n] = phi
    bodies.qvel[:] = 0.0
    bodies.qvel[n] = phi_dot
    bodies.applied[:] = 0.0
    bodies.gravity[:] = 0.0
    bodies.warmstart[:] = 0.0
    start(twin.servo_state, q)
    for tick in range(1 - HISTORY_MS, 1):
        past.phi[tick % HISTORY_MS] = phi + tick * TICK * phi_dot
        for i in range(FREE_JOINTS):
            past.q[tick % HISTORY_MS, i] = q[free[i]]
    update(twin, within_limits(bodies))


@inlined
def advance(twin: TwinKernel, ticks: int) -> None:
    """Advance by a number of milliseconds.

    Args:
        twin: Changed in place.
        ticks: Number of milliseconds.
    """
    bodies, state, servo, free = twin.bodies, twin.servo_state, twin.servo, twin.free
    qpos, qvel, applied, gravity = bodies.qpos, bodies.qvel, bodies.applied, bodies.gravity
    clock, past_phi, past_q = state.clock, twin.sensors.phi, twin.sensors.q
    n, inside = len(twin.home), within_limits(bodies)
    for _ in range(ticks):
        serve(state, servo, qpos, qvel, gravity, applied)
        for _ in range(twin.substeps):
            integrate(twin, inside)
            inside = within_limits(bodies)
            update(twin, inside)
        clock[NOW] += 1
        slot = clock[NOW] % HISTORY_MS
        past_phi[slot] = qpos[n]
        for i in range(FREE_JOINTS):
            past_q[slot, i] = qpos[free[i]]


@inlined
def send_free(twin: TwinKernel, q: Array) -> None:
    """Send a setpoint of the free joints [rad], shape (6,), now; the held joint stays."""
    for i in range(len(twin.home)):
        twin.setpoint[i] = twin.home[i]
    for i in range(FREE_JOINTS):
        twin.setpoint[twin.free[i]] = q[i]
    send(twin.servo_state, twin.servo, twin.setpoint, twin.key[0], twin.key[1])


@called
def noise(twin: TwinKernel, sigma: float, stream: int, values: Array) -> None:
    """Add the noise of this millisecond to measurements of the joints.

    Args:
        twin: The time, the seed and the index of the trial.
        sigma: Standard deviation of the noise.
        stream: One of the twin's streams of random numbers, counted from its first.
        values: Changed in place, shape (n,).
    """
    for i in range(len(values)):
        words = philox(twin.key[0], twin.servo_state.clock[NOW], twin.key[1], 1 + i, TWIN + stream)
        values[i] += sigma * normal_pair(words[0], words[1])[0]


@inlined
def truth(twin: TwinKernel) -> TrueState:
    """Return the true state of flange and pendulum."""
    bodies = twin.bodies
    xpos, xmat, cvel, centre = bodies.xpos, bodies.xmat, bodies.cvel, bodies.centre
    flange, rod, root = bodies.flange, bodies.pendulum, bodies.root
    y, z = xpos[flange, 1] - centre[root, 1], xpos[flange, 2] - centre[root, 2]
    x_dot = cvel[flange, 3] + cvel[flange, 1] * z - cvel[flange, 2] * y
    # The rod's direction d turns with omega: its change is omega x d.
    dx, dy, dz = xmat[rod, 2], xmat[rod, 5], xmat[rod, 8]
    wx, wy, wz = cvel[rod, 0], cvel[rod, 1], cvel[rod, 2]
    change_x, change_z = wy * dz - wz * dy, wx * dy - wy * dx
    return TrueState(
        xpos[flange, 0] - twin.home_x,
        x_dot,
        atan2(dx, dz),
        (change_x * dz - change_z * dx) / (dx * dx + dz * dz),
    )


class Twin:
    """An arm with servo, pendulum and encoder, which Python drives through time.

    The same kernels run the compiled trials. Setpoints, counts and measured joints go by the clock
    of the twin, which begins at zero with `reset`.
    """

    def __init__(
        self,
        arm: Arm,
        pendulum: PendulumParameters,
        settings: TwinSettings,
        *,
        seed: int = 0,
        index: int = 0,
        servo: ServoParams | None = None,
    ) -> None:
        """Build a twin, at home and with the pendulum hanging.

        Args:
            arm: The arm with its home posture.
            pendulum: The pendulum of this trial, with the friction that acts in the twin.
            settings: The world's numbers.
            seed: Master seed of jitter, noise and the error of the encoder's zero.
            index: Number of the trial.
            servo: Constants of the servo (default: computed).

        Raises:
            ArmError: The masses of the arm's links are not known.
        """
        self._arm, self._settings = arm, settings
        self.model = build(arm, pendulum, settings)
        self.data = import_module("mujoco").MjData(self.model)
        self.kernel = TwinKernel(
            engine=engine(self.model, self.data),
            substeps=settings.substeps,
            bodies=_bodies(self.model, self.data, len(arm.joints)),
            servo=make_servo_params(arm, settings) if servo is None else servo,
            servo_state=new_servo_state(len(arm.joints)),
            sensors=make_sensors(settings, seed, index),
            home=np.array(arm.home),
            free=np.array(arm.free),
            home_x=float(arm.kinematics(arm.home_free).position[0]),
            setpoint=np.zeros(len(arm.joints)),
            key=np.array([seed, index]),
        )
        _read_dry_friction(self.model, self.data, self.kernel)
        self.reset()

    def set_trial(self, pendulum: PendulumParameters, seed: int, index: int) -> None:
        """Change pendulum, seed and number of the trial; `reset` or `release` has to follow.

        Args:
            pendulum: The pendulum of this trial, with the friction that acts in the twin.
            seed: Master seed of jitter, noise and the error of the encoder's zero.
            index: Number of the trial.
        """
        twin = self.kernel
        set_pendulum(self.model, self.data, pendulum)
        _read_dry_friction(self.model, self.data, twin)
        twin.key[:] = seed, index
        twin.sensors.zero[0] = encoder_zero(self._settings, seed, index)

    def reset(
        self, q: Sequence[float] | Array | None = None, phi: float = np.pi, phi_dot: float = 0.0
    ) -> None:
        """Set time to zero, the arm at rest.

        Args:
            q: Free joints [rad], shape (6,); home if not given.
            phi: Angle of the pendulum from upright, relative to the flange [rad].
            phi_dot: Its rate [rad/s].
        """
        posture = self.kernel.home if q is None else self._arm.with_held(q)
        reset(self.kernel, posture, float(phi), float(phi_dot))

    @property
    def now(self) -> float:
        """The time [s]."""
        return float(self.kernel.servo_state.clock[NOW]) * TICK

    @property
    def saturated(self) -> int:
        """Number of milliseconds with a drive at its torque limit."""
        return int(self.kernel.servo_state.clock[SATURATED])

    def send(self, q: Sequence[float] | Array) -> None:
        """Send a setpoint of the free joints [rad], shape (6,), now."""
        send_free(self.kernel, np.array(q, np.float64))

    def advance(self, seconds: float) -> None:
        """Advance time, in whole milliseconds [s]."""
        advance(self.kernel, round(seconds / TICK))

    def encoder(self) -> tuple[float, float]:
        """Return the newest encoder counts and their time stamp [s]."""
        twin = self.kernel
        index = twin.key[1]
        counts, stamp = encoder(twin.sensors, self._tick, twin.key[0], index)
        return float(counts), float(stamp)

    def measured(self) -> tuple[Array, float]:
        """Return the newest measured free joints [rad], shape (6,), and their time [s]."""
        twin, q = self.kernel, np.zeros(FREE_JOINTS)
        stamp = reply(twin.sensors, self._tick, twin.key[0], twin.key[1], q)
        return q, float(stamp)

    def truth(self) -> TrueState:
        """Return the true state of flange and pendulum."""
        return TrueState(*map(float, truth(self.kernel)))

    @property
    def _tick(self) -> int:
        return int(self.kernel.servo_state.clock[NOW])


def _bodies(model: Any, data: Any, n: int) -> Bodies:
    root, flange, pendulum = (model.body(name).id for name in ("frame 1", "flange", "pendulum"))
    model.body_gravcomp[:] = 0.0  # `balance` takes a tenth of the time
    torque, response = np.append(np.zeros(n), 1.0), np.zeros(n + 1)
    return Bodies(
        qpos=data.qpos,
        qvel=data.qvel,
        applied=data.qfrc_applied,
        gravity=np.zeros(n),
        smooth=data.qacc_smooth,
        acceleration=data.qacc,
        warmstart=data.qacc_warmstart,
        lower=model.jnt_range[:n, 0].copy(),
        upper=model.jnt_range[:n, 1].copy(),
        xpos=data.xpos,
        xmat=data.xmat,
        cvel=data.cvel,
        centre=data.subtree_com,
        axis=data.xaxis,
        anchor=data.xanchor,
        mass_centre=data.xipos,
        mass=model.body_mass[root : root + n].copy(),
        weight=model.opt.gravity,
        root=root,
        flange=flange,
        pendulum=pendulum,
        friction=np.zeros(3),
        torque=torque,
        response=response,
        torque_address=torque.ctypes.data,
        response_address=response.ctypes.data,
    )


def _read_dry_friction(model: Any, data: Any, twin: TwinKernel) -> None:
    """Read the row of dry friction from the constraints of the engine at home."""
    twin.bodies.qpos[: len(twin.home)] = twin.home
    call(twin.engine.before, (twin.engine.model, twin.engine.data))
    kinds, most = data.efc_type, model.dof_frictionloss[-1]
    rows = np.flatnonzero(kinds == import_module("mujoco").mjtConstraint.mjCNSTR_FRICTION_DOF)
    twin.bodies.friction[:] = 0.0
    for row in rows:
        twin.bodies.friction[:] = most, data.efc_R[row], data.efc_KBIP[row, 1]
