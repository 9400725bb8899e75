r"""Dynamics of a pendulum whose pivot accelerates along x, and its file format.

Symbols follow Safeea & Neto, section 3.2. phi is measured from upright, positive towards +x;
theta is measured from hanging; theta + phi = pi. A free swing identifies only the ratios
w2 = m g l / I, k = m l / I = w2 / g, c = b / I, which are sufficient for control. The moment of
inertia I and the friction b in SI units require separate measurements of m and l, the distance from
the axis to the centre of mass of all rotating parts.

Equation (8) is the special case u = 0 written in theta; equation (7) is the linearisation at
phi = 0. Coulomb friction and quadratic drag go beyond the paper; they are zero by default.
"""

import functools
from math import pi
from typing import Annotated, Any, ClassVar, Final, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from equipoise.arguments import checked
from equipoise.arrays import Array
from equipoise.elementary import fma, sincos
from equipoise.files import Artefact, Count, Estimate, Name, Number, Sentence, StrPath, Value
from equipoise.jit import PACKAGE, compilable, inlined, kernel
from equipoise.settings import GRAVITY, Friction, IdentificationSettings

MIN_PERIOD: Final = 1e-5
MAX_PERIOD: Final = 1e5
"""Limits on the period of a small swing [s], from 25 pm to 2,500,000 km of string. A unit of time
that is wrong by a factor of 1000 stays within them, so that a later check can name it."""
MAX_FRICTION: Final = 1e4
"""Limit on c [1/s], dry friction [1/s^2] and drag [1/rad]: 100 times those of any pendulum that
swings."""
Variance = Annotated[float, Field(ge=-1e24, le=1e24)]
"""Covariance of two quantities below 1e12."""
Variances = tuple[Variance, Variance, Variance, Variance]
"""Row of a covariance of four quantities."""
GravityOverInertia = Annotated[
    float, Field(ge=(2.0 * pi / MAX_PERIOD) ** 2, le=(2.0 * pi / MIN_PERIOD) ** 2)
]
"""w2 [1/s^2] of a possible period."""
FrictionOverInertia = Annotated[float, Field(ge=-MAX_FRICTION, le=MAX_FRICTION)]
"""c [1/s]; an identified one may be slightly negative."""
STEPS_PER_PERIOD: Final = 128
"""Runge-Kutta steps per period of the swing; the error over 60 periods of a large swing is
below 1e-5 rad."""


class PendulumParameters(NamedTuple):
    """Parameters of a rigid pendulum on a frictional pivot, as identified from a free swing.

    A `NamedTuple`, because compiled kernels take it as an argument.
    """

    w2: GravityOverInertia
    """Gravity over inertia, m g l / I [1/s^2]."""
    k: float
    """Coupling to the pivot's acceleration, m l / I [1/m]."""
    c: FrictionOverInertia
    """Viscous friction over inertia, b / I [1/s]."""
    coulomb: float = 0.0
    """Coulomb friction over inertia [1/s^2]."""
    drag: float = 0.0
    """Quadratic drag over inertia [1/rad]."""
    linearised: bool = False
    """Use sin(phi) = phi, cos(phi) = 1, as equation (7) is printed."""


@inlined
def _acceleration(
    phi: float, phi_dot: float, u: float, dry: float, pendulum: PendulumParameters
) -> float:
    """Return the angular acceleration [rad/s^2]; `dry` is f sign(phi_dot), known beforehand."""
    friction = fma(fma(pendulum.drag, abs(phi_dot), pendulum.c), phi_dot, dry)
    sine, cosine = (phi, 1.0) if pendulum.linearised else sincos(phi)
    return fma(pendulum.w2, sine, -fma(pendulum.k * u, cosine, friction))


