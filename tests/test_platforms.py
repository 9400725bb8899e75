"""A machine without OpenGL: what does not draw works, and one sentence names it."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.compiled_only  # imports are the same without compilation

HIDE_LIBRARIES = """
import ctypes, ctypes.util
class Hidden(ctypes.CDLL):
    def __init__(self, name, *others, **named):
        if any(word in str(name) for word in ("OSMesa", "EGL", "libGL", "glfw")):
            raise OSError(f"{name}: cannot open shared object file")
        super().__init__(name, *others, **named)
ctypes.CDLL = ctypes.cdll._dlltype = Hidden
find = ctypes.util.find_library
ctypes.util.find_library = lambda name: None if name in ("OSMesa", "EGL", "GL") else find(name)
"""
DRAW = """
import numpy as np
import equipoise as eq
from equipoise.errors import OutsideError
from equipoise.worlds.twin.physics import mass_matrix
from equipoise.film import RigRenderer
arm = eq.iiwa(7)
assert mass_matrix(arm).shape == (7, 7)
try:
    RigRenderer(arm, 64, 48).draw(np.array(arm.home), 0.0)
except OutsideError as error:
    print(error)
"""


def said(program, **environment):
    """Run a program in a new process and return what it prints; it prints no error."""
    ran = subprocess.run(
        [sys.executable, "-c", program],
        env={key: value for key, value in os.environ.items() if key != "DISPLAY"} | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ran.returncode, ran.stderr) == (0, ""), ran.stderr
    return ran.stdout


@pytest.mark.full
@pytest.mark.parametrize(
    ("value", "hidden"),
    [("osmesa", HIDE_LIBRARIES), ("nonsense", "")],
)
def test_opengl_that_is_not_there_stops_only_drawing_with_one_sentence(value, hidden):
    printed = said(hidden + DRAW, MUJOCO_GL=value)
    assert f"MUJOCO_GL={value!r}" in printed
    assert printed.count("\n") == 1
    assert "set MUJOCO_GL to egl, osmesa" in printed
