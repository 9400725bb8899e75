"""Imports of the package: no module imports another in a circle, at any time."""

import grimp


def circles(graph):
    """Return the sets of modules that import each other, directly or not."""
    below = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    reached = {}
    for module in below:
        seen, waiting = set(), [module]
        while waiting:
            for imported in below[waiting.pop()] - seen:
                seen.add(imported)
                waiting.append(imported)
        reached[module] = seen
    return {
        frozenset(other for other in reached[module] if module in reached[other])
        for module in reached
        if module in reached[module]
    }


def test_no_module_imports_another_in_a_circle_inside_functions_included():
    graph = grimp.build_graph("equipoise", exclude_type_checking_imports=True, cache_dir=None)
    assert len(graph.modules) > 100
    assert circles(graph) == set()
