"""Printed parts: closed, printable, and put together without two things in one place."""

from itertools import combinations

import numpy as np
import pytest
import trimesh
from build123d import Axis, Compound, GeomType

import parts
from design import M4
from stiffness import mesh

BED = (200.0, 200.0, 180.0)
"""Least bed of a common printer [mm]."""
ROUNDING = 1e-3
"""Overlap that rounding leaves [mm^3]."""


def overlap(a, b):
    """The volume that two solids share [mm^3]."""
    both = a & b
    return 0.0 if both is None else sum(one.volume for one in both.solids())


@pytest.fixture(scope="module")
def meshes(printed):
    return {name: mesh(part) for name, part in printed.items()}


@pytest.mark.parametrize("name", parts.PRINTED)
def test_a_part_is_one_closed_solid_whose_triangles_have_its_volume(name, printed, meshes):
    part, triangles = printed[name], meshes[name]
    assert part.is_valid
    assert triangles.is_watertight
    assert triangles.body_count == 1
    assert triangles.volume == pytest.approx(part.volume, rel=5e-3)


@pytest.mark.parametrize("name", parts.PRINTED)
def test_a_part_lies_on_the_bed(name, design, printed):
    lying = parts.for_print(design, name, printed[name])
    box = lying.bounding_box()
    assert pytest.approx(0.0, abs=1e-6) == box.min.Z
    assert tuple(box.size) < BED
    assert all(side <= bed for side, bed in zip(box.size, BED, strict=True))
    # It stands on a face, not on an edge: a tenth of its shadow at least.
    faces = lying.faces().filter_by(GeomType.PLANE)
    lowest = [face for face in faces if abs(face.center().Z) < 1e-6]
    assert sum(face.area for face in lowest) > 0.1 * box.size.X * box.size.Y


@pytest.mark.parametrize("name", parts.PRINTED)
def test_walls_are_as_thick_as_four_lines(name, design, meshes):
    """A ray from each point of the surface inwards meets an opposite face not before."""
    triangles = meshes[name]
    points, faces = trimesh.sample.sample_surface(triangles, 6000, seed=0)
    normals = triangles.face_normals[faces]
    hit, ray, face = triangles.ray.intersects_location(
        points - 1e-4 * normals, -normals, multiple_hits=False
    )
    opposite = np.einsum("ij,ij->i", triangles.face_normals[face], normals[ray]) < -0.95
    thickness = np.linalg.norm(hit - points[ray], axis=1)[opposite]
    assert len(thickness) > 1000
    assert thickness.min() > THINNEST.get(name, design.print.wall_min) - 0.05


THINNEST = {"spacer": 1.5}
"""Thinner on purpose [mm]: a ring."""


@pytest.mark.parametrize("name", parts.PRINTED)
def test_holes_are_wide_enough_to_print(name, design, printed):
    for face in printed[name].faces().filter_by(GeomType.CYLINDER):
        middle = face.position_at(0.5, 0.5)
        inwards = (face.axis_of_rotation.position - middle).dot(face.normal_at(0.5, 0.5))
        if inwards > 0.0:  # a hole, not the outside of a round
            assert 2.0 * face.radius >= design.print.hole_min - 1e-6


def test_nothing_is_where_something_else_is(mechanism):
    """Screws turn in inserts and in the flange, which are not drawn; they cut nothing printed."""
    boxes = {name: solid.bounding_box() for name, solid in mechanism.solids.items()}
    for a, b in combinations(mechanism.solids, 2):
        starts = np.maximum(tuple(boxes[a].min), tuple(boxes[b].min))
        apart = starts >= np.minimum(tuple(boxes[a].max), tuple(boxes[b].max))
        if apart.any():
            continue
        shared = overlap(mechanism.solids[a], mechanism.solids[b])
        # Ears and body of the encoder are drawn full where its own screws pass.
        allowed = a == "encoder" and b.startswith("screw encoder")
        assert allowed or shared < ROUNDING, (a, b, shared)


def test_each_bearing_has_its_seat_and_touches_with_its_own_ring(design, printed):
    block, b = printed["bearing_block"], design.bearing
    for start in (design.wall_end, design.block_end - b.width):
        assert overlap(block, parts.bearing(design, start)) < ROUNDING
    # A ring a tenth of a millimetre further in would be in the shoulder.
    inner = parts.bearing(design, design.wall_end + 0.1)
    assert overlap(block, inner) > 1.0
    assert design.bearing.shoulder <= 20.0  # SKF, Da max of a 608
    assert design.bearing.inner_shoulder < 12.1  # its inner ring


