"""The generator: what it simplifies, and the files that it writes and finds again."""

import importlib
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from equipoise import jit
from equipoise.model.arms import compiler
from equipoise.model.arms.compiler import FRAME_SIZE
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.arms.symbols import Tape
from equipoise.model.elementary import BATCH_SIZE, fma

INPUTS = {"a": 0.7, "b": -1.3, "c": 2.1}
NUMBERS = st.sampled_from([0.0, 1.0, -1.0, 0.5, -2.5])


def expressions(tape, leaves):
    """Pairs of a symbol and the number that it stands for."""
    operations = {
        "+": lambda x, y: (x[0] + y[0], x[1] + y[1]),
        "-": lambda x, y: (x[0] - y[0], x[1] - y[1]),
        "*": lambda x, y: (x[0] * y[0], x[1] * y[1]),
        "neg": lambda x, _: (-x[0], -x[1]),
    }
    leaf = st.one_of(st.sampled_from(leaves), NUMBERS.map(lambda n: (tape.number(n), n)))
    return st.recursive(
        leaf,
        lambda inner: st.builds(
            lambda operation, x, y: operations[operation](x, y),
            st.sampled_from(sorted(operations)),
            inner,
            inner,
        ),
        max_leaves=30,
    )


@pytest.mark.compiled_only
@settings(deadline=None, max_examples=300)
@given(data=st.data())
def test_what_is_printed_computes_what_was_written(data):
    tape = Tape()
    leaves = [(tape.input(name, f"inputs['{name}']"), value) for name, value in INPUTS.items()]
    symbol, value = data.draw(expressions(tape, leaves))
    record = {}
    entries = {"result": {"record['out']": symbol}}
    tape.fuse(entries)
    exec("\n".join(tape.python(entries)), {"inputs": INPUTS, "record": record, "fma": fma})
    # Terms are added in another order: rounding of values that may reach 1e6 and cancel.
    assert record["out"] == pytest.approx(value, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("size", [7, 14])
def test_the_committed_modules_are_what_the_generator_writes(size):
    arm = iiwa(size)
    path = compiler.COMMITTED_FOLDER / f"{arm.name}.py"
    assert path.read_text(encoding="utf-8") == compiler.source(arm.chain), "run: make generated"
    module = importlib.import_module(f"equipoise.model.arms.generated.{arm.name}")
    assert arm.geometry_digest == module.DIGEST
    functions = (module.kinematics, module.motion)
    assert compiler.load(arm.chain) == functions
    assert compiler.load(iiwa(size, media_flange=0.061).chain) == functions


def shorter(length, name="iiwa7"):
    """An iiwa 7 with another hand: no module of it is part of the package."""
    return iiwa(7).model_copy(update={"name": name, "flange_xyz": (0.0, 0.0, length)})


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("EQUIPOISE_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compiler, "cache_folder", jit.cache_folder.__wrapped__)
    return tmp_path / "arms"


def test_another_arm_is_written_to_the_cache_once_and_used_again(cache):
    arm = shorter(0.2)
    functions = compiler.load(arm.chain)
    (file,) = cache.iterdir()
    assert file.name == arm.geometry_digest.removeprefix("sha256:") + ".py"
    stamp = file.stat().st_mtime_ns
    assert compiler.load(arm.chain) == functions
    assert file.stat().st_mtime_ns == stamp
    assert arm.pose(np.zeros(6)).position[2] == pytest.approx(0.34 + 0.4 + 0.4 + 0.2)


@pytest.mark.parametrize("damage", ["raise SystemExit\n", "", "def kinematics(q, dq, frame): ..."])
def test_a_damaged_file_in_the_cache_is_written_again(cache, damage):
    arm = shorter(0.21 + len(damage) / 1000)
    file = cache / (arm.geometry_digest.removeprefix("sha256:") + ".py")
    cache.mkdir()
    file.write_text(damage)
    compiler.load(arm.chain)
    assert file.read_text() == compiler.source(arm.chain)


# Two arms that are not part of the package and one that is, through one compiled loop.
SESSION = """
import sys
import numba, numpy as np
from equipoise.model.arms.compiler import FRAME_SIZE
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.elementary import BATCH_SIZE
sys.path.insert(0, {folder!r})
from kernels_of_test import height

arms = [iiwa(7), *(iiwa(7).model_copy(update={{"flange_xyz": (0, 0, d)}}) for d in (0.2, 0.3))]
kernels = [arm.compiled() for arm in arms]
rest = np.zeros(6 * BATCH_SIZE)
print(*(round(height(kernel, rest, rest), 12) for kernel in kernels))
if not numba.config.DISABLE_JIT:
    hits = [kernel.kinematics.cache_hits for kernel in kernels]
    print(*hits, sum(height.stats.cache_hits.values()))
"""
KERNELS = f"""
import numpy as np
from equipoise.jit import kernel

@kernel
def height(arm, q, dq):
    frame = np.zeros({FRAME_SIZE * BATCH_SIZE})
    arm.kinematics(q, dq, frame, 1)
    return frame[{2 * BATCH_SIZE}]
"""


def test_arms_have_their_own_results_in_one_process_and_from_the_cache_in_the_next(tmp_path):
    (tmp_path / "kernels_of_test.py").write_text(KERNELS)
    environment = {**os.environ, "EQUIPOISE_CACHE_DIR": str(tmp_path / "cache")}
    script = SESSION.format(folder=str(tmp_path))

    def session():
        run = subprocess.run(
            [sys.executable, "-c", script],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
            timeout=300,
        )
        return run.stdout.splitlines()

    first, second = session(), session()
    assert first[0] == second[0] == "1.266 1.34 1.44"
    if os.environ.get("NUMBA_DISABLE_JIT", "0") == "0":
        assert first[1] == "0 0 0 0"  # nothing is in the cache
        assert second[1] == "1 1 1 1"  # everything is
