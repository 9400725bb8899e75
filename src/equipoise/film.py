"""Pictures of the rig by MuJoCo's renderer, and films of a run as MP4 or animated WebP.

The scene is that of `equipoise.arm.scene`, slimmer and coloured, with the designed mechanism
(hardware/) in place of the bracket, the ends of the track as two posts and the displacement marked
on a rail between them. The camera stands behind the base,
so that +x is to the right as in every figure. `MUJOCO_GL` selects EGL (default without a display),
OSMesa or GLFW.
"""

import io
import json
import os
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.arm.arm import Arm
from equipoise.arm.scene import Sizes, scene
from equipoise.arrays import Array
from equipoise.errors import InputError, OutsideError, import_optional
from equipoise.files import write_atomically
from equipoise.jit import PACKAGE
from equipoise.log.motion import Motion
from equipoise.log.run_log import RunLog
from equipoise.paper import X_LIMIT
from equipoise.physics_engine import mujoco

Picture = npt.NDArray[np.uint8]
"""Red, green and blue of every pixel, rows from the top, shape (height, width, 3)."""

AZIMUTH_DEG: Final = 42.0
"""Direction of view [deg]; 90 is along base +y, where the arm would hide the pendulum."""
ELEVATION_DEG: Final = -22.0
"""Elevation of the direction of view above the horizon [deg]."""
FOV_DEG: Final = 20.0
"""Vertical field of view [deg]; narrow, so that vertical edges look vertical."""
SLIM: Final = Sizes(
    link=0.066, pulled_in=0.0, housing=0.078, housing_reach=0.016, hand=0.05, rod=0.011
)
"""Approximate sizes of the iiwas; the sizes of the collision model are larger on purpose."""
COLOURS: Final = {
    "link": (0.93, 0.93, 0.94, 1.0),
    "housing": (0.83, 0.84, 0.86, 1.0),
    "cap": (0.94, 0.54, 0.14, 1.0),
    "bracket": (0.23, 0.25, 0.27, 1.0),
    "rod": (0.0, 0.45, 0.70, 1.0),
    "table": (0.86, 0.79, 0.66, 1.0),
    "post": (0.84, 0.37, 0.0, 1.0),
    "floor": (0.92, 0.93, 0.94, 1.0),
}
"""Red, green, blue and opacity of the shapes, by the first word of their names."""
ARROW: Final = (0.0, 0.62, 0.45, 1.0)
"""Colour of the arrow that shows u."""
ARROW_PER_U: Final = 0.1
"""Length of the arrow for an acceleration of 1 m/s^2 [m]."""
ARROW_BELOW: Final = 0.13
"""Distance of the arrow below the pivot [m]; the hand never covers it."""
MP4, WEBP = ".mp4", ".webp"
FORMATS: Final = {MP4: (960, 720, 30.0), WEBP: (480, 480, 12.5)}
"""Width and height of a film [px], and frames per second, by its suffix."""
MAX_WEBP: Final = 30.0
"""Maximum length of an animated WebP [s]; the encoder holds all frames in memory."""


class RigScene(NamedTuple):
    """Scene of an arm with its pendulum."""

    model: Any
    """A `mujoco.MjModel`; its positions are all joints of the arm, then phi."""
    pivot: Array
    """Pivot of the pendulum at home, in the base frame [m], shape (3,)."""
    posts: Array
    """Upper ends of the posts at -X_LIMIT and X_LIMIT [m], shape (2, 3)."""
    target: Array
    """Point at which the camera looks [m], shape (3,)."""
    view: Array
    """Points that stay in view, from the target, to the right, upwards and ahead [m], (n, 3)."""

    def distance(self, aspect: float) -> float:
        """Return the distance of the camera from its target [m] for a picture's width / height."""
        tangent = np.tan(np.radians(0.5 * FOV_DEG))
        right, up = np.abs(self.view[:, :2].T) + 0.13  # margin around the joints [m]
        needed = np.maximum(right / aspect, up) / tangent - self.view[:, 2]
        return float(np.max(needed))


