"""An arm that is no KUKA, from its URDF to a run on the virtual rig: bring-an-arm.md as printed.

The arm has six joints, no spherical wrist, and links with masses.
"""

import json
import runpy
import shlex
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from equipoise import Actuator, Pendulum, RunLog, TabularPolicy, entry_points, iiwa
from equipoise.arm.chain import wrist_centre
from equipoise.arm.urdf import read_arm
from equipoise.cli import main
from equipoise.errors import ArmError
from equipoise.reproduction.synthetic_swing import synthetic_swing
from equipoise.rig.config import read_rig
from tests.arm.witnesses import ELBOW
from tests.faults.harness import Scenario
from tests.faults.table import TABLE
from tests.faults.verdicts import problems_of
from tests.rig.replayed import replay
from tests.test_pages import blocks, write

PAGE = "docs/how-to/bring-an-arm.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The files of the page, with the arm and a recorded swing."""
    folder = tmp_path_factory.mktemp("arm")
    (folder / "my_arm.urdf").write_text(ELBOW.read_text())
    for _, text in blocks(PAGE, "python", "toml"):
        write(text, folder)
    return folder


def test_the_page_prints_the_home_and_the_pivot_that_are_searched(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    runpy.run_path("look.py")
    searched = tomllib.loads(capsys.readouterr().out)
    rig = tomllib.loads((folder / "rig.toml").read_text())
    assert rig["home_deg"] == searched["home_deg"]
    assert rig["pivot_mm"] == searched["pivot_mm"]


def test_a_registered_arm_is_found_by_its_name(folder, monkeypatch):
    monkeypatch.syspath_prepend(folder)
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    points = project["entry-points"]["equipoise.arms"]
    found = [EntryPoint(name, value, "equipoise.arms") for name, value in points.items()]
    monkeypatch.setattr(entry_points, "entry_points", lambda group: found)
    arm = read_arm("my_arm")
    assert [joint.name for joint in arm.joints][-1] == "spin"
    assert np.isnan(wrist_centre(arm)).all()


def test_the_iiwas_are_registered_and_may_stand_at_another_home_with_another_pivot():
    assert read_arm("iiwa14") == iiwa(14)
    home, pivot = (0.1, 0.2, 0.0, -1.0, 0.3, 0.4, 0.5), (0.0, 0.0, 0.1)
    arm = read_arm("iiwa7", home=home, pivot=pivot)
    assert (arm.home, arm.pivot, arm.digest) == (home, pivot, iiwa(7).digest)
    with pytest.raises(ArmError):
        read_arm("iiwa7", home=(0.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0))


@pytest.mark.slow
def test_the_story_runs_as_it_is_printed(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    swing = synthetic_swing(seed=3)
    rows = np.column_stack((swing.time, np.degrees(swing.theta)))
    np.savetxt("swing.csv", rows, delimiter=",", header="time_s,theta_deg", comments="")
    said = {}
    for _, text in blocks(PAGE, "sh"):
        for line in text.splitlines():
            command, *words = shlex.split(line)
            assert command == "equipoise"
            capsys.readouterr()
            # A table of 2,000 episodes may fall before its time is over: exit code 1.
            assert main([*words, "--json"]) in (0, 1), line
            said[" ".join(words[:2])] = json.loads(capsys.readouterr().out)
    pendulum, policy = Pendulum.load("pendulum.json"), TabularPolicy.load("policy.json")
    assert pendulum.w2.value == pytest.approx(70.2, rel=0.05)
    actuator = Actuator.load("actuator.json")
    # The twin's transport takes 10 ms, its drives lag by 8 ms.
    assert actuator.delay.value == pytest.approx(0.010, abs=0.001)
    assert actuator.lags[0].value == pytest.approx(0.008, abs=0.002)
    assert policy.arm.name == "elbow 6"
    assert policy.arm.joints[3].link.mass == 1.0
    evaluation = said["evaluate policy.json"]
    assert evaluation["median_s"] > 2.0
    assert "sensor" not in evaluation["outcomes"]
    assert said["deploy policy.json"]["survival_s"] > 1.0
    scenario = Scenario(settings=read_rig(Path("rig.toml")), policy=policy)
    for fault in (fault for fault in TABLE if fault.name in ("TCP drop", "joint limit")):
        assert problems_of(fault, scenario) == [], fault.name
    log = RunLog.load("run.mcap")
    assert replay(log, policy) == (len(log.tables["tick"]), [])
    # The log contains the arm: its rig names a file that need not be there.
    (folder / "my_arm.urdf").unlink()
    assert RunLog.load("run.mcap").conditions.arm == policy.arm
