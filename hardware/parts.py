"""Parts of the mechanism as solids, in their places on the flange, the pendulum hanging.

Printed parts are made for their print: see `PRINTED`. Bought parts are drawn as what they occupy.
A clearance hole, a seat or a pocket is cut from a part by the solid that it makes room for.
"""

from collections.abc import Iterable
from math import cos, hypot, radians, sin
from typing import Final, NamedTuple

from build123d import (
    Axis,
    Box,
    BuildLine,
    Cylinder,
    Location,
    Part,
    Plane,
    Polyline,
    Pos,
    RegularPolygon,
    Rot,
    ShapeList,
    Solid,
    chamfer,
    extrude,
    fillet,
    make_face,
)

from design import M2_5, M3, M4, M6, Design, Screw


def cylinder(axis: str, diameter: float, start: float, end: float, at: tuple = (0.0, 0.0)) -> Part:
    """Return a cylinder from `start` to `end` along X, Y or Z.

    Args:
        axis: Direction.
        diameter: Diameter [mm].
        start: First end along the axis [mm].
        end: Second end [mm].
        at: Place across the axis, in the order of the other two of X, Y and Z [mm].
    """
    a, b = at
    middle = 0.5 * (start + end)
    place = {
        "X": Pos(middle, a, b) * Rot(0, 90, 0),
        "Y": Pos(a, middle, b) * Rot(90, 0, 0),
        "Z": Pos(a, b, middle),
    }
    return place[axis] * Cylinder(0.5 * diameter, abs(end - start))


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Part:
    """Return a box between three pairs of places [mm]."""
    middle = (0.5 * sum(pair) for pair in (x, y, z))
    return Pos(*middle) * Box(*(abs(pair[1] - pair[0]) for pair in (x, y, z)))


def nut_along_y(screw: Screw, y: tuple[float, float], at: tuple[float, float]) -> Part:
    """Return a hexagonal prism along Y with two flats across Z, around a nut [mm]."""
    a, b = at
    face = Plane((a, y[0], b), x_dir=(1, 0, 0), z_dir=(0, 1, 0)) * RegularPolygon(
        screw.nut / 2.0, 6, major_radius=False
    )
    return extrude(face, y[1] - y[0])


def profile(points: Iterable[tuple[float, float]], y: tuple[float, float]) -> Part:
    """Return the prism between two places along Y over a polygon in X and Z [mm]."""
    with BuildLine() as outline:
        Polyline(*((x, 0.0, z) for x, z in points), close=True)
    face = make_face(outline.line)
    prism = extrude(face, y[1] - y[0], dir=(0, 1, 0))
    return Pos(0.0, y[0], 0.0) * prism


def corners(d: Design, places: tuple[float, float]) -> list[tuple[float, float]]:
    """Return four places in Y and Z around the spindle [mm]."""
    a, b = places
    return [(y, d.pivot_down + z) for y in (-a, a) for z in (-b, b)]


def flange_places(d: Design, angles: Iterable[float]) -> list[tuple[float, float]]:
    """Return places in X and Y on the flange's pitch circle [mm]."""
    r = 0.5 * d.flange.pitch_circle
    return [(r * cos(radians(angle)), r * sin(radians(angle))) for angle in angles]


def wall_with_holes(d: Design, z: tuple[float, float], tool_from: float) -> Part:
    """Return the wall that carries bearings and encoder, the same on base and stand.

    Args:
        d: The design.
        z: Its ends along Z [mm].
        tool_from: End along Z from which a key reaches the screw of the inner collar [mm].
    """
    start, end = d.wall_start, d.wall_end
    wall = box((start, end), (-d.half_width, d.half_width), z)
    wall -= cylinder("X", d.wall_bore, start - 1, end + 1, (0.0, d.pivot_down))
    middle = d.wall_end - d.spacer - 0.5 * d.collar[1]
    wall -= cylinder("Z", M4.hole, d.pivot_down, tool_from, (middle, 0.0))
    for place in corners(d, d.block_screws):
        wall -= cylinder("X", M4.hole, start, end + 1, place)
        wall -= cylinder("X", M4.insert, start - 1, start + M4.insert_length, place)
    for place in corners(d, d.encoder_screws):
        wall -= cylinder("X", M3.insert, start - 1, start + M3.insert_length + 1.0, place)
    return wall


