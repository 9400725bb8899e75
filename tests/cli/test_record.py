"""`equipoise rig record`, in virtual time: a hand in front of an emulated board."""

import pytest

from equipoise.robots.encoder.swing import RecordingStage
from tests.cli.conftest import contents
from tests.robots.encoder.by_hand import RELEASE, ByHand
from tests.robots.encoder.rig import Bench

URI = "serial:///dev/ttyACM0"


@pytest.fixture
def bench(monkeypatch):
    """A board at `URI`; the machine's clock is the bench's."""
    bench = Bench()
    bench.motion = ByHand(0.8)
    monkeypatch.setattr("equipoise.rig.clocks.SystemClock", lambda: bench.clock)
    opened = []

    def open_serial(uri):
        opened.append(uri)
        return bench.open()

    monkeypatch.setattr("equipoise.robots.encoder.serial_port.open_serial", open_serial)
    yield bench
    assert set(opened) <= {URI}


def test_a_swing_becomes_a_file_that_identify_reads(equipoise, bench, tmp_path):
    ran = equipoise("rig", "record", "--encoder", URI, "--duration", 8)
    assert ran.code == 0, ran
    assert ran.err == ""
    said = ran.out.splitlines()
    assert said[0] == f"Listening to {URI}"
    assert said[1] == "emulated 1.0: 8192 counts per revolution, 1000 per second"
    places = [ran.out.index(stage.value) for stage in RecordingStage]
    assert places == sorted(places)
    assert ran.out.endswith("next: equipoise identify swing.csv\n")
    assert not bench.host._open
    pendulum = equipoise("identify", "swing.csv", "--json", "--no-figure").json
    assert pendulum["w2"] == pytest.approx(70.2, rel=0.01)
    assert pendulum["release"] is not None


def test_json_is_one_object(equipoise, bench):
    ran = equipoise(
        "rig", "record", "--encoder", URI, "--duration", 4, "--out", "a/b.csv", "--json"
    )
    assert ran.code == 0
    assert ran.json["recording"] == "a/b.csv"
    assert ran.json["amplitude_deg"] == pytest.approx(45.0, abs=1.5)
    assert ran.json["periods"] == pytest.approx(5.0, abs=0.5)
    assert ran.json["duration_s"] == pytest.approx(5.0, abs=0.01)
    assert ran.json["samples"] == pytest.approx(5000, abs=5)
    assert (ran.json["missing"], ran.json["rejected"]) == (0, 0)
    assert ran.json["counts_per_rev"] == 8192


def test_ctrl_c_keeps_nothing_and_says_so(equipoise, bench, tmp_path):
    (tmp_path / "swing.csv").write_text("an older one\n")

    def interrupt(now):
        if now > RELEASE + 2.0:
            raise KeyboardInterrupt

    bench.clock.attach(interrupt)
    ran = equipoise("rig", "record", "--encoder", URI)
    assert ran.code == 130
    assert "nothing was recorded, swing-2.csv was not written" in ran.out
    assert contents(tmp_path) == {"swing.csv": b"an older one\n"}
    assert not bench.host._open


@pytest.mark.parametrize("moment", [1.0, RELEASE - 1.0, RELEASE + 2.0])
@pytest.mark.parametrize(
    ("fault", "saying"), [("unplugged", "is gone"), ("silent", "sent no line that is valid for")]
)
def test_a_board_that_dies_is_the_outside_world(equipoise, bench, tmp_path, fault, saying, moment):
    def fail(now):
        if now > moment and fault == "silent":
            bench.device.cut = True
        elif now > moment and bench.device is not None:
            bench.unplug()
        assert now < moment + 2.0, "the recording goes on with a dead link"

    bench.clock.attach(fail)
    ran = equipoise("rig", "record", "--encoder", URI)
    assert ran.code == 3
    assert ran.err.startswith(f"error: {URI} {saying}")
    assert contents(tmp_path) == {}


def test_a_board_of_other_counts_is_refused(equipoise, bench):
    ran = equipoise("rig", "record", "--encoder", URI, "--counts-per-rev", 4096)
    assert ran.code == 3
    assert "counts 8192 per revolution, the rig expects 4096" in ran.err


def test_a_missing_device_is_named(equipoise):
    ran = equipoise("rig", "record", "--encoder", "serial:///dev/ttyNONE7")
    assert ran.code == 3
    assert "there is no device /dev/ttyNONE7" in ran.err


def test_wrong_use_is_refused(refused):
    refused("rig", "record", saying="Missing option")
    refused(
        "rig",
        "record",
        "--encoder",
        "/dev/ttyACM0",
        saying="no address of an encoder; expected serial:///dev/ttyACM0 or socket:",
    )
    refused("rig", "record", "--encoder", URI, "--out", "swing.txt", saying="ends in .csv")
    refused("rig", "record", "--encoder", URI, "--duration", 0.5, saying="a number from 1 to 600")
    refused("rig", "record", "--encoder", URI, "--duration", "nan", saying="a number from 1 to 600")
