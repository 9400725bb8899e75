"""Every format that is read from a file, damaged at random: a sound value or one sentence."""

from math import radians
from pathlib import Path

import numpy as np
import pytest

from equipoise import Actuator, read_swing, read_urdf, read_world, resolve, shipped_actuator
from equipoise.control.policy import TabularPolicy, shipped_policy
from equipoise.model.pendulum import Pendulum, shipped_pendulum
from equipoise.rig.config import read_rig
from tests.cli.damage import mutations, outcomes
from tests.test_pages import blocks

DATA = Path(__file__).parent / "data"
HOME = [radians(angle) for angle in (0.0, -60.0, 90.0, 0.0, 60.0, 0.0)]

SETTINGS = """\
# A comment.
[learning]
episodes = 2_000
gamma = 0.97
mirrored = true
[selection]
duration = 60.0
[identification]
friction = "coulomb"
"""
RIG, WORLD = (
    blocks(f"docs/how-to/{page}.md", "toml")[0][1] for page in ("first-run", "digital-twin")
)


def swing_text():
    time = np.arange(0.0, 2.0, 0.01)
    rows = (f"{t:.3f},{0.5 * np.cos(8.0 * t):.6f}\n" for t in time)
    return "time_s,theta_rad\n" + "".join(rows)


FORMATS = {
    "settings.toml": (SETTINGS, lambda path: resolve(file=path)),
    "rig.toml": (RIG, read_rig),
    "world.toml": (WORLD, lambda path: read_world(f"twin:{path}")),
    "swing.csv": (swing_text(), read_swing),
    "arm.urdf": ((DATA / "elbow6.urdf").read_text(), lambda path: read_urdf(path, home=HOME)),
    "pendulum.json": (shipped_pendulum(), Pendulum.load),
    "actuator.json": (shipped_actuator(), Actuator.load),
    "policy.json": (shipped_policy(), TabularPolicy.load),
}


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("count", [60, pytest.param(3000, marks=pytest.mark.slow)])
def test_a_damaged_file_is_a_value_or_a_sentence(tmp_path, name, count):
    (given, read), path = FORMATS[name], tmp_path / name
    if isinstance(given, str):
        path.write_text(given)
    else:
        given.save(path, command="test")
    read(path)
    found = outcomes(read, path, mutations(path.read_bytes(), count))
    assert found["refused"] > 0