def base(d: Design) -> Solid:
    """Return the base: flange plate, web, ribs and wall in one part."""
    half, lower = d.half_width, d.pivot_down + d.wall_below
    plate = cylinder("Z", d.plate_diameter, 0.0, d.plate)
    web = box((0.0, d.wall_end), (-half, half), (0.0, d.plate))
    part = plate + web + wall_with_holes(d, (0.0, lower), lower + 1.0)
    outline = [
        (d.rib_start, d.plate - 1.0),
        (d.wall_start + 1.0, d.plate - 1.0),
        (d.wall_start + 1.0, lower - 4.0),
        (d.rib_start, d.plate + 3.0),
    ]
    for y in (-half, half - d.rib):
        rib = profile(outline, (y, y + d.rib))
        tie_x, tie_z = d.wall_start - 14.0, d.plate + 8.0  # two slots: one cable tie
        for z in (tie_z, tie_z + 8.0):
            rib -= box((tie_x - 2.5, tie_x + 2.5), (y - 1, y + d.rib + 1), (z, z + 2.0))
        part += rib
    part -= cylinder("Z", d.cable_bore, -1.0, d.plate + 1.0)
    for place in flange_places(d, d.flange.screw_deg):
        part -= cylinder("Z", M6.hole, -1.0, d.plate + 1.0, place)
        part -= cylinder("Z", M6.tool + 0.5, d.plate - d.spot_face, lower, place)
    for place in flange_places(d, d.flange.dowel_deg):
        part -= cylinder("Z", d.flange.dowel - 0.1, -1.0, d.plate - 3.0, place)  # reamed to 6 H7
        part -= cylinder("Z", 3.0, -1.0, d.plate + 1.0, place)  # to push the dowel out
    edges = part.edges().filter_by(Axis.Z).group_by(lambda edge: edge.center().X)[-1]
    part = fillet(edges, 4.0)
    return _one(part)


def bearing_block(d: Design) -> Solid:
    """Return the bearing block: both seats on one axis, printed upright."""
    b, axis = d.bearing, (0.0, d.pivot_down)
    start, end = d.wall_end, d.block_end
    half = (d.half_width, d.wall_below)
    flange = box(
        (start, start + d.block_flange),
        (-half[0], half[0]),
        (d.pivot_down - half[1], d.pivot_down + half[1]),
    )
    flange = fillet(flange.edges().filter_by(Axis.X), 4.0)
    outer = b.outer + 2.0 * d.block_wall
    part = flange + cylinder("X", outer, start, end, axis)
    seat = b.outer + d.print.seat_oversize
    part -= cylinder("X", b.shoulder, start - 1, end + 1, axis)
    part -= cylinder("X", seat, start - 1, start + b.width, axis)
    part -= cylinder("X", seat, end - b.width, end + 1, axis)
    for place in corners(d, d.block_screws):
        part -= cylinder("X", M4.hole, start - 1, end, place)
    rim = [edge for edge in part.edges() if _is_rim(edge, start, end, seat)]
    return _one(chamfer(rim, 0.5))


def _is_rim(edge: object, start: float, end: float, diameter: float) -> bool:
    """Return whether an edge is the mouth of a bearing's seat."""
    at_end = min(abs(edge.center().X - start), abs(edge.center().X - end)) < 1e-3
    return at_end and abs(edge.length - 3.141592653589793 * diameter) < 0.1


