"""`equipoise rig doctor`: what it says and measures, exit codes, and what it refuses."""

import gc
import threading
import time
from contextlib import closing
from typing import get_args

import numpy as np
import pytest

from equipoise.cli.doctor import FITNESS_STYLES, bar, bars
from equipoise.cli.output import VERDICT_STYLES
from equipoise.rig.checks.results import Spread, Verdict
from equipoise.rig.clocks import SystemClock
from equipoise.rig.doctor import Fitness
from equipoise.robots.encoder.board import Board
from equipoise.robots.encoder.terminal import Terminal
from tests.robots.kst.test_listener import Served

STABLE = {"verdict", "findings", "machine", "lateness", "stalls", "loaded", "link", "encoder"}
VERDICTS = {"fit": 0, "usable with care": 0, "not fit": 1}
QUICK = ("--seconds", 0.2)


def test_json_is_one_object_with_the_stable_keys_in_no_time(equipoise):
    begin = time.monotonic()
    ran = equipoise("rig", "doctor", *QUICK, "--json")
    assert time.monotonic() - begin < 3.0
    found = ran.json
    assert found.keys() == STABLE
    assert ran.code == VERDICTS[found["verdict"]]
    assert found["lateness"]["n"] == 40
    assert 0.0 < found["lateness"]["median"] <= found["lateness"]["most"]
    assert found["loaded"] is None
    assert all(one["cure"] or one["verdict"] == "good" for one in found["findings"])
    assert ran.err == ""


def test_words_show_both_histograms_each_finding_and_the_verdict(equipoise):
    ran = equipoise("rig", "doctor", *QUICK, "--load")
    assert "Lateness of deadlines at 200 Hz" in ran.out
    assert "... with every core busy" in ran.out
    assert "█" in ran.out
    assert "above 20 ms" in ran.out
    for name in ("kernel", "clock rate", "real-time priority", "memory locked", "room for logs"):
        assert f" {name} " in ran.out
    (verdict,) = [word for word in VERDICTS if f"Verdict on this machine: {word}." in ran.out]
    assert ran.code == VERDICTS[verdict]


@pytest.mark.parametrize(
    ("late", "code", "saying"),
    [(0.0001, 0, "Verdict on this"), (0.03, 0, "rides through"), (0.08, 1, "machine: not fit.")],
)
def test_a_deadline_missed_by_far_is_told_by_the_exit_code(
    equipoise, monkeypatch, late, code, saying
):
    monkeypatch.setattr("equipoise.rig.doctor.lateness", lambda *_: np.full(100, late))
    ran = equipoise("rig", "doctor", *QUICK)
    assert ran.code == code
    assert saying in ran.out


def test_logs_are_looked_for_where_they_will_go(equipoise, tmp_path):
    assert equipoise("rig", "doctor", *QUICK, "--logs", tmp_path / "runs", "--json").json[
        "machine"
    ]["free"]
    assert not (tmp_path / "runs").exists()


@pytest.fixture
def robot():
    """The address of an emulated robot on a port, and what is behind it."""
    served = Served()
    yield f"kst://127.0.0.1:{served.port}", served
    served.stop.set()
    served.thread.join(5.0)


@pytest.fixture
def encoder(monkeypatch):
    """The address of an emulated board on a pseudo-terminal, and the board."""
    # Collecting the garbage of all tests takes a second, in which the board's thread is silent.
    monkeypatch.setattr(gc, "collect", lambda *_: 0)
    clock, over = SystemClock(), threading.Event()
    board = Board(lambda: 0.0, counts_per_rev=4096, start=clock.now())

    def run():
        with closing(Terminal(board)) as terminal:
            address.append(f"serial://{terminal.path}")
            while not over.wait(0.001):
                terminal.advance(clock.now())

    address = []
    thread = threading.Thread(target=run)
    thread.start()
    while not address:
        time.sleep(0.001)
    yield address[0], board
    over.set()
    thread.join(5.0)