@inlined
def runge_kutta(
    phi: float, phi_dot: float, u: float, h: float, dry: float, pendulum: PendulumParameters
) -> tuple[float, float]:
    """Advance by one Runge-Kutta step of fourth order, with u and dry friction held."""
    half, sixth = 0.5 * h, h * (1.0 / 6.0)
    v1 = phi_dot
    a1 = _acceleration(phi, v1, u, dry, pendulum)
    v2 = fma(half, a1, phi_dot)
    a2 = _acceleration(fma(half, v1, phi), v2, u, dry, pendulum)
    v3 = fma(half, a2, phi_dot)
    a3 = _acceleration(fma(half, v2, phi), v3, u, dry, pendulum)
    v4 = fma(h, a3, phi_dot)
    a4 = _acceleration(fma(h, v3, phi), v4, u, dry, pendulum)
    return (
        fma(sixth, fma(2.0, v2 + v3, v1 + v4), phi),
        fma(sixth, fma(2.0, a2 + a3, a1 + a4), phi_dot),
    )


@compilable
def _step_with_dry_friction(
    phi: float, phi_dot: float, u: float, h: float, pendulum: PendulumParameters
) -> tuple[float, float]:
    """Advance by `h`, with the reversal (or rest) exactly at zero rate.

    A Runge-Kutta step across the jump of the dry friction would lose its order, and chatter at
    rest.
    """
    f = pendulum.coulomb
    left = h
    # A step reverses at most once; the third pass only completes the second.
    for _ in range(3):
        direction = 1.0 if phi_dot > 0.0 else -1.0
        if phi_dot == 0.0:
            drive = _acceleration(phi, 0.0, u, 0.0, pendulum)
            if abs(drive) <= f:
                return phi, 0.0
            direction = 1.0 if drive > 0.0 else -1.0
        end, end_dot = runge_kutta(phi, phi_dot, u, left, f * direction, pendulum)
        if end_dot * direction >= 0.0 or phi_dot == 0.0:
            return end, end_dot
        # Newton's iteration for the time of the reversal: the rate is almost linear in time.
        until = left * phi_dot / (phi_dot - end_dot)
        turn = phi
        for _ in range(4):
            turn, turn_dot = runge_kutta(phi, phi_dot, u, until, f * direction, pendulum)
            slope = _acceleration(turn, turn_dot, u, f * direction, pendulum)
            until = min(max(until - turn_dot / slope, 0.0), left) if slope != 0.0 else until
        phi, phi_dot, left = turn, 0.0, left - until
    return phi, phi_dot


@compilable
def step(
    phi: float, phi_dot: float, u: float, h: float, pendulum: PendulumParameters
) -> tuple[float, float]:
    """Advance the pendulum by one Runge-Kutta step of fourth order, u held.

    With Coulomb friction the step is split at the reversal, where the pendulum stays at rest while
    dry friction holds it.

    Args:
        phi: Angle from upright [rad].
        phi_dot: Angular velocity [rad/s].
        u: Acceleration of the pivot along x over the step [m/s^2].
        h: Length of the step [s].
        pendulum: Physical parameters.

    Returns:
        Angle [rad] and angular velocity [rad/s] at the end of the step.
    """
    if pendulum.coulomb == 0.0:
        return runge_kutta(phi, phi_dot, u, h, 0.0, pendulum)
    return _step_with_dry_friction(phi, phi_dot, u, h, pendulum)