def encoder_plate(d: Design) -> Solid:
    """Return the plate between wall and encoder, with slots along Y for the encoder's screws."""
    start, end, e = d.encoder_face, d.wall_start, d.encoder
    z = (d.pivot_down - d.wall_below + 1.0, d.pivot_down + d.wall_below - 1.0)
    part = box((start, end), (-d.half_width + d.rib + 1.0, d.half_width - d.rib - 1.0), z)
    part = fillet(part.edges().filter_by(Axis.X), 3.0)
    part -= cylinder("X", d.spindle + 2.0, start - 1, end + 1, (0.0, d.pivot_down))
    part -= cylinder("X", d.collar[0] + 2.0, end - 2.0, end + 1, (0.0, d.pivot_down))
    for y, height in corners(d, d.encoder_screws):
        part -= cylinder("X", M3.hole, start - 1, end + 1, (y, height))
        part -= cylinder("X", M3.tool + 0.3, start - 1, start + M3.head_height + 0.4, (y, height))
    for side in (-1.0, 1.0):
        y = side * 0.5 * e.pitch_circle
        for width, depth in ((M2_5.hole, (start - 1, end + 1)), (M2_5.nut + 0.3, (end - 3.0, end))):
            wide = 1.0 + 0.5 * width
            z = (d.pivot_down - 0.5 * width, d.pivot_down + 0.5 * width)
            part -= box(depth, (y - wide, y + wide), z)
    return _one(part)


def spindle(d: Design) -> Solid:
    """Return the spindle: a ground rod, both ends chamfered."""
    part = cylinder("X", d.spindle, d.spindle_start, d.spindle_end, (0.0, d.pivot_down))
    return _one(chamfer(part.edges(), 0.5))


def spacer(d: Design) -> Solid:
    """Return the ring between inner bearing and inner collar."""
    start, end, axis = d.wall_end - d.spacer, d.wall_end, (0.0, d.pivot_down)
    ring = cylinder("X", d.bearing.inner_shoulder, start, end, axis)
    return _one(ring - cylinder("X", d.spindle + 0.3, start - 1, end + 1, axis))


def collar(d: Design, start: float) -> Part:
    """Return a shaft collar DIN 705 A8."""
    end, axis = start + d.collar[1], (0.0, d.pivot_down)
    ring = cylinder("X", d.collar[0], start, end, axis)
    return ring - cylinder("X", d.spindle, start - 1, end + 1, axis)


def hub(d: Design) -> Solid:
    """Return the hub: one clamp for the spindle, one for the rod, in its place when hanging."""
    x, z = d.pivot_outward, d.pivot_down
    start, half = d.hub_start, 0.5 * d.hub_width
    width = 0.5 * d.hub_rod_width
    around = (z - d.hub_back, z + d.rod_start)
    part = box((start, start + d.hub_width), (-half, half), around)
    rod_end = x + d.hub_rod_ear
    part += box((start, rod_end), (-width, width), (z + d.rod_start, z + d.hub_end))
    part = chamfer(part.edges().filter_by(Axis.X).group_by(Axis.Z)[-1], 3.0)
    part += cylinder("X", d.bearing.inner_shoulder, d.block_end, start, (0.0, z))
    part -= cylinder("X", d.spindle, d.block_end - 1, rod_end + 1, (0.0, z))
    part -= cylinder("Z", d.rod, z + d.rod_start, z + d.hub_end + 1, (x, 0.0))
    slit = (-0.5 * d.slit, 0.5 * d.slit)
    part -= box((d.block_end - 1, rod_end + 1), slit, (z - d.hub_back - 1, z))
    part -= box((x, rod_end + 1), slit, (z + d.rod_start, z + d.hub_end + 1))
    for at in hub_screw_places(d):
        part -= cylinder("Y", M4.hole, -40.0, 40.0, at)
    part -= cylinder("Y", d.catch_hole, -40.0, 40.0, catch_place(d))
    return _one(part)


