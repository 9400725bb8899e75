"""Files of the folder: equal for equal designs, readable, and those of the design."""

import hashlib
import json
import subprocess
import sys

import pytest
import trimesh
from build123d import import_step

import checks
import make
from equipoise.arm.urdf import read_arm
from parts import PRINTED


def write(folder):
    """Write all files as `make hardware` does: in a process of its own."""
    code = f"from pathlib import Path; from make import write_all; f = Path({str(folder)!r}); "
    code += "write_all(f, f / 'mechanism.json')"
    subprocess.run([sys.executable, "-c", code], cwd=make.FOLDER, check=True)
    return folder


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return write(tmp_path_factory.mktemp("hardware"))


def digests(folder):
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_a_second_time_gives_the_same_bytes(written, tmp_path):
    assert digests(write(tmp_path)) == digests(written)
    assert len(digests(written)) == 2 * len(PRINTED) + len(make.RIGS) + 2


def test_committed_numbers_are_those_of_the_design(written):
    for name in [*(f"rig-{rig}.toml" for rig in make.RIGS), "twin.toml"]:
        assert (make.FOLDER / name).read_text() == (written / name).read_text()
    assert make.SHAPES.read_text() == (written / "mechanism.json").read_text()


def test_committed_parts_are_those_of_the_design(written):
    """By geometry, to a millionth: another version of OpenCascade may write other digits."""
    found = sorted(path.name for path in (make.FOLDER / "step").iterdir())
    assert found == sorted(path.name for path in (written / "step").iterdir())
    for name in found:
        one, other = (import_step(folder / "step" / name) for folder in (make.FOLDER, written))
        assert one.volume == pytest.approx(other.volume, rel=1e-6)
        for a, b in zip(one.center(), other.center(), strict=True):
            assert a == pytest.approx(b, abs=1e-6)


def test_prints_are_closed_and_have_the_volume_of_their_solids(written):
    for path in sorted((make.FOLDER / "print").iterdir()):
        triangles = trimesh.load(path, force="mesh")
        assert triangles.is_watertight, path.name
        solid = import_step(written / "step" / f"{path.stem}.step")
        assert triangles.volume == pytest.approx(solid.volume, rel=5e-3)


def test_the_shapes_of_pictures_cover_the_holder(mechanism):
    """They have the extent of the solids, to a few millimetres."""
    shapes = json.loads(make.SHAPES.read_text())["shapes"]
    ends = [end for one in shapes if one["body"] == "flange" for end in one["ends"]]
    low, high = ([f(e[i] for e in ends) for i in range(3)] for f in (min, max))
    box = mechanism.solids["base"].bounding_box()
    assert 1e3 * high[0] == pytest.approx(mechanism.design.block_end, abs=0.1)
    assert 1e3 * low[1] == pytest.approx(box.min.Y, abs=0.1)
    assert 1e3 * high[2] > box.max.Z - 0.1
    assert read_arm("iiwa7").pivot[0] == pytest.approx(-mechanism.design.pivot_outward * 1e-3)


def test_the_page_has_the_table_of_checks(mechanism):
    assert checks.table(mechanism) in (make.FOLDER / "README.md").read_text()
