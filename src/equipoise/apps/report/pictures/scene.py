"""Scene of the pictures: the rig of `equipoise.model.arms.scene` with a recognisable appearance.

The arm is slimmer than its collision model, with caps on its joints and seams on its links. Added
are the ends of the track as two posts in the pendulum's plane, a rail with marks between their
feet, the upright as a thin line at the pivot, a table with edges and legs, a floor, light, and a
camera.
"""

from itertools import product
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.apps.report.pictures.camera import FOV_DEG, Camera, Size, nearest_camera
from equipoise.apps.report.style import BLUE, INK, VERMILION, typeset
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.scene import Sizes, scene, sizes_for
from equipoise.model.physics_engine import mujoco
from equipoise.paper import X_LIMIT

Floats = npt.NDArray[np.float64]

SLIM: Final = Sizes(
    link=0.066, pulled_in=0.0, housing=0.078, housing_reach=0.016, hand=0.05, rod=0.011
)
"""Approximate sizes of the iiwas; the sizes of the collision model are larger on purpose."""
UPRIGHT: Final = 0.28
"""Length of the line that shows the upright, and height of the posts above the pivot [m]."""
MARKS: Final = (-0.2, -0.1, 0.0, 0.1, 0.2)
"""Displacements that are marked on the rail [m]."""
MARK_HALF_LENGTH: Final = 0.012
"""Half the length of a mark [m]."""
FOOT_RADIUS: Final = 0.02
"""Radius of a post's foot [m]."""
BASE_RADIUS: Final = 0.095
"""Radius of the arm's foot [m]."""
TABLE_BORDER: Final = 0.09
"""Width of the table's border around the arm and the posts [m]."""
TABLE_TOP: Final = 0.04
"""Thickness of the table's top [m]."""
LEG: Final = 0.7
"""Height of the table's legs [m]."""
MARGIN: Final = 0.01
"""Margin of the view around the rig [m]."""
SAMPLES: Final = 4
"""Number of samples per pixel, for anti-aliasing."""
TILE: Final = 0.5
"""Width of two tiles of the floor [m]."""
CAMERA: Final = "behind"
"""Name of the camera."""


MATERIALS: Final = {
    "shell": ("#eceef0", 0.5),
    "joint": ("#d3d7db", 0.5),
    "cap": ("#f08a24", 0.3),
    "dark": ("#3a3f45", 0.4),
    "table": ("#dcc9a8", 0.1),
    "pendulum": (BLUE, 0.4),
    "post": (VERMILION, 0.1),
    "upright": (INK, 0.0),
}
"""Colour, and specular reflectance and shininess, of each material."""
SCENE_MATERIALS: Final = {
    "link": "shell",
    "housing": "joint",
    "bracket": "dark",
    "rod": "pendulum",
    "table": "table",
}
"""Materials of the scene's own geometry, by the prefix of its names."""
FLOOR: Final = (0.92, 0.93, 0.94), (0.895, 0.905, 0.915)
"""RGB colours of the floor tiles."""
LABEL: Final = np.array([0.0, -0.11, 0.0])
"""Offset from the foot of a post to its label on the table [m]."""


class Post(NamedTuple):
    """An end of the track."""

    x: float
    """Displacement of the flange with the pivot at the post [m]."""
    foot: Floats
    """Lower end on the table, in the base frame [m], shape (3,)."""
    top: Floats
    """Upper end [m], shape (3,)."""


class PictureScene(NamedTuple):
    """A compiled scene with its camera."""

    model: Any
    """A `mujoco.MjModel`; its positions are all joints of the arm, then phi."""
    camera: Camera
    """The camera."""
    posts: tuple[Post, ...]
    """The ends of the track."""

    def labels(self) -> list[tuple[str, tuple[float, float]]]:
        """Return the label of each post, and the position of its centre in the picture [px]."""
        places = [self.camera.pixel(post.foot + LABEL) for post in self.posts]
        return [(typeset(f"{p.x:+g} m"), at) for p, at in zip(self.posts, places, strict=True)]


