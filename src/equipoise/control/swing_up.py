r"""Swing-up: from hanging to where the policy balances, with the policy's own accelerations.

Energy control after Astrom and Furuta (Automatica 36, 2000). Per m g l, and zero at rest upright,
the pendulum's energy is

.. math:: E = \frac{\dot\varphi^2}{2 w_2} + \cos\varphi - 1, \qquad
          \dot E = -\frac{k}{w_2}\,u\,\dot\varphi\cos\varphi - \frac{c}{w_2}\,\dot\varphi^2

so that u in proportion to :math:`E\,\dot\varphi\cos\varphi` brings E to zero. Two terms keep the
flange near the middle of its track, and it brakes before the ends. Above its pivot the pendulum
gains little from a fast flange, with which no policy can catch it.

At the bottom 2 % of w2 are 4 % of m g l, at the top nothing: each swing calibrates the w2 of the
formula, by its rate at the bottom, its height, and the work of flange and friction in between.

The law hands over where the policy is known to save the pendulum: in each tick near upright, the
policy balances the nominal pendulum from there, in simulation, at the edges of what the observer
may be wrong by. The observation is the state at which u takes effect, so that no delay remains.

Turned round, with an acceleration that falls with the rate, it lets the pendulum hang: `damps`.
"""

from math import acos, copysign, cos, pi, radians, sqrt
from typing import Annotated, Final, NamedTuple, Protocol

from equipoise import paper
from equipoise.arrays import Array, IntArray, Records, fields, new_records
from equipoise.control.control_step import LANES, ControllerParams, wrapped
from equipoise.control.policy import KernelPolicy, Observation, PolicyKernel, act, nearest_action
from equipoise.jit import call, compilable, inlined, kernel, pointer
from equipoise.model.pendulum import PendulumParameters, runge_kutta

MAX_PERIODS: Final = 20.0
"""Time after which a swing-up has failed, in periods of the pendulum [-]: 15 s for the paper's."""
ENERGY_GAIN: Final = 10000.0
"""Acceleration per missing energy [m/s^2] at phi_dot cos(phi) = sqrt(w2): the largest one, unless
next to nothing is missing."""
UPPER_SPEED: Final = 0.3
"""Speed of the flange up to which the law accelerates it while the pendulum is above its pivot
[m/s]: the policy has to stop it."""
PUMP_TRAVEL: Final = 0.1
"""Largest acceleration of the pump over w2 [m]: on a slow pendulum's long swings the flange would
leave its track."""
CENTRING: Final = (0.3, 0.6)
"""Natural frequency of the way back to the middle, in those of the pendulum [-], and its damping
ratio [-]."""
USED_TRACK: Final = 0.8
"""Fraction of the track within which the flange has to be able to stop at `BRAKING` [-]."""
BRAKING: Final = 1.5
"""Deceleration that the law counts on before an end of the track [m/s^2]."""
USED_SPEED: Final = 0.8
"""Fraction of a limit of the flange's speed that the law uses [-]."""
CALIBRATION: Final = 0.5
"""Fraction of the difference between measured and assumed w2 that a swing corrects [-]."""
DAMPING: Final = 0.3
"""Damping ratio of the pendulum's small swings where the law lets it hang [-]."""
MIN_HEIGHT: Final = 1.0
"""Minimum height of a swing that calibrates w2, in lengths of the pendulum [-]."""
MAX_CALIBRATION: Final = 0.15
"""Maximum deviation of w2 from the identified one [-]."""
REHEARSAL: Final = 1.5
"""Duration of the simulation before a hand-over [s], in which a policy that fails has failed."""
REHEARSED_ANGLE: Final = 0.7
"""Fraction of the failure angle in that simulation [-]."""
REHEARSED_TRACK: Final = (0.5, 0.75)
"""Fraction of the track in that simulation [-], at the start of a swing-up and at its limit: the
law waits for a good hand-over, but not for ever."""
ANGLE_ERROR: Final = (radians(0.8), radians(0.32))
"""Error of the observed angle that the policy has to bear [rad], at the same two times."""
RATE_ERROR: Final = (0.018, 0.0072)
"""Error of the observed rate that it has to bear, over sqrt(w2) [rad], at the same two times."""


class SwingUp(NamedTuple):
    """Constants of a swing-up."""

    pendulum: PendulumParameters
    """Nominal pendulum."""
    h: float
    """Time between ticks [s]."""
    horizon: float
    """Time from a measurement to its observation [s]."""
    max_speed: float
    """Limit of the flange's speed [m/s]; inf without a limit."""
    damps: bool = False
    """Whether it lets the pendulum hang, instead of swinging it up."""
    swing_up: int = 0
    """Address of the compiled `swing_up`; 0 where every trial starts by hand."""


def make_swing_up(controller: ControllerParams, max_speed: float) -> SwingUp:
    """Return the constants of a swing-up with a controller, for starts by hand.

    Args:
        controller: Constants of the controller.
        max_speed: Limit of the flange's speed [m/s]; inf without a limit.
    """
    return SwingUp(controller.pendulum, controller.h, controller.horizon, max_speed)