def test_a_robot_is_examined_and_does_not_move(equipoise, robot):
    ran = equipoise("rig", "doctor", *QUICK, "--robot", robot[0], "--json")
    found = ran.json
    assert ran.code == VERDICTS[found["verdict"]], ran
    assert 1 <= found["link"]["n"] <= 40
    assert {one["name"] for one in found["findings"]} >= {"link to the robot", "networks"}
    body = robot[1].body
    assert body.targets == []
    assert not body.running
    assert robot[1].server.ended


def test_an_encoder_is_examined(equipoise, encoder):
    found = equipoise("rig", "doctor", *QUICK, "--encoder", encoder[0], "--json").json
    assert found["encoder"]["counts_per_rev"] == 4096
    # A thousand lines a second; threads of one process share a core here.
    assert 500.0 < found["encoder"]["rate"] < 1500.0
    assert "encoder's samples" in {one["name"] for one in found["findings"]}


def test_words_say_that_the_robots_server_has_ended(equipoise, robot):
    ran = equipoise("rig", "doctor", *QUICK, "--robot", robot[0])
    assert "Round trip to the robot" in ran.out
    assert "start the server's application on the smartPAD" in ran.out
    assert "equipoise deploy times the link itself" in ran.out
    assert "Verdict on machine and rig: " in ran.out


def test_an_encoder_of_another_rig_is_found_out(equipoise, encoder, tmp_path):
    (tmp_path / "rig.toml").write_text("counts_per_rev = 8192\n")
    ran = equipoise("rig", "doctor", *QUICK, "--encoder", encoder[0], "--rig", "rig.toml")
    assert ran.code == 1
    assert "4096 per revolution, the rig says 8192" in ran.out, ran.out[-1500:]
    assert "correct counts_per_rev" in ran.out
    assert "Age of the encoder's newest sample" in ran.out


def test_an_encoder_that_is_not_there_is_a_finding_among_the_others(equipoise):
    ran = equipoise("rig", "doctor", *QUICK, "--encoder", "serial:///dev/nowhere", "--json")
    assert ran.code == 1
    found = ran.json
    assert found["encoder"] is None
    last = found["findings"][-1]
    assert (last["name"], last["verdict"]) == ("encoder", "bad")
    assert last["found"] == "there is no device /dev/nowhere"
    assert "plug the board in" in last["cure"]
    assert len(found["findings"]) > 5


ADDRESSES = {
    "no scheme": ("--robot", "172.31.1.147"),
    "no port": ("--robot", "kst://172.31.1.147:port"),
    "another robot": ("--robot", "ros://172.31.1.147"),
    "a twin": ("--robot", "twin:nominal"),
    "another encoder": ("--encoder", "usb://1"),
}


@pytest.mark.parametrize("flaw", ADDRESSES)
def test_addresses_that_cannot_be_meant_are_refused(refused, flaw):
    refused("rig", "doctor", *QUICK, *ADDRESSES[flaw], saying=ADDRESSES[flaw][1])


def test_a_rig_that_cannot_be_read_is_refused(refused):
    refused(
        "rig", "doctor", *QUICK, "--rig", "nowhere.toml", saying="there is no file nowhere.toml"
    )


def test_logs_go_to_a_folder(refused, tmp_path):
    (tmp_path / "runs").write_text("")
    refused("rig", "doctor", *QUICK, "--logs", "runs", saying="give the name of a folder")


@pytest.mark.parametrize("seconds", ["0", "-1", "nan", "inf", "soon"])
def test_durations_that_cannot_be_meant_are_refused(refused, seconds):
    refused("rig", "doctor", "--seconds", seconds, saying="--seconds")


def test_every_verdict_has_a_look():
    assert set(VERDICT_STYLES) == set(get_args(Verdict))
    assert set(FITNESS_STYLES) == set(VERDICTS) == set(get_args(Fitness))


def test_bars_are_as_long_as_their_counts():
    assert bar(8, 8) == "█" * 40
    assert bar(4, 8) == "█" * 20
    assert bar(1, 320) == "▏"
    assert bar(1, 10**6) == "▏"
    assert bar(0, 8) == ""
    assert bars(Spread.of(np.array([1e-4, 2e-3, 0.9]))).row_count == 13