def hub_screw_places(d: Design) -> list[tuple[float, float]]:
    """Return the places of the clamp screws in X and Z [mm]: of the spindle, and two of the rod."""
    first = (d.hub_start + 0.5 * d.hub_width, d.pivot_down - d.hub_clamp_screw)
    front = d.pivot_outward + d.hub_rod_screw_front
    return [first, *((front, d.pivot_down + place) for place in d.hub_rod_screws)]


def catch_place(d: Design) -> tuple[float, float]:
    """Return the place of the hub's hole for the catch wire in X and Z [mm]."""
    return d.hub_start + 2.5, d.pivot_down + d.hub_end - 5.0


def rod(d: Design, length: float) -> Solid:
    """Return the rod, with the cross hole of the catch wire, when hanging.

    Args:
        d: The design.
        length: Its length [mm].
    """
    x, top = d.pivot_outward, d.pivot_down + d.rod_start
    part = cylinder("Z", d.rod, top, top + length, (x, 0.0))
    part = chamfer(part.edges(), 0.5)
    return _one(part - cylinder("Y", d.catch_hole, -40.0, 40.0, (x, d.pivot_down + d.catch_at)))


def stand(d: Design) -> Solid:
    """Return the stand: the wall on a foot that two clamps hold on the edge of a table."""
    half, table = d.half_width, d.pivot_down + d.stand_height
    foot = (table - d.plate, table)
    upper = d.pivot_down - d.wall_below
    back = d.wall_end - d.stand_length
    part = box((back, d.wall_end), (-half, half), foot)
    part += wall_with_holes(d, (upper, table), upper - 1.0)
    outline = [
        (d.wall_start - 45.0, foot[0] + 1.0),
        (d.wall_start + 1.0, foot[0] + 1.0),
        (d.wall_start + 1.0, upper + 4.0),
        (d.wall_start - 45.0, foot[0] - 3.0),
    ]
    for y in (-half, half - d.rib):
        part += profile(outline, (y, y + d.rib))
    return _one(part)


def encoder(d: Design) -> Part:
    """Return the space of the encoder, with the ears of its base and its connector."""
    e, z, end = d.encoder, d.pivot_down, d.encoder_face
    start = end - e.depth
    half = 0.5 * e.height
    body = box((start, end), (-half, half), (z - half, z + e.connector))
    ears = box((end - 3.0, end), (-0.5 * e.width, 0.5 * e.width), (z - 5.0, z + 5.0))
    return body + ears - cylinder("X", d.spindle, start - 1, end + 1, (0.0, z))


def bearing(d: Design, start: float) -> Part:
    """Return a bearing from a place along X on [mm]."""
    b, axis = d.bearing, (0.0, d.pivot_down)
    ring = cylinder("X", b.outer, start, start + b.width, axis)
    return ring - cylinder("X", b.bore, start - 1, start + b.width + 1, axis)


class Fastener(NamedTuple):
    """Screw in its place."""

    name: str
    screw: Screw
    length: float
    """Length under the head [mm]."""
    axis: str
    """X, Y or Z; with a sign: the direction from head to tip."""
    seat: float
    """Place of the washer's or the head's seat along that axis [mm]."""
    at: tuple[float, float]
    """Place across the axis [mm]."""
    washer: bool
    nut: float | None = None
    """Place of the nut's seat along the axis [mm]; None for an insert or a tapped hole."""

    @property
    def sign(self) -> float:
        """Direction along the axis from head to tip."""
        return -1.0 if self.axis[0] == "-" else 1.0

    @property
    def under_head(self) -> float:
        """Place of the underside of the head [mm]."""
        return self.seat - self.sign * (self.screw.washer_height if self.washer else 0.0)

    @property
    def tip(self) -> float:
        """Place of the tip [mm]."""
        return self.under_head + self.sign * self.length

    def solid(self) -> Part:
        """Return screw, washer and nut."""
        s, axis, sign = self.screw, self.axis[-1], self.sign
        part = cylinder(axis, s.size, self.under_head, self.tip, self.at)
        top = self.under_head - sign * s.head_height
        part += cylinder(axis, s.head, self.under_head, top, self.at)
        if self.washer:
            part += cylinder(axis, s.washer, self.seat, self.under_head, self.at)
        if self.nut is not None:
            part += cylinder(axis, s.nut, self.nut, self.nut + sign * s.nut_height, self.at)
        return part

    def tool_space(self, length: float = 40.0) -> Part:
        """Return the space that a key needs above the head."""
        top = self.under_head - self.sign * self.screw.head_height
        end = top - self.sign * length
        return cylinder(self.axis[-1], self.screw.tool, top, end, self.at)