def amplitude(pendulum: PendulumParameters, phi: float, phi_dot: float) -> float:
    """Return the amplitude of a pendulum's swing from hanging [rad]; pi where it turns over.

    Args:
        pendulum: The pendulum.
        phi: Its angle from upright [rad].
        phi_dot: Its angular velocity [rad/s].
    """
    return acos(max(-cos(phi) - phi_dot * phi_dot / (2.0 * pendulum.w2), -1.0))


@compilable
def time_limit(pendulum: PendulumParameters) -> float:
    """Return the time after which the swing-up of a pendulum has failed [s]."""
    return MAX_PERIODS * 2.0 * pi / sqrt(pendulum.w2)


def compiled_for(law: SwingUp, policy: PolicyKernel) -> SwingUp:
    """Return the constants of a swing-up that ends with a policy, compiled once."""
    arguments = law, SwingUpState, policy, Observation(0.0, 0.0, 0.0, 0.0), 0
    return law._replace(swing_up=pointer(swing_up, *arguments))


class SwingUpState(Protocol):
    """State of the swing-ups in some lanes; kernels change it in place."""

    w2: Annotated[Array, LANES]
    """w2 of the pendulum, calibrated by its last swings [1/s^2]."""
    bottom: Annotated[Array, LANES]
    """phi_dot^2 / 2 at the last passage of the bottom [1/s^2]; 0 before the first."""
    cosine: Annotated[Array, LANES]
    """cos(phi) there [-]."""
    work: Annotated[Array, LANES]
    """Change of the energy since then, per m g l [-]."""
    ticks: Annotated[IntArray, LANES]
    """Number of ticks of the swing-up."""
    x_dot: Annotated[Array, LANES]
    """Velocity of the flange in the last tick [m/s]."""
    phi: Annotated[Array, LANES]
    """Angle of the pendulum from upright in the last tick [rad]."""
    phi_dot: Annotated[Array, LANES]
    """Its angular velocity [rad/s]."""
    u: Annotated[Array, LANES]
    """Acceleration of the flange for the next step [m/s^2]."""
    ended: Annotated[IntArray, LANES]
    """Whether the pendulum is handed over to the policy."""


@compilable
def begin_swing_up(law: SwingUp, state: SwingUpState, n: int) -> None:
    """Begin lane `n` with a hanging pendulum and its nominal w2."""
    state.w2[n], state.bottom[n], state.work[n] = law.pendulum.w2, 0.0, 0.0
    state.ticks[n] = 0
    state.x_dot[n], state.phi[n], state.phi_dot[n] = 0.0, pi, 0.0
    state.u[n], state.ended[n] = 0.0, 0


@compilable
def calibrate(law: SwingUp, state: SwingUpState, observation: Observation, n: int) -> None:
    """Calibrate the w2 of lane `n` where a swing ends: at a reversal, or upright."""
    _, x_dot, phi, phi_dot = observation
    pendulum, before, rate = law.pendulum, state.phi[n], state.phi_dot[n]
    turned, u = wrapped(phi - before), (x_dot - state.x_dot[n]) / law.h
    cosine = 0.5 * (cos(before) + cos(phi))
    lost = pendulum.k * u * cosine + 0.5 * pendulum.c * (rate + phi_dot)
    state.work[n] -= lost * turned / pendulum.w2
    crossed = phi * before <= 0.0
    if state.bottom[n] > 0.0 and ((crossed and cos(phi) > 0.0) or phi_dot * rate < 0.0):
        kinetic = phi_dot * phi_dot / (2.0 * state.w2[n])
        height = kinetic + cos(phi) - state.cosine[n] - state.work[n]
        if height > MIN_HEIGHT:
            w2 = state.w2[n] + CALIBRATION * (state.bottom[n] / height - state.w2[n])
            most = MAX_CALIBRATION * pendulum.w2
            state.w2[n] = min(max(w2, pendulum.w2 - most), pendulum.w2 + most)
        state.bottom[n] = 0.0
    if crossed and cos(phi) < 0.0:
        state.bottom[n], state.cosine[n], state.work[n] = 0.5 * phi_dot * phi_dot, cos(phi), 0.0
    state.x_dot[n], state.phi[n], state.phi_dot[n] = x_dot, phi, phi_dot


@compilable
def pump(law: SwingUp, state: SwingUpState, observation: Observation, n: int) -> float:
    """Return the acceleration that brings the energy to that of upright, or damps [m/s^2].

    Args:
        law: Constants.
        state: Changed in place.
        observation: The observation.
        n: Lane.

    Returns:
        One of the paper's accelerations, or 0.
    """
    x, x_dot, phi, phi_dot = observation
    calibrate(law, state, observation, n)
    state.ticks[n] += 1
    energy = phi_dot * phi_dot / (2.0 * state.w2[n]) + cos(phi) - 1.0
    natural = sqrt(law.pendulum.w2)
    u = ENERGY_GAIN / natural * energy * phi_dot * cos(phi)
    if law.damps:
        u = 2.0 * DAMPING * natural / law.pendulum.k * phi_dot * cos(phi)
    w = CENTRING[0] * natural
    back = w * (w * x + 2.0 * CENTRING[1] * x_dot)
    most = min(paper.U_MAX, PUMP_TRAVEL * law.pendulum.w2)
    u = min(max(u, -most), most) - back
    speed = USED_SPEED * law.max_speed
    return within_track(u, x, x_dot, min(speed, UPPER_SPEED) if cos(phi) > 0.0 else speed)


