"""Parameters of the pendulum mechanism, each in one place.

Lengths are in millimetres, as in every drawing; everything that the checks compute is SI. The
frame of the parts has its origin in the centre of the flange's face: X points from the flange's
axis to the pendulum and is the axis of the spindle's direction, Z points out of the flange, which
is down at home. A place along X is a distance from the flange's axis.

Numbers that the program knows too are read from it: the distance of the pendulum's plane, the
period, the counts and the track. Marks of a source: [standard], [maker] a data sheet or drawing,
[mesh] measured on a public mesh, [memory] to be checked on the part before printing, [choice].
"""

from typing import Final, NamedTuple

from equipoise.arm.iiwa import PIVOT_OUTWARD
from equipoise.paper import FREE_SWING_PERIOD

MM: Final = 1e-3
"""Metres in a millimetre."""


class Flange(NamedTuple):
    """Robot flange ISO 9409-1-50-4-M6: Panda, FR3, and four of the holes of an iiwa's."""

    pitch_circle: float = 50.0
    """Diameter of the circle of screws and dowel [standard], as on the meshes of iiwa and FR3."""
    outer: float = 63.0
    """Outer diameter of the flange's face [standard]."""
    screw_deg: tuple[float, ...] = (45.0, 135.0, 225.0, 315.0)
    """Directions of the screws from X [deg]; on an FR3 the dowel is on X [mesh]."""
    dowel_deg: tuple[float, ...] = (0.0, 90.0, 180.0, 270.0)
    """Directions of the dowel holes from X [deg]; one of them meets the flange's dowel hole."""
    dowel: float = 6.0
    """Diameter of the dowel [standard]: ISO 8734, 6 m6 x 12."""
    engagement_min: float = 6.0
    """Least length of thread of an M6 screw in the flange [standard]."""
    engagement_max: float = 8.0
    """Greatest length of an M6 screw in the flange [memory]: measure the depth of its holes."""


class Bearing(NamedTuple):
    """Deep-groove ball bearing 608 [standard, ISO 15]."""

    bore: float = 8.0
    outer: float = 22.0
    width: float = 7.0
    shoulder: float = 19.6
    """Bore of the housing between the bearings: at most 20, so that it carries the outer ring
    [maker]; the ledge of 1.2 prints without support."""
    inner_shoulder: float = 11.5
    """Diameter of what touches the inner ring, which has 12.1 [maker]."""
    mass: float = 0.012
    """Mass [kg] [maker]."""


class Encoder(NamedTuple):
    """Modular encoder AMT102-V with its wide base."""

    pitch_circle: float = 46.02
    """Distance of the two screws of the wide base, 1.812 inches [memory]; slots allow +-1 mm."""
    screw: float = 2.5
    """Diameter of the screws, which pass holes for #4-40 [memory]."""
    shaft_min: float = 9.0
    """Least length of shaft over the mounting face [maker]."""
    width: float = 56.0
    """Width of the wide base along its screws, with some margin [memory]."""
    height: float = 30.0
    """Width of the body across the screws [memory]."""
    connector: float = 27.0
    """Distance from the shaft to the end of the connector's side [memory]."""
    depth: float = 11.0
    """Depth of base and body over the mounting face [memory]."""
    mass: float = 0.0205
    """Mass [kg] [maker]."""


class Screw(NamedTuple):
    """Metric socket head screw ISO 4762 with what belongs to it [standard]."""

    size: float
    """Nominal diameter."""
    hole: float
    """Clearance hole, ISO 273 medium."""
    head: float
    """Diameter of the head."""
    head_height: float
    """Height of the head."""
    washer: float
    """Outer diameter of the washer ISO 7089."""
    washer_height: float
    """Thickness of the washer."""
    tool: float
    """Diameter that the tool needs above the head: the head, and the corners of its key."""
    nut: float = 0.0
    """Width across flats of the nut."""
    nut_height: float = 0.0
    """Height of a lock nut ISO 10511."""
    insert: float = 0.0
    """Hole for a brass insert that is melted in [maker: ruthex]."""
    insert_length: float = 0.0
    """Length of that insert [maker: ruthex]."""


M2_5: Final = Screw(2.5, 2.9, 4.5, 2.5, 6.0, 0.5, 5.5, nut=5.0, nut_height=2.0)
M3: Final = Screw(3.0, 3.4, 5.5, 3.0, 7.0, 0.5, 6.5, insert=4.0, insert_length=5.7)
M4: Final = Screw(4.0, 4.5, 7.0, 4.0, 9.0, 0.8, 8.0, 7.0, 5.0, insert=5.6, insert_length=8.1)
M6: Final = Screw(6.0, 6.6, 10.0, 6.0, 12.0, 1.6, 12.5)


class Print(NamedTuple):
    """Limits and densities of a print of PETG with a nozzle of 0.4 mm."""

    wall_min: float = 1.6
    """Least wall: four lines [choice]."""
    hole_min: float = 1.6
    """Least diameter of a hole [choice]."""
    seat_oversize: float = 0.05
    """Oversize of a bearing's seat [choice]: print a ring of the seat first and adjust it."""
    density: float = 1270.0
    """Density of PETG [kg/m^3] [maker]."""
    shell: float = 1.7
    """Thickness of four printed lines."""
    infill: float = 0.4
    """Part of the volume inside the shell that is filled [choice]."""
    modulus: float = 1.5e9
    """Young's modulus of a print [Pa]; a solid bar has 1.9e9 [maker], layers and infill less."""