def fasteners(d: Design) -> list[Fastener]:
    """Return the screws of the mechanism in their places."""
    seat = d.plate - d.spot_face
    found = [
        Fastener(f"flange {number}", M6, d.screw_length, "-Z", seat, place, washer=True)
        for number, place in enumerate(flange_places(d, d.flange.screw_deg), 1)
    ]
    block = d.wall_end + d.block_flange
    for number, place in enumerate(corners(d, d.block_screws), 1):
        found.append(Fastener(f"block {number}", M4, 16.0, "-X", block, place, washer=True))
    head = d.encoder_face + M3.head_height + 0.4
    for number, place in enumerate(corners(d, d.encoder_screws), 1):
        found.append(Fastener(f"plate {number}", M3, 8.0, "X", head, place, washer=False))
    for number, side in enumerate((-1.0, 1.0), 1):
        at = (side * 0.5 * d.encoder.pitch_circle, d.pivot_down)
        seat, nut = d.encoder_face - 3.0, d.wall_start - 3.0
        found.append(Fastener(f"encoder {number}", M2_5, 8.0, "X", seat, at, False, nut))
    halves = (0.5 * d.hub_width, 0.5 * d.hub_rod_width, 0.5 * d.hub_rod_width)
    for number, (at, half) in enumerate(zip(hub_screw_places(d), halves, strict=True), 1):
        found.append(Fastener(f"hub {number}", M4, 25.0, "-Y", half, at, True, -half))
    return found


def box_shell(d: Design) -> Solid:
    """Return the box of the board: Pico on two ribs, a button of 16 mm, two cables, two straps."""
    size, wall = BOX_SIZE, BOX_WALL
    x, y, z = (0.5 * s for s in size)
    outer = fillet(Box(*size).edges().filter_by(Axis.Z), 4.0)
    part = outer - Pos(0, 0, wall) * Box(size[0] - 2 * wall, size[1] - 2 * wall, size[2])
    for a in (-1, 1):
        for b in (-1, 1):
            post = Pos(a * (x - 5.0), b * (y - 5.0), -0.5 * wall) * Box(9.0, 9.0, size[2] - wall)
            hole = Pos(a * (x - 5.0), b * (y - 5.0), z - 4.0) * Cylinder(0.5 * M3.insert, 8.1)
            part += post - hole
    part = part & outer
    for place in pico_holes():
        post = Pos(*place, -z + wall + 2.5) * Cylinder(3.0, 5.0)
        part += post
        part -= Pos(*place, -z + wall + 3.0) * Cylinder(0.8, 5.0)  # M2 screws cut their thread
    part -= Pos(-x, PICO_Y, -z + wall + 7.5) * Box(20.0, 12.0, 8.0)  # USB plug
    part -= Pos(x, -6.0, 1.0) * Rot(0, 90, 0) * Cylinder(3.25, 20.0)  # cable of the encoder
    part -= Pos(x - 22.0, -y, 2.0) * Rot(90, 0, 0) * Cylinder(8.1, 20.0)  # button
    for a in (-1, 1):  # straps around the arm, or screws on a table
        lug = Pos(a * (x + 7.0), 0.0, -z + 2.0) * Box(16.0, 34.0, 4.0)
        part += lug - Pos(a * (x + 8.0), 0.0, -z + 2.0) * Box(5.0, 26.0, 6.0)
    return _one(part)