@kernel
def swing(
    time: Array, theta: float, theta_dot: float, h: float, pendulum: PendulumParameters
) -> tuple[Array, Array]:
    """Simulate a free swing at any increasing times.

    Integrates in fixed steps of `h` from `time[0]` on, with a cubic through angle and rate at both
    ends of a step. Uneven time stamps and gaps add no cost, and the result depends smoothly on the
    parameters, as finite differences in a fit require.

    Args:
        time: Output times [s], increasing, shape (n,).
        theta: Angle from hanging at `time[0]` [rad].
        theta_dot: Rate at `time[0]` [rad/s].
        h: Length of the steps [s].
        pendulum: Physical parameters.

    Returns:
        Angle from hanging [rad] and rate [rad/s], each of shape (n,).
    """
    thetas, theta_dots = np.empty(len(time)), np.empty(len(time))
    phi, phi_dot = pi - theta, -theta_dot
    before, before_dot = phi, phi_dot
    node = 0
    for i in range(len(time)):
        while time[i] - time[0] > node * h:
            before, before_dot = phi, phi_dot
            phi, phi_dot = step(before, before_dot, 0.0, h, pendulum)
            node += 1
        if node == 0:
            thetas[i], theta_dots[i] = theta, theta_dot
            continue
        # Elapsed fraction of the last step.
        s = 1.0 + (time[i] - time[0] - node * h) / h
        if pendulum.coulomb != 0.0 and before_dot * phi_dot <= 0.0:
            # Dry friction causes a kink at the reversal, which no cubic fits.
            phi_now, phi_dot_now = step(before, before_dot, 0.0, s * h, pendulum)
            thetas[i], theta_dots[i] = pi - phi_now, -phi_dot_now
            continue
        rise, m0, m1 = phi - before, h * before_dot, h * phi_dot
        c2, c3 = 3.0 * rise - 2.0 * m0 - m1, m0 + m1 - 2.0 * rise
        thetas[i] = pi - (before + s * (m0 + s * (c2 + s * c3)))
        theta_dots[i] = -(m0 + s * (2.0 * c2 + s * 3.0 * c3)) / h
    return thetas, theta_dots


class SwingFit(Value):
    """Fit of a free swing; `repr=False` keeps a field out of the summary on a terminal."""

    source: Name = Field(repr=False)
    """Name of the recording."""
    sha256: Name = Field(repr=False)
    """Digest of the recording."""
    quantity: Literal["angle", "rate"] = Field(repr=False)
    """Recorded quantity: theta [rad], or theta_dot [rad/s] of a gyro."""
    window: tuple[Number, Number]
    """First and last time of the fitted swing [s]."""
    release: Number | None = Field(repr=False)
    """Time of the release by a hand [s]; None if unknown: the recording swings freely from its
    first sample, its start was given, or something touched the pendulum."""
    samples: Count = Field(repr=False)
    """Number of samples in the window."""
    periods: float = Field(gt=0.0, le=1e6)
    """Length of the window in periods of the swing; friction ends every swing within a million."""
    rms: Number = Field(repr=False)
    """Root mean square of recording minus fit [rad], or [rad/s] for a rate."""
    noise: Number = Field(repr=False)
    """White noise in the residual; same unit."""
    offset: Number = Field(repr=False)
    """Recorded minus true: zero offset of the encoder [rad], or bias of the gyro [rad/s]."""
    theta: Number = Field(repr=False)
    """Angle from hanging at the first time of the window [rad]."""
    theta_dot: Number = Field(repr=False)
    """Rate at the first time of the window [rad/s]."""
    settings: IdentificationSettings = Field(repr=False)
    """Settings of the fit."""
    warnings: Annotated[tuple[Sentence, ...], Field(max_length=100)] = ()
    """Warnings about a poor fit, with remedies."""
    richer_friction: Friction | None = Field(default=None, exclude=True, repr=False)
    """Simplest friction model that explains a poorly fitted swing; None without one. Not stored."""

    @property
    def amplitude(self) -> float:
        """Value at the first turning point, where the window begins [rad], or rate [rad/s]."""
        return abs(self.theta if self.quantity == "angle" else self.theta_dot)

    @property
    def unexplained(self) -> float:
        """Residual that noise does not explain, as a fraction of the amplitude [-]."""
        return float(np.sqrt(max(self.rms**2 - self.noise**2, 0.0)) / self.amplitude)


