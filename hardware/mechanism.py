"""The mechanism as bodies: masses, centres, inertias, and the numbers that robot and twin take.

The bodies have SI units in the frame of the parts. Of the holder (all that is fixed to the flange)
and the pendulum (all that turns), only their sums matter: the pendulum is free to turn, so that the
flange feels its mass as if it were in the pivot.
"""

import functools
from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from build123d import Part, Solid
from scipy.optimize import brentq

import parts
from design import CABLE_MASS, MM, STEEL, Design
from equipoise.settings import GRAVITY

Array = npt.NDArray[np.float64]

SOLID: Final = ("hub", "spacer")
"""Printed parts that are filled: they are clamped or small."""


class Body(NamedTuple):
    """Rigid body in the frame of the parts."""

    name: str
    mass: float
    """Mass [kg]."""
    centre: Array
    """Centre of mass [m], shape (3,)."""
    inertia: Array
    """Inertia about the centre of mass [kg m^2], shape (3, 3)."""

    def inertia_at(self, point: Array) -> Array:
        """Return the inertia about a point [kg m^2], shape (3, 3)."""
        r = self.centre - point
        return self.inertia + self.mass * (r @ r * np.eye(3) - np.outer(r, r))


def body(name: str, solid: Part | Solid, mass: float | None = None, density: float = 0.0) -> Body:
    """Return the body of a homogeneous solid.

    Args:
        name: Its name.
        solid: Its shape [mm].
        mass: Its mass [kg]; by default from its density.
        density: Its density [kg/m^3].
    """
    volume = solid.volume * MM**3
    mass = density * volume if mass is None else mass
    moments = [row.to_tuple() if hasattr(row, "to_tuple") else row for row in inertia_of(solid)]
    centre = np.array([*solid.center()]) * MM
    return Body(name, mass, centre, np.array(moments) * MM**5 * mass / volume)


def inertia_of(solid: Part | Solid) -> list[list[float]]:
    """Return the inertia of a solid about its centre for a density of one [mm^5]."""
    return solid.matrix_of_inertia


def together(name: str, bodies: Iterable[Body]) -> Body:
    """Return several bodies as one."""
    bodies = list(bodies)
    mass = sum(one.mass for one in bodies)
    centre = sum(one.mass * one.centre for one in bodies) / mass
    return Body(name, mass, centre, sum(one.inertia_at(centre) for one in bodies))


def printed_density(d: Design, name: str, solid: Part | Solid) -> float:
    """Return the mean density of a print [kg/m^3]: four lines around, and the infill.

    Args:
        d: The design.
        name: Name of the part; those of `SOLID` are filled.
        solid: The part.
    """
    shell = 1.0 if name in SOLID else min(1.0, solid.area * d.print.shell / solid.volume)
    return d.print.density * (shell + d.print.infill * (1.0 - shell))


class Mechanism(NamedTuple):
    """The designed mechanism."""

    design: Design
    rod_length: float
    """Length of the rod [mm]."""
    solids: dict[str, Part | Solid]
    """All solids of the mechanism on the flange by name [mm]."""
    holder: Body
    """All that is fixed to the flange."""
    pendulum: Body
    """All that turns, hanging."""
    bodies: tuple[Body, ...]
    """Every part."""

    @property
    def pivot(self) -> Array:
        """Pivot in the frame of the parts [m], shape (3,)."""
        return np.array([self.design.pivot_outward, 0.0, self.design.pivot_down]) * MM

    @property
    def length(self) -> float:
        """Distance l from the pivot to the pendulum's centre of mass, in its plane [m]."""
        return float(np.hypot(*(self.pendulum.centre - self.pivot)[1:]))

    @property
    def inertia(self) -> float:
        """Inertia I of the pendulum about the spindle [kg m^2]."""
        return float(self.pendulum.inertia_at(self.pivot)[0, 0])

    @property
    def w2(self) -> float:
        """Gravity over inertia, m g l / I [1/s^2]."""
        return self.pendulum.mass * GRAVITY * self.length / self.inertia

    @property
    def period(self) -> float:
        """Period of a small free swing [s]."""
        return 2.0 * np.pi / self.w2**0.5

    @property
    def load(self) -> Body:
        """Load for the robot's controller: the holder, and the pendulum's mass in the pivot."""
        point = Body("pendulum in the pivot", self.pendulum.mass, self.pivot, np.zeros((3, 3)))
        return together("load", [self.holder, point])

    @property
    def reach(self) -> float:
        """Largest distance of a point of the rod from the spindle's axis [m]."""
        return parts.reach(self.design, self.rod_length) * MM