def box_lid(d: Design) -> Solid:
    """Return the lid of the box."""
    size, wall = BOX_SIZE, BOX_WALL
    x, y, z = (0.5 * s for s in size)
    lid = Pos(0, 0, z + 0.5 * LID) * Box(size[0], size[1], LID)
    lid = fillet(lid.edges().filter_by(Axis.Z), 4.0)
    lip = Pos(0, 0, z - 1.0) * Box(size[0] - 2 * wall - 0.6, size[1] - 2 * wall - 0.6, 2.0)
    for a in (-1, 1):
        for b in (-1, 1):
            lip -= Pos(a * (x - 5.0), b * (y - 5.0), z) * Box(10.0, 10.0, 6.0)
    lid += lip - Pos(0, 0, z - 1.0) * Box(size[0] - 12.0, size[1] - 12.0, 3.0)
    for a in (-1, 1):
        for b in (-1, 1):
            lid -= Pos(a * (x - 5.0), b * (y - 5.0), z) * Cylinder(0.5 * M3.hole, 20.0)
    return _one(lid)


BOX_SIZE: Final = (92.0, 56.0, 32.0)
"""Outer length, width and height of the box without its lid [mm]."""
BOX_WALL: Final = 2.4
"""Wall of the box [mm]."""
LID: Final = 3.0
"""Thickness of the lid [mm]."""
PICO_Y: Final = 8.0
"""Place of the Pico's middle across the box [mm]."""


def pico_holes() -> list[tuple[float, float]]:
    """Return the four holes of a Raspberry Pi Pico, 47 x 11.4 mm, in the box [mm]."""
    x0 = -0.5 * BOX_SIZE[0] + BOX_WALL + 0.6 + 2.0
    return [(x0 + a * 47.0, PICO_Y + b * 5.7) for a in (0, 1) for b in (-1, 1)]


def _one(part: Part | ShapeList) -> Solid:
    """Return the only solid of a shape.

    Raises:
        ValueError: There are more, or none.
    """
    solids = part.solids()
    if len(solids) != 1:
        raise ValueError(f"expected one solid, got {len(solids)}")
    return solids[0]


PRINTED: Final = ("base", "bearing_block", "encoder_plate", "hub", "spacer", "stand", "box", "lid")
"""Names of the printed parts."""


def printed(d: Design) -> dict[str, Solid]:
    """Return the printed parts in their places, by name."""
    makers = (base, bearing_block, encoder_plate, hub, spacer, stand, box_shell, box_lid)
    return {name: make(d) for name, make in zip(PRINTED, makers, strict=True)}


def for_print(d: Design, name: str, part: Solid) -> Solid:
    """Return a printed part as it lies on the printer's bed, its lowest point at zero."""
    turn = {
        "base": Rot(0, 0, 0),  # flange face down; the bores of wall and web need no support
        "bearing_block": Rot(0, -90, 0),  # flange face down, the seats upright
        "encoder_plate": Rot(0, -90, 0),
        "hub": Rot(0, 90, 0),
        "spacer": Rot(0, 90, 0),
        "stand": Rot(180, 0, 0),  # foot down
        "box": Rot(0, 0, 0),
        "lid": Rot(180, 0, 0),
    }
    turned = turn[name] * part
    box_ = turned.bounding_box()
    low, middle = box_.min, box_.center()
    return Location((-middle.X, -middle.Y, -low.Z)) * turned


def reach(d: Design, length: float) -> float:
    """Return the distance of the rod's tip from the spindle's axis [mm]."""
    return hypot(d.rod_start + length, 0.5 * d.rod)