def stage(arm: Arm, size: Size) -> PictureScene:
    """Build the scene of an arm, with a camera close enough that the rig fills the picture.

    Args:
        arm: The arm.
        size: Size of the picture.
    """
    slim = sizes_for(arm, SLIM)
    spec = scene(arm, sizes=slim)
    table = spec.geom("table")
    surface = float(table.pos[2] + table.size[2])
    places = _places_at_home(spec)
    x, y, z = places[-1]  # of the pivot
    posts = tuple(
        Post(end, np.array([x + end, y, surface]), np.array([x + end, y, z + UPRIGHT]))
        for end in (-X_LIMIT, X_LIMIT)
    )
    _decorate_arm(spec, slim)
    _add_table(spec, table, surface, posts)
    _add_light(spec)
    camera = _place_camera(spec, places, posts, size, slim)
    return PictureScene(spec.compile(), camera, posts)


def _places_at_home(spec: Any) -> Floats:
    """Return the origins of all bodies, from the base to the pendulum [m], shape (bodies, 3)."""
    mj = mujoco()
    model = spec.compile()
    data = mj.MjData(model)
    mj.mj_resetDataKeyframe(model, data, model.key("home").id)
    mj.mj_kinematics(model, data)
    return np.array(data.xpos)


def _decorate_arm(spec: Any, slim: Sizes) -> None:
    """Set the materials of the scene, and add caps, seams, foot, flange and spindle."""
    from matplotlib.colors import to_rgba

    for name, (colour, shine) in MATERIALS.items():
        spec.add_material(name=name, rgba=to_rgba(colour), specular=shine, shininess=shine)
    parts = {name: [g for g in spec.geoms if g.name.startswith(name)] for name in SCENE_MATERIALS}
    for name, geoms in parts.items():
        for geom in geoms:
            geom.material = SCENE_MATERIALS[name]
    for link in parts["link"]:
        start, end, along = _axis(link)
        middle = 0.5 * (start + end)
        seam = middle - 0.004 * along, middle + 0.004 * along
        _add_cylinder(link.parent, "dark", *seam, link.size[0] + 0.001)
    for housing in parts["housing"]:
        start, end, along = _axis(housing)
        for centre, out in ((start, -along), (end, along)):  # the round end fills the cap
            cap = centre + 0.5 * slim.housing * out, centre + 0.87 * slim.housing * out
            _add_cylinder(housing.parent, "cap", *cap, 0.67 * slim.housing)
    base, hand = parts["link"][0], parts["link"][-1]
    for link in (base, hand):  # flat ends on the table and at the flange
        link.type = mujoco().mjtGeom.mjGEOM_CYLINDER
    start, _, along = _axis(base)
    _add_cylinder(base.parent, "shell", start, start + 0.03 * along, BASE_RADIUS)
    _, end, along = _axis(hand)
    _add_cylinder(hand.parent, "dark", end - 0.012 * along, end + 0.004 * along, 0.042)
    pendulum = parts["rod"][0].parent
    spindle = np.array([0.0, 0.02, 0.0])
    _add_cylinder(pendulum, "dark", -spindle, spindle, 0.02)
    upright = pendulum.parent.add_body(pos=pendulum.pos, quat=pendulum.quat)
    low, high = (np.array([0.0, slim.rod, z]) for z in (0.0, UPRIGHT))  # in front of the pendulum
    _add_cylinder(upright, "upright", low, high, 0.0015)


