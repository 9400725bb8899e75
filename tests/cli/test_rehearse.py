"""`equipoise rig rehearse`: what it lists, tries, refuses, and its exit codes."""

import pytest

from equipoise.studies import rehearsal

pytestmark = pytest.mark.compiled_only


def test_the_list_names_every_fault_and_tries_none(equipoise):
    ran = equipoise("rig", "rehearse", "--list", "--json")
    assert ran.code == 0
    everything = (*rehearsal.FAULTS, *rehearsal.REAL_TIME)
    assert ran.json == {"faults": [fault.name for fault in everything]}


def test_a_fault_that_ends_well_is_exit_code_0(equipoise):
    ran = equipoise("rig", "rehearse", "--only", "key: homing", "--only", "second client", "--json")
    assert ran.code == 0
    tried, left = ran.json["faults"]
    assert (tried["tried"], tried["problems"]) == (True, [])
    assert "stopped by the operator" in tried["did"]
    assert (left["tried"], left["did"]) == (False, "needs --real-time")


def test_a_fault_that_ends_otherwise_is_exit_code_1(equipoise, monkeypatch):
    bad = rehearsal.FAULTS[-1]._replace(name="made up", play=lambda: ("", ["the file was taken"]))
    monkeypatch.setattr(rehearsal, "FAULTS", (bad,))
    ran = equipoise("rig", "rehearse", "--only", "made up")
    assert ran.code == 1
    assert "failed" in ran.out
    assert "the file was taken" in ran.out
    assert "0 of 1 faults ended as required" in ran.out


def test_an_unknown_fault_is_refused(equipoise):
    ran = equipoise("rig", "rehearse", "--only", "encoder unplugd")
    assert ran.code == 2
    assert "--list shows them all" in ran.err
