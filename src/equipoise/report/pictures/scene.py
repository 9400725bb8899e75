"""What is in the picture: the rig of `equipoise.model.arms.scene`, dressed to be recognised.

The scene is drawn slimmer than it is measured, with caps on its joints and seams on its links.
Added are the ends of the track as two posts in the pendulum's plane, a rail with marks between
their feet, the upright as a thin line at the pivot, a table with edges and legs, a floor, light,
and a camera.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.model.arms.arm import Arm
from equipoise.model.arms.scene import Sizes, scene, sizes_for
from equipoise.model.physics_engine import mujoco
from equipoise.paper import X_LIMIT
from equipoise.report.pictures.camera import FOV_DEG, Camera, Size, camera_that_sees
from equipoise.report.style import BLUE, INK, VERMILION

Floats = npt.NDArray[np.float64]

SLIM: Final = Sizes(
    link=0.066, pulled_in=0.0, housing=0.078, housing_reach=0.016, hand=0.05, rod=0.011
)
"""Near the sizes of the iiwas, which the scene exceeds on purpose."""
UPRIGHT: Final = 0.28
"""Length of the line that shows the upright [m]."""
POST_ABOVE: Final = UPRIGHT
"""Height of the posts above the pivot [m]: the whole pendulum is seen against them."""
MARKS: Final = (-0.2, -0.1, 0.0, 0.1, 0.2)
"""Displacements that are marked on the rail [m]."""
MARK: Final = 0.012
"""Half the length of a mark [m]."""
FOOT: Final = 0.02
"""Radius of their feet [m]."""
BASE: Final = 0.095
"""Radius of the arm's foot [m]."""
TABLE_BEYOND: Final = 0.09
"""By how much the table is larger than what stands on it [m]."""
TABLE_TOP: Final = 0.04
"""Thickness of the table's top [m]."""
LEG: Final = 0.7
"""Height of its legs [m]."""
MARGIN: Final = 0.01
"""Kept free around what must be seen [m]."""
SAMPLES: Final = 4
"""Samples per pixel; they smooth edges."""
TILE: Final = 0.5
"""Width of two tiles of the floor [m]."""
CAMERA: Final = "behind"
"""Name of the only camera."""


class _Material(NamedTuple):
    colour: str
    shine: float


MATERIALS: Final = {
    "shell": _Material("#eceef0", 0.5),
    "joint": _Material("#d3d7db", 0.5),
    "cap": _Material("#f08a24", 0.3),
    "dark": _Material("#3a3f45", 0.4),
    "table": _Material("#dcc9a8", 0.1),
    "pendulum": _Material(BLUE, 0.4),
    "post": _Material(VERMILION, 0.1),
    "upright": _Material(INK, 0.0),
}
SCENE_MATERIALS: Final = {
    "link": "shell",
    "housing": "joint",
    "bracket": "dark",
    "rod": "pendulum",
    "table": "table",
}
"""Materials of the scene's own geometry, by how its names begin."""
FLOOR: Final = (0.92, 0.93, 0.94), (0.895, 0.905, 0.915)
"""Colours of its tiles."""


LABEL: Final = np.array([0.0, -0.11, 0.0])
"""From the foot of a post to its label, on the table [m]."""


class Post(NamedTuple):
    """An end of the track."""

    x: float
    """Displacement of the flange [m]; the pendulum's pivot is at the post there."""
    foot: Floats
    """Where it stands on the table, in the base [m], shape (3,)."""
    top: Floats
    """Where it ends [m], shape (3,)."""


class PictureScene(NamedTuple):
    """A scene that is ready to be drawn."""

    model: Any
    """A `mujoco.MjModel`; its positions are all joints of the arm, then phi."""
    camera: Camera
    """What its only camera sees."""
    posts: tuple[Post, ...]
    """The ends of the track."""

    def labels(self) -> list[tuple[str, tuple[float, float]]]:
        """Return the displacement at each post, and where in the picture its text is centred."""
        return [
            (f"{post.x:+g} m".replace("-", "\N{MINUS SIGN}"), self.camera.pixel(post.foot + LABEL))
            for post in self.posts
        ]


def stage(arm: Arm, size: Size) -> PictureScene:
    """Dress the scene of an arm, and place a camera so that the rig fills the picture.

    Args:
        arm: The arm.
        size: Of the picture.
    """
    slim = sizes_for(arm, SLIM)
    spec = scene(arm, sizes=slim)
    table = spec.geom("table")
    surface = float(table.pos[2] + table.size[2])
    places = _places_at_home(spec)
    x, y, z = places[-1]  # of the pivot
    posts = tuple(
        Post(end, np.array([x + end, y, surface]), np.array([x + end, y, z + POST_ABOVE]))
        for end in (-X_LIMIT, X_LIMIT)
    )
    _dress(spec, slim)
    _furnish(spec, table, surface, posts)
    _light(spec)
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