ON_SPINDLE: Final = ("spindle", "inner collar", "outer collar", "spacer", "hub", "rod")
"""Parts that turn; the screws of the hub do too."""


def build(d: Design) -> Mechanism:
    """Return the mechanism, with the rod as long as the period asks for."""

    def with_rod(length: float) -> Mechanism:
        turning = [*fixed_part_of_pendulum(d), body("rod", parts.rod(d, length), density=STEEL)]
        solids, rest = holder_of(d)
        turning_solids = {**shapes_on_spindle(d), "rod": parts.rod(d, length)}
        holder = together("holder", rest)
        pendulum = together("pendulum", turning)
        everything = (*rest, *turning)
        return Mechanism(d, length, {**solids, **turning_solids}, holder, pendulum, everything)

    def late(length: float) -> float:
        return with_rod(length).period - d.period

    return with_rod(round(brentq(late, 60.0, 1500.0, xtol=0.01), 1))


@functools.cache
def shapes_on_spindle(d: Design) -> dict[str, Part | Solid]:
    """Return the turning parts but the rod, by name [mm]."""
    inner = d.wall_end - d.spacer - d.collar[1]
    shapes: dict[str, Part | Solid] = {
        "spindle": parts.spindle(d),
        "inner collar": parts.collar(d, inner),
        "outer collar": parts.collar(d, d.hub_start + d.hub_width),
        "spacer": parts.spacer(d),
        "hub": parts.hub(d),
    }
    screws = [screw for screw in parts.fasteners(d) if screw.name.startswith("hub")]
    return shapes | {f"screw {screw.name}": screw.solid() for screw in screws}


@functools.cache
def fixed_part_of_pendulum(d: Design) -> tuple[Body, ...]:
    """Return the turning bodies but the rod."""
    return tuple(
        body(name, shape, density=printed_density(d, name, shape) if name in SOLID else STEEL)
        for name, shape in shapes_on_spindle(d).items()
    )


@functools.cache
def holder_of(d: Design) -> tuple[dict[str, Part | Solid], tuple[Body, ...]]:
    """Return shapes and bodies of all that is fixed to the flange."""
    names = {"base": parts.base, "bearing_block": parts.bearing_block}
    names |= {"encoder_plate": parts.encoder_plate}
    shapes: dict[str, Part | Solid] = {name: make(d) for name, make in names.items()}
    bodies = [
        body(name, shape, density=printed_density(d, name, shape)) for name, shape in shapes.items()
    ]
    bought = {
        "encoder": (parts.encoder(d), d.encoder.mass),
        "inner bearing": (parts.bearing(d, d.wall_end), d.bearing.mass),
        "outer bearing": (parts.bearing(d, d.block_end - d.bearing.width), d.bearing.mass),
    }
    for name, (shape, mass) in bought.items():
        shapes[name] = shape
        bodies.append(body(name, shape, mass=mass))
    for screw in parts.fasteners(d):
        if not screw.name.startswith("hub"):
            shapes[f"screw {screw.name}"] = screw.solid()
            bodies.append(body(screw.name, screw.solid(), density=STEEL))
    cable = np.array([d.wall_start - 14.0, d.half_width, d.pivot_down]) * MM
    bodies.append(Body("cable", CABLE_MASS, cable, np.zeros((3, 3))))
    return shapes, tuple(bodies)
