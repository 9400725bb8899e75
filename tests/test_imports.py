"""Imports of the package: no module imports another in a circle, at any time."""

from graphlib import TopologicalSorter

import pytest

grimp = pytest.importorskip("grimp")
pytestmark = pytest.mark.full


def test_no_module_imports_another_in_a_circle_inside_functions_included():
    graph = grimp.build_graph("equipoise", exclude_type_checking_imports=True, cache_dir=None)
    assert len(graph.modules) > 100
    imported = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    TopologicalSorter(imported).prepare()  # raises CycleError
