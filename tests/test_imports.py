"""Imports of the packages: no circle at any time, and no library that is not declared."""

import re
import sys
import tomllib
from graphlib import TopologicalSorter
from importlib.metadata import packages_distributions
from itertools import chain
from pathlib import Path

import pytest

grimp = pytest.importorskip("grimp")
pytestmark = pytest.mark.full
ROOT = Path(__file__).parents[1]


def test_no_module_imports_another_in_a_circle_inside_functions_included():
    graph = grimp.build_graph("equipoise", exclude_type_checking_imports=True, cache_dir=None)
    assert len(graph.modules) > 100
    imported = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    TopologicalSorter(imported).prepare()  # raises CycleError


@pytest.mark.parametrize("folder", [ROOT, ROOT / "plugins" / "equipoise-franka"])
def test_every_imported_library_is_declared(folder):
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    name = project["name"].replace("-", "_")
    pytest.importorskip(name)
    graph = grimp.build_graph(name, include_external_packages=True, cache_dir=None)
    own = {name, "equipoise", *sys.stdlib_module_names}
    imported = {module for module in graph.modules if "." not in module} - own
    assert "numpy" in imported
    lines = chain(project["dependencies"], *project["optional-dependencies"].values())
    declared = {plain(re.match(r"[\w.-]+", line)[0]) for line in lines}
    homes = packages_distributions()
    assert [x for x in imported if not declared & {plain(home) for home in homes[x]}] == []


def plain(distribution):
    """The name as installers compare it."""
    return re.sub(r"[-_.]+", "-", distribution).lower()
