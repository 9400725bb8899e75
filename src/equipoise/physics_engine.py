"""Import of `mujoco`, independent of the OpenGL settings of the environment, without its log."""

import functools
import os
import sys
from importlib import import_module
from threading import Lock
from typing import Any, Final

IMPORT: Final = Lock()
"""Lock of the import. Two threads that set MuJoCo's handler at the same time deadlock: one waits
for MuJoCo's mutex, the other, which has it, for Python's."""


def mujoco() -> Any:
    """Import the module `mujoco`, which has no types; threads may call it at the same time.

    MuJoCo loads the OpenGL library of `MUJOCO_GL` on import, and fails if the name or the library
    is wrong. Linux without a display uses EGL. Physics needs no OpenGL: if the import fails, MuJoCo
    is imported without, and only rendering fails.

    MuJoCo's own handler of warnings prints them and appends them to `MUJOCO_LOG.TXT` in the current
    folder; ours drops them. What a warning reports is checked where it can occur.

    Raises:
        ImportError: MuJoCo is not installed.
    """
    with IMPORT:
        return import_mujoco()


@functools.cache
def import_mujoco() -> Any:
    """Import MuJoCo, once; see `mujoco`."""
    before = os.environ.get("MUJOCO_GL")
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if before is None and sys.platform.startswith("linux") and not display:
        os.environ["MUJOCO_GL"] = "egl"
    try:
        module = import_module("mujoco")
    except Exception:  # each library fails in its own way
        os.environ["MUJOCO_GL"] = "disable"
        module = import_module("mujoco")
    finally:
        if before is None:
            os.environ.pop("MUJOCO_GL", None)
        else:
            os.environ["MUJOCO_GL"] = before
    module.set_mju_user_warning(lambda _: None)
    return module