def camera_axes() -> Array:
    """Return the unit vectors to the right, upwards and ahead of the camera, shape (3, 3)."""
    azimuth, elevation = np.radians([AZIMUTH_DEG, ELEVATION_DEG])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    ahead = np.cos(elevation) * level + np.array([0.0, 0.0, np.sin(elevation)])
    return np.array([right, np.cross(right, ahead), ahead])


def build_scene(arm: Arm) -> RigScene:
    """Build the scene of an arm."""
    mj, spec = mujoco(), scene(arm, SLIM)
    model = spec.compile()
    data = mj.MjData(model)
    mj.mj_resetDataKeyframe(model, data, model.key("home").id)
    mj.mj_kinematics(model, data)
    places = np.array(data.xpos)
    pivot = places[-1]

    def cylinder(body: Any, name: str, start: Any, end: Any, radius: float) -> None:
        size, kind = [radius, 0.0, 0.0], mj.mjtGeom.mjGEOM_CYLINDER
        body.add_geom(name=name, type=kind, fromto=[*start, *end], size=size)

    for housing in [geom for geom in spec.geoms if geom.name.startswith("housing")]:
        start, end = np.array(housing.fromto[:3]), np.array(housing.fromto[3:])
        radius = float(housing.size[0])
        out = 0.87 * radius * (end - start) / np.linalg.norm(end - start)
        cylinder(housing.parent, f"cap of {housing.name}", start - out, end + out, 0.7 * radius)
    _add_mechanism(spec, arm, places[-2] - pivot)
    table, world = spec.geom("table"), spec.worldbody
    table.size = [*(0.5 * np.abs(pivot[:2]) + [0.42, 0.27]), 0.35]
    table.pos = [*(0.5 * pivot[:2]), -0.35]
    feet = np.array([[pivot[0] + x, pivot[1], 0.0] for x in (-X_LIMIT, X_LIMIT)])
    tops = feet + np.array([0.0, 0.0, pivot[2] + 0.28])  # the pendulum is 0.21 m long
    for side, foot, top in zip(("left", "right"), feet, tops, strict=True):
        cylinder(world, f"post {side}", foot, top, 0.005)
    cylinder(world, "post rail", feet[0], feet[1], 0.003)
    for x in (-0.2, -0.1, 0.0, 0.1, 0.2):
        low, high = ((pivot[0] + x, pivot[1] + y, 0.0) for y in (-0.012, 0.012))
        cylinder(world, f"post {x:g}", low, high, 0.003)
    plane = mj.mjtGeom.mjGEOM_PLANE
    world.add_geom(name="floor", type=plane, size=[3.0, 3.0, 1.0], pos=[0.0, 0.0, -0.7])
    for geom in spec.geoms:
        geom.rgba = next(rgba for name, rgba in COLOURS.items() if geom.name.startswith(name))
    sun = mj.mjtLightType.mjLIGHT_DIRECTIONAL
    world.add_light(
        type=sun, pos=[*pivot[:2], 3.0], dir=[0.0, 0.0, -1.0], diffuse=[0.5] * 3, castshadow=True
    )
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.45] * 3, [0.35] * 3
    spec.visual.global_.fovy = FOV_DEG
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1920, 1080
    spec.visual.quality.offsamples, spec.visual.quality.shadowsize = 4, 2048
    texture = {"type": mj.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mj.mjtBuiltin.mjBUILTIN_GRADIENT}
    spec.add_texture(name="sky", rgb1=[1, 1, 1], rgb2=[0.92, 0.93, 0.94], width=64, **texture)
    hands = [places[-3:] + np.array([x, 0.0, 0.0]) for x in (-X_LIMIT, X_LIMIT)]
    points = np.concatenate([places, *hands, feet, tops]) @ camera_axes().T
    low, high = points.min(axis=0) - 0.1, points.max(axis=0) + 0.1
    centre = 0.5 * (low + high)
    return RigScene(spec.compile(), pivot, tops, camera_axes().T @ centre, points - centre)