def _add_table(spec: Any, table: Any, surface: float, posts: tuple[Post, ...]) -> None:
    """Extend the scene's plate to a table on a floor, with the posts and the rail."""
    world, down = spec.worldbody, np.array([0.0, 0.0, -1.0])
    feet = np.array([post.foot[:2] for post in posts])
    low = np.minimum(feet.min(axis=0) - FOOT_RADIUS, -BASE_RADIUS) - TABLE_BORDER
    high = np.maximum(feet.max(axis=0) + FOOT_RADIUS, BASE_RADIUS) + TABLE_BORDER
    table.size = [*(0.5 * (high - low)), 0.5 * TABLE_TOP]
    table.pos = [*(0.5 * (high + low)), surface - 0.5 * TABLE_TOP]
    for x, y in product((low[0] + 0.04, high[0] - 0.04), (low[1] + 0.04, high[1] - 0.04)):
        head = np.array([x, y, surface - TABLE_TOP])
        _add_cylinder(world, "table", head, head + LEG * down, 0.025)
    mj, infinite, depth = mujoco(), [0.0, 0.0, 1.0], surface - TABLE_TOP - LEG
    ground = spec.add_material(name="floor", texrepeat=[1.0 / TILE] * 2, texuniform=True)
    kinds = {"type": mj.mjtTexture.mjTEXTURE_2D, "builtin": mj.mjtBuiltin.mjBUILTIN_CHECKER}
    spec.add_texture(name="tiles", rgb1=FLOOR[0], rgb2=FLOOR[1], width=64, height=64, **kinds)
    ground.textures[mj.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    plane = {"type": mj.mjtGeom.mjGEOM_PLANE, "material": "floor"}
    world.add_geom(size=infinite, pos=[0.0, 0.0, depth], **plane)
    for post in posts:
        _add_cylinder(world, "post", post.foot, post.top, 0.005)
        _add_cylinder(world, "post", post.foot, post.foot - 0.004 * down, FOOT_RADIUS)
    rail = posts[0].foot, posts[-1].foot
    _add_cylinder(world, "post", *rail, 0.003)
    for x in MARKS:
        middle = 0.5 * (rail[0] + rail[1]) + np.array([x, 0.0, 0.0])
        across = np.array([0.0, MARK_HALF_LENGTH, 0.0])
        _add_cylinder(world, "post", middle - across, middle + across, 0.003)


def _add_light(spec: Any) -> None:
    """Add soft light from above the camera; `rendering` draws the shadows."""
    kind = {"type": mujoco().mjtLightType.mjLIGHT_DIRECTIONAL, "castshadow": False}
    colours = {"diffuse": [0.45] * 3, "specular": [0.15] * 3}
    spec.worldbody.add_light(dir=[0.6, 0.5, -1.0], **kind, **colours)
    head = spec.visual.headlight
    head.ambient, head.diffuse, head.specular = [0.45] * 3, [0.35] * 3, [0.05] * 3


def _place_camera(
    spec: Any, places: Floats, posts: tuple[Post, ...], size: Size, slim: Sizes
) -> Camera:
    """Add a camera with the arm at home, the posts, and the hand at each post in view."""
    ends = np.array([end for post in posts for end in (post.foot, post.top)])
    along = [np.array([post.x, 0.0, 0.0]) for post in posts]
    hands = np.vstack([places[-3:] + x for x in along])  # last joint, flange, pivot
    points = np.vstack([places, hands, ends])
    joint = slim.housing + slim.housing_reach
    radii = np.repeat([joint, FOOT_RADIUS], [len(places) + len(hands), len(ends)]) + MARGIN
    camera = nearest_camera(points, radii, size)
    quaternion = np.zeros(4)
    back = np.cross(camera.right, camera.up)
    axes = np.column_stack([camera.right, camera.up, back])
    mujoco().mju_mat2Quat(quaternion, axes.ravel())
    spec.worldbody.add_camera(name=CAMERA, pos=camera.position, quat=quaternion, fovy=FOV_DEG)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = size
    spec.visual.quality.offsamples = SAMPLES
    return camera


def _axis(geom: Any) -> tuple[Floats, Floats, Floats]:
    """Return start, end and direction of the axis of a capsule or cylinder."""
    start, end = np.array(geom.fromto[:3]), np.array(geom.fromto[3:])
    return start, end, (end - start) / np.linalg.norm(end - start)


def _add_cylinder(body: Any, material: str, start: Floats, end: Floats, radius: float) -> None:
    kind, size = mujoco().mjtGeom.mjGEOM_CYLINDER, [radius, 0.0, 0.0]
    body.add_geom(type=kind, fromto=[*start, *end], size=size, material=material)
