"""The public surface: lazy, complete, and documented."""

import inspect
import json
import subprocess
import sys

import pytest
from pydantic import BaseModel

import equipoise

HEAVY = ("numpy", "numba", "scipy", "mujoco", "matplotlib", "pydantic", "typer", "rich", "mcap")
NAMES = [name for name in equipoise.__all__ if not name.startswith("__")]


def test_importing_the_package_imports_nothing_that_is_slow():
    program = (
        f"import equipoise, sys, json; print(json.dumps([m for m in {HEAVY} if m in sys.modules]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout) == []


def test_every_name_is_there_and_listed():
    for name in equipoise.__all__:
        assert getattr(equipoise, name) is not None
    assert dir(equipoise) == sorted(equipoise.__all__)


@pytest.mark.parametrize("name", NAMES)
def test_every_field_of_a_public_value_is_documented(name):
    thing = getattr(equipoise, name)
    if not inspect.isclass(thing) or not issubclass(thing, BaseModel):
        return
    for field, info in thing.model_fields.items():
        # A section of the settings is described by its own class.
        described = info.description or inspect.getdoc(info.annotation)
        assert described, f"{name}.{field}"