def _add_mechanism(spec: Any, arm: Arm, inward: Array) -> None:
    """Replace the bracket of a scene by the designed mechanism, where the pivot is as far outside.

    Args:
        spec: The scene; changed in place.
        arm: The arm.
        inward: Vector from the pivot to the flange at home, in base axes [m], shape (3,).
    """
    # Boxes and cylinders [m]; `make hardware` writes them.
    drawn = json.loads((PACKAGE / "data" / "mechanism.json").read_text())
    x, y, z = arm.pivot
    outward, _, height = drawn["pivot"]
    if abs(np.hypot(x, y) - outward) > 1e-3:
        return
    mj = mujoco()
    spec.delete(spec.geom("bracket"))
    hand = [geom for geom in spec.geoms if geom.name.startswith("link")][-1]
    hand.type = mj.mjtGeom.mjGEOM_CYLINDER  # flat at the flange, on which the mechanism sits
    # Frames of the parts: X outward, Z out of the flange, or along the rod.
    yaw = {"flange": np.arctan2(y, x), "pendulum": np.arctan2(-inward[1], -inward[0])}
    origin = {"flange": [0.0, 0.0, z - height], "pendulum": np.zeros(3)}
    for number, shape in enumerate(drawn["shapes"]):
        (start, end), name = np.array(shape["ends"]), shape["body"]
        quat = [np.cos(0.5 * yaw[name]), 0.0, 0.0, np.sin(0.5 * yaw[name])]
        geom = spec.body(name).add_geom(name=f"bracket {number}")
        geom.set_frame(spec.body(name).add_frame(pos=origin[name], quat=quat))
        if shape["kind"] == "cylinder":
            geom.type, geom.size = mj.mjtGeom.mjGEOM_CYLINDER, [shape["radius"], 0.0, 0.0]
            geom.fromto = [*start, *end]
        else:
            geom.type, geom.size = mj.mjtGeom.mjGEOM_BOX, 0.5 * np.abs(end - start)
            geom.pos = 0.5 * (start + end)


class RigRenderer:
    """Off-screen renderer of the rig of one arm."""

    def __init__(self, arm: Arm, width: int, height: int) -> None:
        """Open an OpenGL context.

        Args:
            arm: The arm.
            width: Width of the pictures [px].
            height: Height of the pictures [px].

        Raises:
            OutsideError: OpenGL is not available.
        """
        mj, rig = mujoco(), build_scene(arm)
        self._data, self._camera = mj.MjData(rig.model), mj.MjvCamera()
        self._camera.lookat, self._camera.distance = rig.target, rig.distance(width / height)
        self._camera.azimuth, self._camera.elevation = AZIMUTH_DEG, ELEVATION_DEG
        try:
            self._renderer: Any = mj.Renderer(rig.model, height, width)
        except Exception as error:  # each backend and driver fails in its own way
            chosen = os.environ.get("MUJOCO_GL", "")
            raise OutsideError(
                f"cannot draw pictures with MUJOCO_GL={chosen!r}: {error}; install EGL (Debian and "
                "Ubuntu: libegl1 and libgl1), or set MUJOCO_GL to egl, osmesa, or, with "
                "a display, glfw"
            ) from None

    def draw(self, q: Array, phi: float, u: float = 0.0) -> Picture:
        """Return a picture of a posture.

        Args:
            q: All joints [rad], shape (joints,).
            phi: Angle of the pendulum from upright [rad]; it hangs for NaN.
            u: Commanded acceleration, shown as an arrow below the pivot unless zero [m/s^2].
        """
        mj, data = mujoco(), self._data
        data.qpos[:] = [*q, phi if np.isfinite(phi) else np.pi]
        mj.mj_kinematics(self._renderer.model, data)
        mj.mj_camlight(self._renderer.model, data)
        self._renderer.update_scene(data, self._camera)
        if u:
            start = data.body("pendulum").xpos - np.array([0.0, 0.0, ARROW_BELOW])
            shapes, kind = self._renderer.scene, mj.mjtGeom.mjGEOM_ARROW
            arrow = shapes.geoms[shapes.ngeom]
            colour = np.array(ARROW, np.float32)
            mj.mjv_initGeom(arrow, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), colour)
            # MuJoCo draws an arrow at half the given length.
            end = start + np.array([2.0 * ARROW_PER_U * u, 0.0, 0.0])
            mj.mjv_connector(arrow, kind, 0.012, start, end)
            shapes.ngeom += 1
        return self._renderer.render()

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()


