"""The public surface: lazy, complete, and documented."""

import inspect
import json
import sys

import pytest
from pydantic import BaseModel

import equipoise
from tests.program import run_program

HEAVY = ("numpy", "numba", "scipy", "mujoco", "matplotlib", "pydantic", "typer", "rich", "mcap")
NAMES = [name for name in equipoise.__all__ if not name.startswith("__")]


def test_importing_the_package_imports_nothing_that_is_slow():
    program = (
        f"import equipoise, sys, json; print(json.dumps([m for m in {HEAVY} if m in sys.modules]))"
    )
    assert json.loads(run_program(sys.executable, "-c", program).stdout) == []


@pytest.mark.parametrize("name", NAMES)
def test_every_public_name_and_field_is_documented(name):
    """Ruff reads the docstrings of functions and methods, which explain every argument."""
    thing = getattr(equipoise, name)
    assert inspect.getdoc(thing)
    if inspect.isclass(thing) and issubclass(thing, BaseModel):
        for field, info in thing.model_fields.items():
            # A section of the settings is described by its own class.
            assert info.description or inspect.getdoc(info.annotation), f"{name}.{field}"