@compilable
def within_track(u: float, x: float, x_dot: float, speed: float) -> float:
    """Return the action nearest to u that leaves the flange room to brake [m/s^2], or 0.

    Args:
        u: Wanted acceleration [m/s^2].
        x: Displacement of the flange [m].
        x_dot: Its velocity [m/s].
        speed: Speed up to which it is accelerated [m/s].
    """
    outwards = copysign(1.0, x_dot)
    if outwards * x + x_dot * x_dot / (2.0 * BRAKING) > USED_TRACK * paper.X_LIMIT:
        return -outwards * paper.U_MAX
    if abs(x_dot) > speed and u * x_dot > 0.0:
        return 0.0
    return nearest_action(u, 0.0, paper.ACTIONS)


@compilable
def balances(
    law: SwingUp, policy: PolicyKernel, start: Observation, error: float, track: float
) -> bool:
    """Return whether the policy keeps the nominal pendulum up from a state, in simulation.

    Args:
        law: Constants.
        policy: The policy.
        start: The state.
        error: Error of the angle that the policy observes [rad].
        track: Largest displacement of the flange [m].
    """
    x, x_dot, phi, phi_dot = start
    h, phi_limit = law.h, REHEARSED_ANGLE * paper.PHI_LIMIT
    for _ in range(round(REHEARSAL / h)):
        u = act(policy, Observation(x, x_dot, phi + error, phi_dot), 0.0)
        phi, phi_dot = runge_kutta(phi, phi_dot, u, h, 0.0, law.pendulum)
        x += h * (x_dot + 0.5 * h * u)
        x_dot += h * u
        if not (abs(phi) < phi_limit and abs(x) < track and abs(x_dot) < law.max_speed):
            return False
    return True


@compilable
def saves(
    law: SwingUp, state: SwingUpState, policy: PolicyKernel, observation: Observation, n: int
) -> bool:
    """Return whether the policy is known to save the pendulum; arguments as of `pump`.

    The angle is within the limit already now, before the observation, and the policy balances from
    the observation, also where angle and rate are wrong.
    """
    x, x_dot, phi, phi_dot = observation
    if not abs(phi) + law.horizon * abs(phi_dot) < REHEARSED_ANGLE * paper.PHI_LIMIT:
        return False
    late = state.ticks[n] * law.h / time_limit(law.pendulum)
    track = paper.X_LIMIT * _between(REHEARSED_TRACK, late)
    angle, rate = _between(ANGLE_ERROR, late), _between(RATE_ERROR, late) * sqrt(law.pendulum.w2)
    for i in range(-1, 2):
        for j in range(-1, 2):
            error = i * angle
            start = Observation(x, x_dot, phi - error, phi_dot + j * rate)
            if not balances(law, policy, start, error, track):
                return False
    return True


@inlined
def _between(ends: tuple[float, float], fraction: float) -> float:
    """Return the number at a fraction of the way from one end to the other."""
    return ends[0] + fraction * (ends[1] - ends[0])


def swing_up(
    law: SwingUp, state: SwingUpState, policy: PolicyKernel, observation: Observation, n: int
) -> None:
    """Hand lane `n` over to the policy, or pump; arguments as of `pump`."""
    if not law.damps and saves(law, state, policy, observation, n):
        state.ended[n] = 1
    else:
        state.u[n] = pump(law, state, observation, n)


@kernel
def swing_up_tick(law: SwingUp, states: Records, policy: PolicyKernel, seen: Observation) -> None:
    """Decide in the first lane; see `swing_up`."""
    call(law.swing_up, (law, states[0], policy, seen, 0))


class SwingUpPolicy:
    """A policy that begins with a hanging pendulum: a swing-up, then another policy."""

    def __init__(self, policy: PolicyKernel, law: SwingUp) -> None:
        """Begin with a hanging pendulum; `policy` balances it."""
        self._policy, self._law = KernelPolicy(policy), compiled_for(law, policy)
        self._states = new_records(SwingUpState)
        self._state = fields(self._states, SwingUpState)
        self.reset()

    def reset(self) -> None:
        """Begin with a hanging pendulum."""
        begin_swing_up(self._law, self._state, 0)
        self._policy.reset()

    @property
    def balancing(self) -> bool:
        """Whether the pendulum was handed over to the policy."""
        return bool(self._state.ended[0])

    def act(self, observation: Array) -> float:
        """Return u [m/s^2] for the observation (x, x_dot, phi, phi_dot), shape (4,)."""
        if not self.balancing:
            seen = Observation(*observation.tolist())
            swing_up_tick(self._law, self._states, self._policy.kernel, seen)
        if self.balancing:
            return self._policy.act(observation)
        return float(self._state.u[0])