def _dress(spec: Any, slim: Sizes) -> None:
    """Give the scene its colours, and add what makes an arm of its capsules."""
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
        for centre, out in ((start, -along), (end, along)):  # its round end shows inside the cap
            cap = centre + 0.5 * slim.housing * out, centre + 0.87 * slim.housing * out
            _add_cylinder(housing.parent, "cap", *cap, 0.67 * slim.housing)
    base, hand = parts["link"][0], parts["link"][-1]
    for link in (base, hand):  # flat on the table, and flat at the flange
        link.type = mujoco().mjtGeom.mjGEOM_CYLINDER
    start, _, along = _axis(base)
    _add_cylinder(base.parent, "shell", start, start + 0.03 * along, BASE)
    _, end, along = _axis(hand)
    _add_cylinder(hand.parent, "dark", end - 0.012 * along, end + 0.004 * along, 0.042)
    pendulum = parts["rod"][0].parent
    spindle = np.array([0.0, 0.02, 0.0])
    _add_cylinder(pendulum, "dark", -spindle, spindle, 0.02)
    upright = pendulum.parent.add_body(pos=pendulum.pos, quat=pendulum.quat)
    low, high = (np.array([0.0, slim.rod, z]) for z in (0.0, UPRIGHT))  # before the pendulum
    _add_cylinder(upright, "upright", low, high, 0.0015)


def _furnish(spec: Any, table: Any, surface: float, posts: tuple[Post, ...]) -> None:
    """Make a table of the scene's plate, and put the posts on it."""
    world, down = spec.worldbody, np.array([0.0, 0.0, -1.0])
    feet = np.array([post.foot[:2] for post in posts])
    low = np.minimum(feet.min(axis=0) - FOOT, -BASE) - TABLE_BEYOND
    high = np.maximum(feet.max(axis=0) + FOOT, BASE) + TABLE_BEYOND
    table.size = [*(0.5 * (high - low)), 0.5 * TABLE_TOP]
    table.pos = [*(0.5 * (high + low)), surface - 0.5 * TABLE_TOP]
    for x in (low[0] + 0.04, high[0] - 0.04):
        for y in (low[1] + 0.04, high[1] - 0.04):
            head = np.array([x, y, surface - TABLE_TOP])
            _add_cylinder(world, "table", head, head + LEG * down, 0.025)
    ground = spec.add_material(name="floor", texrepeat=[1.0 / TILE] * 2, texuniform=True)
    spec.add_texture(
        name="tiles",
        type=mujoco().mjtTexture.mjTEXTURE_2D,
        builtin=mujoco().mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=FLOOR[0],
        rgb2=FLOOR[1],
        width=64,
        height=64,
    )
    ground.textures[mujoco().mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    world.add_geom(
        type=mujoco().mjtGeom.mjGEOM_PLANE,
        size=[0.0, 0.0, 1.0],  # without an end
        pos=[0.0, 0.0, surface - TABLE_TOP - LEG],
        material="floor",
    )
    for post in posts:
        _add_cylinder(world, "post", post.foot, post.top, 0.005)
        _add_cylinder(world, "post", post.foot, post.foot - 0.004 * down, FOOT)
    rail = posts[0].foot, posts[-1].foot
    _add_cylinder(world, "post", *rail, 0.003)
    for x in MARKS:
        middle = 0.5 * (rail[0] + rail[1]) + np.array([x, 0.0, 0.0])
        across = np.array([0.0, MARK, 0.0])
        _add_cylinder(world, "post", middle - across, middle + across, 0.003)


def _light(spec: Any) -> None:
    """Light the scene softly from above the camera; shadows are drawn by `rendering`."""
    mj = mujoco()
    spec.worldbody.add_light(
        type=mj.mjtLightType.mjLIGHT_DIRECTIONAL,
        dir=[0.6, 0.5, -1.0],
        diffuse=[0.45] * 3,
        specular=[0.15] * 3,
        castshadow=False,
    )
    head = spec.visual.headlight
    head.ambient, head.diffuse, head.specular = [0.45] * 3, [0.35] * 3, [0.05] * 3


def _place_camera(
    spec: Any, places: Floats, posts: tuple[Post, ...], size: Size, slim: Sizes
) -> Camera:
    """Add a camera that sees the arm at home, the posts, and the hand with its pendulum at each."""
    ends = np.array([end for post in posts for end in (post.foot, post.top)])
    along = [np.array([post.x, 0.0, 0.0]) for post in posts]
    hands = np.vstack([places[-3:] + x for x in along])  # last joint, flange, pivot
    points = np.vstack([places, hands, ends])
    joint = slim.housing + slim.housing_reach
    radii = np.repeat([joint, FOOT], [len(places) + len(hands), len(ends)]) + MARGIN
    camera = camera_that_sees(points, radii, size)
    quaternion = np.zeros(4)
    back = np.cross(camera.right, camera.up)
    axes = np.column_stack([camera.right, camera.up, back])
    mujoco().mju_mat2Quat(quaternion, axes.ravel())
    spec.worldbody.add_camera(name=CAMERA, pos=camera.position, quat=quaternion, fovy=FOV_DEG)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = size
    spec.visual.quality.offsamples = SAMPLES
    return camera


def _axis(geom: Any) -> tuple[Floats, Floats, Floats]:
    """Return where the axis of a capsule or cylinder starts and ends, and its direction."""
    start, end = np.array(geom.fromto[:3]), np.array(geom.fromto[3:])
    return start, end, (end - start) / np.linalg.norm(end - start)


def _add_cylinder(body: Any, material: str, start: Floats, end: Floats, radius: float) -> None:
    body.add_geom(
        type=mujoco().mjtGeom.mjGEOM_CYLINDER,
        fromto=[*start, *end],
        size=[radius, 0.0, 0.0],
        material=material,
    )
