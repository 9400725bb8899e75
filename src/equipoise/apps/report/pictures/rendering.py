"""Off-screen rendering of joint positions with MuJoCo.

MuJoCo draws through OpenGL. The default backend is EGL, or OSMesa without EGL; `MUJOCO_GL` selects
egl, osmesa or glfw.
"""

import os
import sys
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from ctypes.util import find_library
from importlib import import_module
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from equipoise.apps.report.pictures.camera import Size
from equipoise.apps.report.pictures.scene import CAMERA, PictureScene
from equipoise.errors import OutsideError
from equipoise.model.physics_engine import mujoco

Floats = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]
"""Red, green and blue of every pixel, rows from the top, shape (height, width, 3)."""

MAX_GEOMS: Final = 512
"""Maximum number of shapes in a picture, including shadows."""
SHADOW: Final = np.array([0.64, 0.56, 0.42, 1.0], np.float32)
"""Colour of a shadow on the table."""
ARROW: Final = np.array([0.0, 0.62, 0.45, 1.0], np.float32)
"""Colour of the arrow that shows u."""
ARROW_PER_U: Final = 0.1
"""Length of the arrow for an acceleration of 1 m/s^2 [m]."""
ARROW_BELOW: Final = 0.09
"""Distance of the arrow below the pivot [m]; the hand never covers it."""


def draw(
    scene: PictureScene, q: Iterable[Floats], phi: Iterable[float], u: Iterable[float]
) -> Iterator[Picture]:
    """Draw a sequence of poses of the rig, each on demand.

    Args:
        scene: The scene, as `stage` builds it.
        q: All joints [rad], shape (n, joints).
        phi: Angle of the pendulum from upright [rad], shape (n,).
        u: Commanded acceleration, shown as an arrow unless zero [m/s^2], shape (n,).

    Raises:
        OutsideError: OpenGL is not available.
    """
    mj = mujoco()
    model, (width, height) = scene.model, scene.camera.size
    data, options, shapes = mj.MjData(model), mj.MjvOption(), mj.MjvScene(model, MAX_GEOMS)
    camera, everything = mj.MjvCamera(), mj.mjtCatBit.mjCAT_ALL
    camera.type, camera.fixedcamid = mj.mjtCamera.mjCAMERA_FIXED, model.camera(CAMERA).id
    whole, picture = mj.MjrRect(0, 0, width, height), np.empty((height, width, 3), np.uint8)
    with _canvas(model, scene.camera.size) as (make_current, canvas):
        for joints, angle, push in zip(q, phi, u, strict=False):
            data.qpos[:] = [*joints, angle]
            mj.mj_kinematics(model, data)
            mj.mj_camlight(model, data)
            mj.mjv_updateScene(model, data, options, None, camera, everything, shapes)
            _cast_shadows(model, shapes)
            if push:
                _add_arrow(data.body("pendulum").xpos, float(push), shapes)
            make_current()  # other code may have changed the context since the last picture
            mj.mjr_render(whole, shapes, canvas)
            mj.mjr_readPixels(picture, None, whole, canvas)
            yield picture[::-1].copy()  # OpenGL counts rows from the bottom


def _cast_shadows(model: Any, shapes: Any) -> None:
    """Add the shadows on the table of a light from straight above.

    The shadow of the pivot on the marks of the rail shows x. Each shape is drawn again, flat:
    OpenGL's own shadows take twice the time and speckle.
    """
    mj = mujoco()
    table = model.geom("table")
    surface = float(table.pos[2] + table.size[2]) + 0.002
    for shape in shapes.geoms[: shapes.ngeom]:
        moves = shape.objtype == mj.mjtObj.mjOBJ_GEOM and model.geom_bodyid[shape.objid] > 0
        if not moves or np.any(np.abs(shape.pos[:2] - table.pos[:2]) > table.size[:2]):
            continue
        place = np.array([*shape.pos[:2], surface])
        flat = np.diag([1.0, 1.0, 1e-3]) @ shape.mat
        shadow = shapes.geoms[shapes.ngeom]
        size = np.array(shape.size, np.float64)
        mj.mjv_initGeom(shadow, shape.type, size, place, flat.astype(np.float64).ravel(), SHADOW)
        shadow.specular = 0.0
        shapes.ngeom += 1


def _add_arrow(pivot: Floats, u: float, shapes: Any) -> None:
    """Add an arrow below the hand, along x, with a length proportional to `u`."""
    mj = mujoco()
    kind, arrow = mj.mjtGeom.mjGEOM_ARROW, shapes.geoms[shapes.ngeom]
    start = pivot - np.array([0.0, 0.0, ARROW_BELOW])
    # MuJoCo draws an arrow at half the given length.
    end = start + np.array([2.0 * ARROW_PER_U * u, 0.0, 0.0])
    mj.mjv_initGeom(arrow, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), ARROW)
    mj.mjv_connector(arrow, kind, 0.012, start, end)
    shapes.ngeom += 1


@contextmanager
def _canvas(model: Any, size: Size) -> Generator[tuple[Callable[[], None], Any]]:
    """Open an off-screen OpenGL context; yield the function that makes it current, and MuJoCo's."""
    mj = mujoco()
    backend = _backend()
    context: Any = None
    # Without a screen GLFW warns instead of raising.
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            context = import_module(backend).GLContext(*size)
            context.make_current()
            canvas = mj.MjrContext(model, mj.mjtFontScale.mjFONTSCALE_100)
        except Exception as error:  # backends and drivers raise different exceptions
            if context is not None:
                context.free()
            why = f"{backend} says: {warned[0].message if warned else error}"
            library = LIBRARIES.get(backend)
            if library is not None and not find_library(library):
                why = f"{backend} needs the library {library}, which is not installed"
            raise _opengl_error(why) from None
    try:
        mj.mjr_setBuffer(mj.mjtFramebuffer.mjFB_OFFSCREEN, canvas)
        yield context.make_current, canvas
    finally:
        context.make_current()  # `free` acts on the current context
        canvas.free()
        context.free()


GLFW: Final = "mujoco.glfw"
BACKENDS: Final = {"egl": "mujoco.egl", "osmesa": "mujoco.osmesa", "glfw": GLFW, "glx": GLFW}
"""Module that opens an OpenGL context, by the value of `MUJOCO_GL` on Linux."""
LIBRARIES: Final = {"mujoco.egl": "EGL", "mujoco.osmesa": "OSMesa"}
"""System library of each module; the default is the first installed one."""


def _backend() -> str:
    """Return the module that opens an OpenGL context.

    Raises:
        OutsideError: `MUJOCO_GL` is invalid, or no OpenGL library is installed.
    """
    if not sys.platform.startswith("linux"):
        return "mujoco.gl_context"  # MuJoCo's own choice
    if chosen := os.environ.get("MUJOCO_GL", "").lower().strip():
        if chosen not in BACKENDS:
            raise _opengl_error(f"MUJOCO_GL is {chosen!r}")
        return BACKENDS[chosen]
    if installed := [backend for backend, library in LIBRARIES.items() if find_library(library)]:
        return installed[0]
    raise _opengl_error("neither library EGL nor OSMesa is installed")


def _opengl_error(why: str) -> OutsideError:
    return OutsideError(
        f"cannot draw pictures, expected OpenGL without a screen: {why}; install EGL "
        "(Debian and Ubuntu: libegl1 and libgl1-mesa-dri), or set MUJOCO_GL to egl, osmesa, or, "
        "with a screen, glfw"
    )