def test_the_pendulum_turns_free_of_the_holder(mechanism, design):
    """All that turns at more than the radius of the inner ring lies outside of the holder."""
    outside = parts.box((-200.0, 200.0), (-400.0, 400.0), (-400.0, 400.0))
    core = parts.cylinder(
        "X", design.bearing.inner_shoulder + 0.1, -200.0, 200.0, (0.0, design.pivot_down)
    )
    turning = [
        solid
        for name, solid in mechanism.solids.items()
        if name in ("hub", "rod", "outer collar") or name.startswith("screw hub")
    ]
    beyond = Compound(turning) & (outside - core)
    held = [
        solid
        for name, solid in mechanism.solids.items()
        if name not in ("hub", "rod", "spindle", "spacer")
        and "collar" not in name
        and not name.startswith("screw hub")
    ]
    fixed = Compound(held)
    assert beyond.bounding_box().min.X - fixed.bounding_box().max.X >= 1.5


# Screws and tools.


def test_the_screws_of_the_flange_engage_enough_and_not_too_much(design):
    screws = [s for s in parts.fasteners(design) if s.name.startswith("flange")]
    assert len(screws) == 4
    for screw in screws:
        assert design.flange.engagement_min <= -screw.tip <= design.flange.engagement_max


def test_other_screws_reach_their_threads(design):
    for screw in parts.fasteners(design):
        if screw.nut is not None:
            beyond = screw.sign * (screw.tip - screw.nut) - screw.screw.nut_height
            assert -0.1 <= beyond <= 4.0, screw.name
        elif not screw.name.startswith("flange"):
            if screw.axis == "-X":  # from outside into inserts at the wall's inner face
                engaged = design.wall_start + screw.screw.insert_length - screw.tip
                assert screw.tip >= design.wall_start
            else:
                engaged = screw.tip - design.wall_start
                assert engaged <= screw.screw.insert_length + 1.0
            assert engaged >= 1.2 * screw.screw.size, screw.name


ORDER = {
    # Bench: block with bearings on the wall, spindle with collar, plate, encoder; then hub.
    "block": ("base", "bearing_block", "inner bearing", "outer bearing"),
    "plate": ("base", "bearing_block", "encoder_plate", "spindle", "inner collar", "spacer"),
    "encoder": ("base", "bearing_block", "encoder_plate", "spindle", "inner collar"),
    "hub": ("base", "bearing_block", "encoder_plate", "encoder", "spindle", "hub"),
    "flange": ("base", "bearing_block", "encoder_plate", "encoder", "spindle", "hub", "rod"),
}
"""What is already there when a screw is turned."""


def test_keys_reach_every_screw(design, mechanism):
    for screw in parts.fasteners(design):
        # A short key, from the height of its head on; the plate's screws pass over the base.
        tool = screw.tool_space(25.0)
        for name in ORDER[screw.name.split()[0]]:
            blocked = overlap(tool, mechanism.solids[name])
            assert blocked < ROUNDING, (screw.name, name, blocked)


@pytest.mark.parametrize("name", ["base", "stand"])
def test_a_key_reaches_the_inner_collar_through_the_wall(name, design, printed):
    middle = design.wall_end - design.spacer - 0.5 * design.collar[1]
    end = 200.0 if name == "base" else -200.0
    key = parts.cylinder("Z", 2.3, design.pivot_down, end, (middle, 0.0))  # 2 mm across flats
    assert overlap(key, printed[name]) < ROUNDING
    assert M4.hole > 2.3


def test_base_and_stand_carry_bearings_and_encoder_in_the_same_way(design, printed):
    """The walls are equal around the spindle, but for the side of the key's hole."""
    z = design.pivot_down
    around = parts.box(
        (design.wall_start, design.wall_end), (-30.0, 30.0), (z - 17.0, z + 17.0)
    ) - parts.cylinder("Z", 6.0, z - 20, z + 20, (72.5, 0.0))
    base, stand = (printed[name] & around for name in ("base", "stand"))
    assert base.volume == pytest.approx(stand.volume, rel=1e-6)
    assert np.allclose(tuple(base.center()), tuple(stand.center()), atol=1e-6)


def test_the_rod_passes_the_table_in_front_of_the_stand(design, printed):
    edge = printed["stand"].bounding_box().max.X
    assert design.pivot_outward - 0.5 * design.rod - edge > 30.0


def test_the_encoder_has_enough_shaft_and_clears_the_web(design):
    assert design.encoder_face - design.spindle_start >= design.encoder.shaft_min
    assert design.pivot_down - 0.5 * design.encoder.height - design.plate >= 3.0
    # Its connector's plug, 15 mm, and a hand's space before the flange's screws.
    space = design.encoder_face - design.encoder.depth - 0.5 * design.plate_diameter
    assert space > 10.0
    assert design.half_width - design.rib - 0.5 * design.encoder.width > 2.0


def test_dowel_holes_stay_in_the_plate_and_off_the_screws(design, printed):
    places = parts.flange_places(design, design.flange.dowel_deg)
    screws = parts.flange_places(design, design.flange.screw_deg)
    for x, y in places:
        for a, b in screws:
            assert np.hypot(x - a, y - b) - 0.5 * 13.0 - 0.5 * design.flange.dowel > 1.6
    lowest = printed["base"].faces().sort_by(Axis.Z)[0]
    assert lowest.area > np.pi / 4.0 * (design.flange.outer**2 - 31.5**2) * 0.5
