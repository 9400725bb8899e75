"""Machines without parts of Linux, and without what OpenGL needs: imports hold, sentences name it.

Each such machine is this one, with modules or libraries hidden from a new process.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from equipoise.cli.terminal_operator import single_keys
from equipoise.errors import OutsideError
from equipoise.robots.encoder.board import Board
from equipoise.robots.encoder.terminal import Terminal

pytestmark = pytest.mark.compiled_only  # imports are the same without compilation

HIDE_MODULES = """
import sys
for name in ("termios", "tty", "pty", "fcntl", "resource", "grp", "pwd"):
    sys.modules[name] = None
"""
IMPORT_ALL = """
import importlib, pkgutil, equipoise
for module in pkgutil.walk_packages(equipoise.__path__, "equipoise."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
"""
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


def test_every_module_imports_without_what_only_unix_has():
    assert said(HIDE_MODULES + IMPORT_ALL) == ""


@pytest.mark.parametrize(
    ("value", "hidden"),
    [
        ("osmesa", HIDE_LIBRARIES),
        pytest.param("glfw", "", marks=pytest.mark.slow),
        ("nonsense", ""),
    ],
)
def test_opengl_that_is_not_there_stops_only_drawing_with_one_sentence(value, hidden):
    printed = said(hidden + DRAW, MUJOCO_GL=value)
    assert f"MUJOCO_GL={value!r}" in printed
    assert printed.count("\n") == 1
    assert "set MUJOCO_GL to egl, osmesa" in printed


@pytest.mark.parametrize(
    ("module", "use", "expected"),
    [
        ("termios", lambda: single_keys().__enter__(), "drive a robot from Linux"),
        ("pty", lambda: Terminal(Board(lambda: 0.0)), "use Linux or macOS"),
    ],
)
def test_what_only_unix_has_is_asked_for_by_one_sentence(monkeypatch, module, use, expected):
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setattr(sys, "platform", "win32")
    with pytest.raises(OutsideError, match=f"^win32 .*{expected}$"):
        use()


def test_no_text_promises_the_package_on_an_index():
    top = Path(__file__).parents[1]
    texts = [top / "README.md", *top.glob("src/**/*.py"), *top.glob("docs/**/*.md")]
    promise = re.compile(r"(pip install|uv add|pipx run|uv run)[^\n&]*\bequipoise(\[|\s|$)", re.M)
    for path in texts:
        assert not promise.search(path.read_text(encoding="utf-8")), path
