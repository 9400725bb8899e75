"""The module `mujoco`, whose physics does not depend on the environment's settings for drawing."""

import functools
import os
from importlib import import_module
from typing import Any


@functools.cache
def mujoco() -> Any:
    """Return the module `mujoco`, which has no types.

    MuJoCo loads the OpenGL that `MUJOCO_GL` names while it is imported, and fails where the name or
    the library is wrong. Physics needs no OpenGL: MuJoCo is then imported without, and only drawing
    fails (`equipoise.report.pictures.rendering` says why).

    Raises:
        ImportError: It is not installed.
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
