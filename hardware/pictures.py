"""Pictures of the parts and of the assembly, drawn by MuJoCo from the solids' triangles."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import mujoco
import numpy as np
from build123d import Axis, Part, Solid
from matplotlib import get_data_path
from PIL import Image, ImageDraw, ImageFont

PRINTED_COLOUR: Final = (0.16, 0.42, 0.62, 1.0)
SECOND_COLOUR: Final = (0.93, 0.55, 0.16, 1.0)
THIRD_COLOUR: Final = (0.35, 0.60, 0.42, 1.0)
METAL: Final = (0.70, 0.72, 0.74, 1.0)
DARK: Final = (0.22, 0.23, 0.25, 1.0)
COLOURS: Final = {
    "base": PRINTED_COLOUR,
    "stand": PRINTED_COLOUR,
    "box": PRINTED_COLOUR,
    "lid": SECOND_COLOUR,
    "bearing_block": SECOND_COLOUR,
    "encoder_plate": THIRD_COLOUR,
    "hub": THIRD_COLOUR,
    "spacer": SECOND_COLOUR,
    "encoder": DARK,
    "screw": (0.45, 0.47, 0.50, 1.0),
}
"""Red, green, blue and opacity by the first word of a part's name; other parts are of metal."""
FONT: Final = f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf"


def triangles(solid: Part | Solid, tolerance: float, angle: float = 0.3) -> tuple[Any, Any]:
    """Return vertices [mm], shape (n, 3), and triangles, shape (m, 3), of a solid's surface.

    Args:
        solid: The solid.
        tolerance: Largest distance of the triangles from the surface [mm].
        angle: Largest angle between neighbouring triangles of a curved face [rad].
    """
    vertices, faces = solid.tessellate(tolerance, angle)
    return np.array([tuple(v) for v in vertices]), np.array(faces)


def _scene(shapes: Mapping[str, Part | Solid], moved: Mapping[str, Sequence[float]]) -> Any:
    """Return a MuJoCo model of shapes, each moved by a vector [mm]; the origin is their middle."""
    spec = mujoco.MjSpec()
    for name, shape in shapes.items():
        vertices, faces = triangles(shape, 0.05)
        vertices = (vertices + np.array(moved.get(name, (0.0, 0.0, 0.0)))) * 1e-3
        # Each triangle by itself: flat faces stay flat in the light.
        flat = vertices[faces.ravel()]
        mesh = spec.add_mesh(name=name, uservert=flat.ravel())
        mesh.userface = np.arange(len(flat), dtype=np.int32)
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        colour = COLOURS.get(name.split()[0], METAL)
        spec.worldbody.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, rgba=colour
        )
    finish(spec)
    return spec.compile()


def finish(spec: Any) -> None:
    """Add light and a white sky to a scene."""
    for direction in ((-0.4, 0.5, -1.0), (0.6, -0.3, -0.6)):
        spec.worldbody.add_light(
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            dir=direction,
            diffuse=[0.35] * 3,
            castshadow=False,
        )
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.42] * 3, [0.35] * 3
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 2400, 2000
    spec.visual.global_.fovy = 20.0
    spec.visual.quality.offsamples = 8
    texture = {"type": mujoco.mjtTexture.mjTEXTURE_SKYBOX}
    texture["builtin"] = mujoco.mjtBuiltin.mjBUILTIN_FLAT
    spec.add_texture(name="sky", rgb1=[1, 1, 1], rgb2=[1, 1, 1], width=32, **texture)


def draw(
    model: Any,
    azimuth: float,
    elevation: float,
    size: tuple[int, int] = (760, 560),
    points: Any = None,
    data: Any = None,
) -> Image.Image:
    """Return a picture of a model in which all of its meshes, or some points, are in view.

    Args:
        model: MuJoCo model.
        azimuth: Direction of view [deg].
        elevation: Its elevation over the horizon [deg]; negative looks down.
        size: Width and height [px].
        points: Points that have to be in view [m]; by default those of all meshes.
        data: State of the model; by default its first.
    """
    if data is None:
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
    if points is None:
        points = np.concatenate(
            [
                model.mesh_vert[start : start + count] @ data.geom_xmat[geom].reshape(3, 3).T
                + data.geom_xpos[geom]
                for geom in range(model.ngeom)
                if (number := model.geom_dataid[geom]) >= 0
                for start, count in [(model.mesh_vertadr[number], model.mesh_vertnum[number])]
            ]
        )
    a, e = np.radians([azimuth, elevation])
    ahead = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([np.sin(a), -np.cos(a), 0.0])
    axes = np.array([right, np.cross(right, ahead), ahead])
    seen = points @ axes.T
    centre = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    half = seen - centre
    tangent = np.tan(np.radians(10.0))
    need = np.maximum(np.abs(half[:, 0]) * size[1] / size[0], np.abs(half[:, 1])) / tangent
    camera = mujoco.MjvCamera()
    camera.lookat, camera.azimuth, camera.elevation = axes.T @ centre, azimuth, elevation
    camera.distance = float(np.max(need - half[:, 2])) * 1.06
    model.vis.map.znear = 0.01 * camera.distance / model.stat.extent
    with mujoco.Renderer(model, 2 * size[1], 2 * size[0]) as renderer:
        renderer.update_scene(data, camera)
        pixels = renderer.render()
    return Image.fromarray(pixels).resize(size, Image.Resampling.LANCZOS)


def picture(
    shapes: Mapping[str, Part | Solid],
    azimuth: float,
    elevation: float,
    size: tuple[int, int] = (760, 560),
    moved: Mapping[str, Sequence[float]] | None = None,
) -> Image.Image:
    """Return a picture of solids, with Z of the parts, which points down on a robot, downwards."""
    # A half turn about X: what hangs on the robot hangs in the picture.
    turned = {name: shape.rotate(Axis.X, 180.0) for name, shape in shapes.items()}
    flipped = {name: (x, -y, -z) for name, (x, y, z) in (moved or {}).items()}
    return draw(_scene(turned, flipped), azimuth, elevation, size)


def label(image: Image.Image, text: str) -> Image.Image:
    """Return a picture with a line of text at its top left."""
    pen = ImageDraw.Draw(image)
    pen.text((12, 10), text, "#222222", ImageFont.truetype(FONT, 17))
    return image


def row(images: Sequence[Image.Image], columns: int) -> Image.Image:
    """Return pictures of one size in rows."""
    width, height = images[0].size
    rows = -(-len(images) // columns)
    sheet = Image.new("RGB", (columns * width, rows * height), "white")
    for number, image in enumerate(images):
        sheet.paste(image, (number % columns * width, number // columns * height))
    return sheet