def film_format(path: Path) -> str:
    """Return the suffix of a film, in lower case, once its encoder is found.

    Raises:
        InputError: The suffix is unknown.
        MissingExtraError: An MP4 needs imageio-ffmpeg, which is not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"a film ends in {' or '.join(FORMATS)}, got {suffix!r}; rename it")
    for package in ("imageio", "imageio_ffmpeg") if suffix == MP4 else ():
        import_optional(package, "video")
    return suffix


def write_film(
    run: RunLog, path: Path, begin: float | None = None, end: float | None = None
) -> None:
    """Write a part of a run as a film in real time, with its numbers below the picture.

    Args:
        run: The run.
        path: The file, `.mp4` (H.264) or `.webp` (animated), written atomically.
        begin: Start since the release [s]; by default the release, on a rig shortly before it.
        end: End since the release [s]; by default that of the run.

    Raises:
        InputError: The suffix is unknown, the part is outside the run, or too long for a WebP.
        MissingExtraError: An MP4 needs imageio-ffmpeg, which is not installed.
        RecordingError: The run has nothing to show.
        OutsideError: OpenGL is not available, or encoding or writing fails.
    """
    suffix, motion = film_format(path), Motion.of(run)
    begin, end = motion.part(begin, end)
    if suffix == WEBP and end - begin > MAX_WEBP:
        raise InputError(
            f"an animated WebP of {end - begin:g} s is too large, expected {MAX_WEBP:g} s or less; "
            "choose a shorter part, or an MP4"
        )
    (width, height, rate), film = FORMATS[suffix], io.BytesIO()
    times = begin + np.arange(max(1, round((end - begin) * rate))) / rate
    bar = height // 10  # for numbers
    with closing(RigRenderer(run.conditions.arm, width, height - bar)) as renderer:
        frames: Any = _frames(run, motion, times, renderer, bar)
        if suffix == WEBP:
            first, *others = frames
            options: Any = {"append_images": others, "duration": round(1e3 / rate), "loop": 0}
            first.save(film, "webp", save_all=True, quality=60, method=4, **options)
        else:
            from imageio.v3 import imwrite

            options = {"plugin": "FFMPEG", "fps": rate, "quality": 7, "is_batch": True}
            try:
                imwrite(film, frames, extension=MP4, **options)
            except (OSError, RuntimeError) as error:
                raise OutsideError(f"cannot write {path}, the encoder failed: {error}") from None
    write_atomically(path, film.getvalue())


def _frames(
    run: RunLog, motion: Motion, times: Array, renderer: RigRenderer, bar: int
) -> Iterator[Any]:
    """Yield the pictures of a run at times [s] as PIL images.

    Args:
        run: The run.
        motion: Its motion.
        times: Times since the release [s].
        renderer: Renderer of its arm.
        bar: Height of two lines of numbers below each picture [px].
    """
    from matplotlib import get_data_path
    from PIL import Image, ImageDraw, ImageFont

    conditions = run.conditions
    font = Path(get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")
    large, small = (ImageFont.truetype(font, fraction * bar) for fraction in (0.3, 0.27))
    for time in times.tolist():
        pose = motion.at(time)
        picture = renderer.draw(pose.q, pose.phi, pose.u)
        height, width, _ = picture.shape
        image = Image.new("RGB", (width, height + bar), "white")
        image.paste(Image.fromarray(picture))
        pen = ImageDraw.Draw(image)
        phi = f"{np.degrees(pose.phi):+.1f}°" if np.isfinite(pose.phi) else "unknown"
        text = f"t = {time:.2f} s   x = {pose.x:+.3f} m   φ = {phi}   u = {pose.u:+.1f} m/s²"
        pen.text((0.03 * width, height + 0.28 * bar), text, "#222222", large, "lm")
        note = " · ".join(filter(None, (conditions.arm.name, conditions.world, pose.phase)))
        pen.text((0.03 * width, height + 0.73 * bar), note, "#767676", small, "lm")
        yield image