class Pendulum(Artefact):
    """Pendulum that was identified from a free swing, with its uncertainty."""

    FORMAT: ClassVar[str] = "equipoise-pendulum"

    w2: Estimate
    """Gravity over inertia, m g l / I [1/s^2]."""
    k: Estimate
    """Coupling to the pivot's acceleration, m l / I = w2 / g [1/m]."""
    c: Estimate
    """Viscous friction over inertia, b / I [1/s]."""
    coulomb: Estimate
    """Coulomb friction over inertia [1/s^2]."""
    drag: Estimate
    """Quadratic drag over inertia [1/rad]."""
    covariance: Annotated[tuple[Variances, ...], Field(min_length=4, max_length=4, repr=False)]
    """Covariance of w2, c, coulomb and drag in their units; zero for a parameter that was not
    fitted."""
    friction_model: Friction
    """Friction model of the fit."""
    g: float = Field(default=GRAVITY, ge=0.1, le=100.0, repr=False)
    """Acceleration of gravity [m/s^2]."""
    mass: Estimate | None = None
    """Mass m of all rotating parts, measured separately [kg]."""
    length: Estimate | None = None
    """Distance l from the axis to the centre of mass of all rotating parts, measured separately
    [m]."""
    inertia: Estimate | None = None
    """Moment of inertia I = m g l / w2 about the axis [kg m^2]."""
    friction: Estimate | None = None
    """Viscous friction b = c I [N m s]."""
    fit: SwingFit | None = None
    """Fit of the free swing; None for an assumed pendulum."""

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        w2 = self.w2.value
        if not w2 > 0.0 or not MIN_PERIOD <= self.period <= MAX_PERIOD:
            raise ValueError(
                f"w2 is {w2:.3g} 1/s^2, expected that of a period from {MIN_PERIOD:g} s to "
                f"{MAX_PERIOD:g} s"
            )
        k, expected = self.k.value, w2 / self.g
        if not 0.01 * w2 <= self.g * k <= 100.0 * w2:
            raise ValueError(f"k is {k:.3g} 1/m, expected about w2 / g = {expected:.3g}")
        for name, least in (("coulomb", 0.0), ("drag", 0.0), ("c", -MAX_FRICTION)):
            if not least <= (value := getattr(self, name).value) <= MAX_FRICTION:
                raise ValueError(f"{name} is {value:.3g}, expected {least:g} to {MAX_FRICTION:g}")
        return self

    @classmethod
    @checked
    def assumed(
        cls,
        w2: GravityOverInertia,
        c: FrictionOverInertia,
        *,
        g: Annotated[float, Field(ge=0.1, le=100.0)] = GRAVITY,
    ) -> Self:
        """Return an assumed pendulum, with intervals of zero width.

        Args:
            w2: Gravity over inertia [1/s^2].
            c: Viscous friction over inertia [1/s].
            g: Acceleration of gravity [m/s^2].
        """
        w2_, k_, c_, zero = (Estimate.around(v, 0.0, "assumed") for v in (w2, w2 / g, c, 0.0))
        numbers: dict[str, Any] = {"w2": w2_, "k": k_, "c": c_, "coulomb": zero, "drag": zero}
        exact = ((0.0, 0.0, 0.0, 0.0),) * 4
        return cls(**numbers, covariance=exact, friction_model="viscous", g=g)

    def __repr__(self) -> str:
        """Return one line with the best values and their recording."""
        names = ("w2", "k", "c", "coulomb", "drag")
        numbers = ", ".join(f"{name}={getattr(self, name).value:.4g}" for name in names)
        source = "assumed" if self.fit is None else f"from {self.fit.source!r}"
        return f"<Pendulum {numbers}, {source}>"

    __str__ = __repr__

    @property
    def period(self) -> float:
        """Period of a small free swing [s]."""
        return 2.0 * pi / float(np.sqrt(self.w2.value))

    def parameters(self, *, linearised: bool = False) -> PendulumParameters:
        """Return the best values as parameters for kernels.

        Args:
            linearised: Use sin(phi) = phi, cos(phi) = 1, as equation (7) is printed.
        """
        best = (estimate.value for estimate in (self.w2, self.k, self.c, self.coulomb, self.drag))
        return PendulumParameters(*best, linearised=linearised)


def read_pendulum(pendulum: Pendulum | StrPath | None) -> Pendulum:
    """Return a given pendulum, that of a file, or by default the shipped one.

    Raises:
        ArtefactError: The file holds no pendulum.
    """
    if pendulum is None:
        return shipped_pendulum()
    return pendulum if isinstance(pendulum, Pendulum) else Pendulum.load(pendulum)


@functools.cache
def shipped_pendulum() -> Pendulum:
    """Load the pendulum that ships with Equipoise."""
    return Pendulum.load(PACKAGE / "data" / "pendulum.json")
