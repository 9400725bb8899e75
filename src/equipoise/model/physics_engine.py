"""Import of `mujoco` that does not depend on the OpenGL settings of the environment."""

import functools
import os
from importlib import import_module
from typing import Any


@functools.cache
def mujoco() -> Any:
    """Import the module `mujoco`, which has no types.

    MuJoCo loads the OpenGL library of `MUJOCO_GL` on import, and fails if the name or the library
    is wrong. Physics needs no OpenGL: MuJoCo is then imported without, and only rendering fails
    (`equipoise.apps.report.pictures.rendering` gives the reason).

    Raises:
        ImportError: MuJoCo is not installed.
    """
    try:
        return import_module("mujoco")
    except Exception:  # each library fails in its own way
        before = os.environ.get("MUJOCO_GL")
        os.environ["MUJOCO_GL"] = "disable"
        try:
            return import_module("mujoco")
        finally:
            if before is None:
                del os.environ["MUJOCO_GL"]
            else:
                os.environ["MUJOCO_GL"] = before
