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


def test_every_name_is_there_and_listed():
    for name in equipoise.__all__:
        assert getattr(equipoise, name) is not None
    assert dir(equipoise) == sorted(equipoise.__all__)


def functions_of(name):
    """Return the functions and methods behind a public name, by what to call them."""
    thing = inspect.unwrap(getattr(equipoise, name))
    if not inspect.isclass(thing):
        return {name: thing}
    found = {}
    for key, member in vars(thing).items():
        if key.startswith("_") and key != "__init__":
            continue
        member = getattr(member, "__func__", member)
        if isinstance(member, property):
            member = member.fget
        if inspect.isfunction(member) and member.__module__ == thing.__module__:
            found[f"{name}.{key}"] = member
    return found


@pytest.mark.parametrize("name", NAMES)
def test_every_public_name_argument_and_field_is_documented(name):
    thing = getattr(equipoise, name)
    assert inspect.getdoc(thing)
    for called, function in functions_of(name).items():
        text = inspect.getdoc(function)
        assert text, called
        # A short docstring may explain its arguments in its sentence; one with Args names all.
        if "Args:" in text:
            for argument in inspect.signature(function).parameters:
                explained = argument in ("self", "cls") or f"\n    {argument}: " in text
                assert explained, (called, argument)
    if inspect.isclass(thing) and issubclass(thing, BaseModel):
        for field, info in thing.model_fields.items():
            # A section of the settings is described by its own class.
            assert info.description or inspect.getdoc(info.annotation), f"{name}.{field}"
