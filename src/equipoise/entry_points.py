"""Arms, robots, sensors and twins that packages register as entry points, by group and name."""

from importlib.metadata import EntryPoint, entry_points
from typing import Final

INSTALL: Final = dict.fromkeys(("franka", "fr3"), "./plugins/equipoise-franka")
"""Packages in the sources of this project that are installed separately, by what they register."""


def registered(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name, those of this package among them."""
    return {point.name: point for point in entry_points(group=group)}


def how_to_install(name: str) -> str:
    """Return how to install the package that registers a name; empty if this project has none."""
    return f"install its package: python -m pip install {INSTALL[name]}" if name in INSTALL else ""
