"""The generator: what it simplifies, and the machine code that is found again."""

import os
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from equipoise.arm import compiler
from equipoise.elementary import fma
from tests.program import run_program

pytestmark = pytest.mark.full

INPUTS = {"a": 0.7, "b": -1.3, "c": 2.1}
NUMBERS = st.sampled_from([0.0, 1.0, -1.0, 0.5, -2.5])


def expressions(tape, leaves):
    """Pairs of a symbol and the number that it stands for."""
    operations = (
        lambda x, y: (x[0] + y[0], x[1] + y[1]),
        lambda x, y: (x[0] - y[0], x[1] - y[1]),
        lambda x, y: (x[0] * y[0], x[1] * y[1]),
        lambda x, _: (-x[0], -x[1]),
    )
    leaf = st.one_of(st.sampled_from(leaves), NUMBERS.map(lambda n: (tape.number(n), n)))

    def applied(inner):
        chosen = st.sampled_from(operations)
        return st.builds(lambda operation, x, y: operation(x, y), chosen, inner, inner)

    return st.recursive(leaf, applied, max_leaves=30)


@settings(max_examples=300)
@given(data=st.data())
def test_what_is_printed_computes_what_was_written(data):
    tape = compiler.Tape()
    leaves = [(tape.symbol(name), value) for name, value in INPUTS.items()]
    symbol, value = data.draw(expressions(tape, leaves))
    record = {}
    entries = {"record['out']": symbol}
    compiler.fuse(entries)
    exec("\n".join(compiler.statements(entries)), {**INPUTS, "record": record, "fma": fma})
    # Terms are added in another order: rounding of values that may reach 1e6 and cancel.
    assert record["out"] == pytest.approx(value, rel=1e-9, abs=1e-9)


OTHER_ARM = """
import numpy as np
from equipoise.arm.compiler import addresses
from equipoise.arm.iiwa import iiwa
arm = iiwa(7).model_copy(update={"flange_xyz": (0.0, 0.0, 0.2)})
height = arm.kinematics(np.zeros(6)).position[2]
addresses(arm)
print(round(height, 12))
"""


def test_the_machine_code_of_an_arm_is_found_again(tmp_path):
    def run():
        own_cache = os.environ | {"EQUIPOISE_CACHE_DIR": str(tmp_path)}
        return run_program(sys.executable, "-c", OTHER_ARM, env=own_cache).stdout.split()

    height = str(round(0.34 + 0.4 + 0.4 + 0.2, 12))
    assert run() == [height]
    made = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.nb*")}
    assert made
    assert run() == [height]
    assert made == {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.nb*")}
