"""`equipoise rig doctor`: findings, exit codes, and what it refuses."""

from typing import get_args

import numpy as np
import pytest

from equipoise.cli.doctor import FITNESS_STYLES
from equipoise.cli.output import VERDICT_STYLES
from equipoise.rig.findings import Fitness, Status

VERDICTS = {"fit": 0, "usable with care": 0, "not fit": 1}
QUICK = ("--seconds", 0.2)


def test_json_has_the_findings_and_their_verdict(equipoise, tmp_path):
    ran = equipoise("rig", "doctor", *QUICK, "--logs", tmp_path / "runs", "--json")
    found = ran.json
    assert ran.code == VERDICTS[found["verdict"]]
    assert all(one["remedy"] or one["status"] == "good" for one in found["findings"])
    assert {"kernel", "deadlines", "own core"} <= {one["name"] for one in found["findings"]}
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(("late", "code"), [(0.0001, 0), (0.03, 0), (0.08, 1)])
def test_a_deadline_missed_by_far_is_told_by_the_exit_code(equipoise, monkeypatch, late, code):
    monkeypatch.setattr("equipoise.rig.checks.lateness", lambda *_: np.full(100, late))
    ran = equipoise("rig", "doctor", *QUICK)
    assert ran.code == code
    assert "Verdict on this machine" in ran.out


def test_an_encoder_that_is_not_there_is_a_finding_among_the_others(equipoise):
    ran = equipoise("rig", "doctor", *QUICK, "--encoder", "serial:///dev/nowhere", "--json")
    assert ran.code == 1
    last = ran.json["findings"][-1]
    assert (last["name"], last["status"]) == ("encoder", "bad")
    assert len(ran.json["findings"]) > 5


@pytest.mark.parametrize(
    "arguments",
    [
        ("--robot", "172.31.1.147"),
        ("--robot", "kst://172.31.1.147:port"),
        ("--robot", "twin:nominal"),
        ("--encoder", "usb://1"),
        ("--rig", "nowhere.toml"),
        ("--seconds", "nan"),
    ],
)
def test_what_cannot_be_meant_is_refused(refused, arguments):
    refused("rig", "doctor", *arguments, saying=arguments[1])


def test_every_verdict_has_a_style():
    assert set(VERDICT_STYLES) == set(get_args(Status))
    assert set(FITNESS_STYLES) == set(VERDICTS) == set(get_args(Fitness))
