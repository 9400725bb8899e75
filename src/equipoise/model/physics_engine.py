"""Import of `mujoco` that does not depend on the OpenGL settings of the environment."""

import functools
import os
import sys
from importlib import import_module
from typing import Any


@functools.cache
def mujoco() -> Any:
    """Import the module `mujoco`, which has no types.

    MuJoCo loads the OpenGL library of `MUJOCO_GL` on import, and fails if the name or the library
    is wrong. Linux without a display uses EGL. Physics needs no OpenGL: if the import fails, MuJoCo
    is imported without, and only rendering fails.

    Raises:
        ImportError: MuJoCo is not installed.
    """
    before = os.environ.get("MUJOCO_GL")
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if before is None and sys.platform.startswith("linux") and not display:
        os.environ["MUJOCO_GL"] = "egl"
    try:
        return import_module("mujoco")
    except Exception:  # each library fails in its own way
        os.environ["MUJOCO_GL"] = "disable"
        return import_module("mujoco")
    finally:
        if before is None:
            os.environ.pop("MUJOCO_GL", None)
        else:
            os.environ["MUJOCO_GL"] = before