class Design(NamedTuple):
    """Dimensions of the mechanism; the defaults are the design."""

    pivot_outward: float = PIVOT_OUTWARD / MM
    """Distance of the pendulum's plane from the flange's axis."""
    pivot_down: float = 30.0
    """Distance of the spindle's axis from the base's upper face; 3 mm above the encoder remain."""
    period: float = FREE_SWING_PERIOD
    """Period of a small free swing [s]; it determines the rod's length."""

    plate: float = 10.0
    """Thickness of base plate and web."""
    plate_diameter: float = 76.0
    """Diameter of the base plate."""
    cable_bore: float = 24.0
    """Bore in the base plate, over the connectors of a media flange."""
    spot_face: float = 2.4
    """Depth of the seats of the M6 washers in the plate."""
    screw_length: float = 16.0
    """Length of the M6 screws."""
    half_width: float = 38.0
    """Half of the width of web, wall and stand."""
    rib: float = 7.0
    """Thickness of the two ribs."""
    rib_start: float = 22.0
    """Place along X at which the ribs begin."""
    wall_start: float = 68.0
    """Inner face of the wall that carries bearings and encoder."""
    wall: float = 10.0
    """Thickness of that wall."""
    wall_below: float = 18.0
    """Height of wall, encoder plate and flange of the block on each side of the spindle."""
    wall_bore: float = 24.0
    """Bore in the wall around the inner shaft collar."""
    block_screws: tuple[float, float] = (28.0, 12.0)
    """Places of the four M4 screws of the bearing block beside and above the spindle."""
    encoder_screws: tuple[float, float] = (15.0, 12.0)
    """Places of the four M3 screws of the encoder plate beside and above the spindle."""
    encoder_plate: float = 6.0
    """Thickness of the encoder plate."""

    block_flange: float = 6.0
    """Thickness of the bearing block's flange."""
    block_end: float = 118.0
    """Outer end of the bearing block."""
    block_wall: float = 6.0
    """Wall around the bearings."""

    spindle: float = 8.0
    """Diameter of the spindle: a ground rod, h6."""
    spindle_beyond_encoder: float = 10.0
    """Length of the spindle beyond the encoder plate."""
    spacer: float = 1.5
    """Thickness of the ring between inner bearing and collar."""
    collar: tuple[float, float] = (16.0, 8.0)
    """Outer diameter and width of a shaft collar DIN 705 A8 [standard]."""

    rod: float = 10.0
    """Diameter of the rod: steel, h9 or ground."""
    rod_start: float = 10.0
    """Distance of the rod's inner end from the spindle's axis."""
    hub_boss: float = 2.0
    """Height of the ring with which the hub touches the outer bearing's inner ring."""
    hub_width: float = 18.0
    """Length of the hub along the spindle, and its width across."""
    hub_back: float = 14.0
    """Reach of the hub behind the spindle."""
    hub_clamp_screw: float = 8.7
    """Distance of the screw that clamps the spindle from the spindle's axis."""
    hub_end: float = 46.0
    """Reach of the hub along the rod."""
    hub_rod_width: float = 16.0
    """Width of the clamp around the rod."""
    hub_rod_ear: float = 14.0
    """Reach of the rod's clamp in front of the rod's axis."""
    hub_rod_screws: tuple[float, float] = (19.0, 37.0)
    """Distances of the screws that clamp the rod from the spindle's axis."""
    hub_rod_screw_front: float = 8.9
    """Distance of those screws from the rod's axis."""
    slit: float = 1.5
    """Width of the slits of the clamps."""
    catch_hole: float = 1.8
    """Diameter of the holes of the catch wire in hub and rod."""
    catch_at: float = 52.0
    """Distance of the rod's hole for the catch wire from the spindle's axis."""

    stand_height: float = 45.0
    """Height of the spindle over the table."""
    stand_length: float = 110.0
    """Length of the stand's foot behind the wall."""

    flange: Flange = Flange()
    bearing: Bearing = Bearing()
    encoder: Encoder = Encoder()
    print: Print = Print()

    @property
    def wall_end(self) -> float:
        """Outer face of the wall, on which the bearing block sits."""
        return self.wall_start + self.wall

    @property
    def encoder_face(self) -> float:
        """Face on which the encoder sits."""
        return self.wall_start - self.encoder_plate

    @property
    def hub_start(self) -> float:
        """Inner face of the hub."""
        return self.block_end + self.hub_boss

    @property
    def spindle_start(self) -> float:
        """Inner end of the spindle."""
        return self.encoder_face - self.spindle_beyond_encoder

    @property
    def spindle_end(self) -> float:
        """Outer end of the spindle: that of the outer collar."""
        return self.hub_start + self.hub_width + self.collar[1]


STEEL: Final = 7850.0
"""Density of steel [kg/m^3]."""
CABLE_MASS: Final = 0.015
"""Mass of the encoder's cable on the base [kg], 0.3 m of four cores with shield [choice]."""
