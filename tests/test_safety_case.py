"""The safety case names tests that exist, and leaves out no guard and no injected fault."""

import ast
import re
from pathlib import Path

import pytest

from equipoise.outcomes import MAX_MEASUREMENT_AGE, MAX_STALL, SAFETY_RULES
from tests.faults.files import FILES
from tests.faults.table import TABLE

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "safety-case.md").read_text(encoding="utf-8")
NAMED = sorted(set(re.findall(r"`((?:plugins/[\w-]+/)?tests/[\w/]+\.py)::(\w+)`", PAGE)))
TABLES = "\n".join(line for line in PAGE.splitlines() if line.startswith("|"))


def names_in(path):
    """Return the names of the test functions in a file, wherever in it they stand."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {
        node.name
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    }


@pytest.mark.parametrize(("path", "name"), NAMED)
def test_each_test_that_is_named_exists(path, name):
    assert (ROOT / path).is_file(), path
    assert name in names_in(ROOT / path)


def test_whatever_looks_like_a_test_is_read_as_one():
    # A name with a slip in its form would escape the check above.
    assert len(NAMED) > 15
    assert PAGE.count("::") == len(re.findall(r"`(?:plugins/[\w-]+/)?tests/[\w/]+\.py::\w+`", PAGE))


@pytest.mark.parametrize("rule", SAFETY_RULES, ids=lambda rule: rule.name)
def test_each_guard_stands_in_a_table(rule):
    assert f"*{rule}*" in TABLES


def test_the_faults_named_are_those_that_are_injected():
    known = {fault.name for fault in (*TABLE, *FILES)}
    cells = [line.split("|")[3] for line in TABLES.splitlines() if line.count("|") == 4]
    named = {name for cell in cells for name in re.findall(r"`([^`]+)`", cell)}
    assert named == known


def test_each_number_of_the_page_is_that_of_the_code():
    from equipoise.rig import readings, run_controller
    from equipoise.safety import monitors, rules, stop
    from tests.faults.verdicts import MAX_NOTICE

    assert f"within {1e3 * MAX_NOTICE:.0f} ms" in PAGE
    assert f"up to {1e3 * MAX_STALL:g} ms is bridged" in PAGE
    assert f"not answered for {1e3 * readings.MAX_ROUND_TRIP:g} ms" in PAGE
    assert f"({rules.STOP_DECELERATION:g} m/s² at the flange" in PAGE
    assert f"{100 * rules.TORQUE_FRACTION:.0f} % of the joint's torque" in PAGE
    assert f"a following error of {rules.FOLLOWING_LIMIT:g} rad" in PAGE
    fraction = 100 * run_controller.UNCERTAIN_TORQUE_FACTOR * rules.TORQUE_FRACTION
    assert f"on the way there {fraction:.0f} % beyond what the start shows" in PAGE
    assert (monitors.MAX_REPEATS, monitors.REPEAT_WINDOW) == (3, 1.0)
    assert "a third gap within a second" in PAGE
    assert "the third stall within a second" in PAGE
    assert stop.SLOW_FRACTION == 0.1
    assert "a tenth of the joints' speed" in PAGE
    assert monitors.MIN_REPLIES == 5
    assert "five replies in order" in PAGE
    assert f"within {rules.FOLLOWING_LIMIT:g} rad of the setpoints of the last 0.3 s" in PAGE
    assert readings.HISTORY == 64
    assert f"above {1e3 * readings.MAX_ROUND_TRIP:g} ms do not count" in PAGE.replace("\n", " ")
    assert f"are {1e3 * MAX_MEASUREMENT_AGE:g} ms old" in PAGE
