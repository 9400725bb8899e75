"""`equipoise log explain`, `export` and `show`: what is asked of the log of a run."""

import sys

import pytest
from PIL import Image

from equipoise.control.policy import shipped_policy
from equipoise.logs.conditions import RunEnd
from equipoise.logs.run_log import RunLog
from equipoise.outcomes import Outcome
from equipoise.rig.simulate import simulate_run
from tests.logs.made_up import conditions
from tests.rig.faulted import draw_fault, run_with

pytestmark = pytest.mark.compiled_only  # the twin takes minutes otherwise


@pytest.fixture(scope="module")
def pushed(tmp_path_factory):
    """The log of a run on a rig whose pendulum was pushed."""
    path = tmp_path_factory.mktemp("pushed") / "run.mcap"
    run_with(draw_fault("push", 2), 2, path)
    return path


@pytest.fixture(scope="module")
def on_a_twin(tmp_path_factory):
    path = tmp_path_factory.mktemp("twin") / "run.mcap"
    simulate_run(shipped_policy(), world="twin:nominal", duration=0.4).save(path, command="test")
    return path


def test_explain_names_the_cause_with_evidence_and_advice(equipoise, pushed):
    ran = equipoise("log", "explain", pushed)
    assert ran.code == 0
    assert "Why: push" in ran.out
    assert "deg/s within 80 ms, more than gravity and the flange explain" in ran.out
    assert "keep hands, cables and draughts away" in ran.out
    picture = [line for line in ran.out.splitlines() if line.endswith("]") or "[ " in line]
    assert len(picture) > 8
    assert f"next: equipoise log export {pushed}" in ran.out


def test_explain_in_json(equipoise, pushed, on_a_twin):
    found = equipoise("log", "explain", pushed, "--json").json
    assert found["cause"] == found["causes"][0]["name"] == "push"
    assert set(found["causes"][0]) == {"name", "score", "time_s", "evidence", "advice"}
    assert found["whole"] is True
    other = equipoise("log", "explain", on_a_twin, "--json").json
    assert (other["cause"], other["lasted_s"]) == ("lasted", 0.4)


def test_a_log_that_breaks_off_is_explained_with_a_warning(equipoise, pushed, tmp_path):
    (tmp_path / "cut.mcap").write_bytes(pushed.read_bytes()[: pushed.stat().st_size // 2])
    ran = equipoise("log", "explain", "cut.mcap")
    assert ran.code == 0
    assert "warning: the log is cut short" in ran.out
    assert "what came after is not known" in ran.out


def test_export_writes_the_tables_beside_the_log(equipoise, on_a_twin, tmp_path):
    (tmp_path / "run.mcap").write_bytes(on_a_twin.read_bytes())
    ran = equipoise("log", "export", "run.mcap")
    assert ran.code == 0
    made = sorted(path.name for path in (tmp_path / "run-csv").iterdir())
    assert made == ["encoder.csv", "reply.csv", "stream.csv", "tick.csv", "truth.csv"]
    assert equipoise("log", "export", "run.mcap", "--out", "run.mcap").code == 2


def test_export_refuses_a_log_without_rows(equipoise, tmp_path):
    RunLog.simulated(conditions(), RunEnd(outcome=Outcome.EXCITED), {}).save(
        "none.mcap", command="test"
    )
    ran = equipoise("log", "export", "none.mcap")
    assert (ran.code, list(tmp_path.glob("*-csv"))) == (2, [])
    assert "ends before its first row" in ran.err


@pytest.mark.parametrize("log", [pytest.param("pushed", marks=pytest.mark.slow), "on_a_twin"])
def test_export_films_the_log_of_a_rig_and_of_a_twin(equipoise, request, log, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    run = request.getfixturevalue(log)
    ran = equipoise("log", "export", run, "--video", "run.mp4", "--json")
    if "cannot draw pictures" in ran.err:
        pytest.skip(ran.err)
    assert ran.code == 0, ran
    assert ran.json == {"run": str(run), "tables": [], "video": "run.mp4", "whole": True}
    assert b"ftyp" in (tmp_path / "run.mp4").read_bytes()[:16]


@pytest.mark.parametrize("log", ["pushed", "on_a_twin"])
def test_export_films_a_part_as_a_webp(equipoise, request, log, tmp_path):
    run = request.getfixturevalue(log)
    words = ("log", "export", run, "--video", "part.webp", "--from", 0.08, "--to", 0.32)
    ran = equipoise(*words)
    if "cannot draw pictures" in ran.err:
        pytest.skip(ran.err)
    assert ran.code == 0, ran
    with Image.open(tmp_path / "part.webp") as film:
        assert (film.format, film.n_frames, film.size) == ("WEBP", 3, (480, 480))
        film.load()
        assert film.info["duration"] == 80
    made = (tmp_path / "part.webp").read_bytes()
    again = equipoise(*words)
    assert again.code == 2
    assert "part.webp exists; give another --video, or --force" in again.err
    assert (tmp_path / "part.webp").read_bytes() == made
    assert equipoise(*words, "--force").code == 0


def test_a_film_of_another_kind_is_refused_before_a_table_is_written(refused, on_a_twin):
    saying = "give a name that ends in .mp4 or .webp"
    refused("log", "export", on_a_twin, "--video", "run.gif", "--out", "t", saying=saying)


def test_a_part_that_is_not_one_of_the_run_is_refused_before_a_table_is_written(refused, on_a_twin):
    film = ("log", "export", on_a_twin, "--video", "run.webp", "--out", "t")
    saying = "known from 0.00 to 0.40 s; give a start and a later end in it"
    for part in (("--from", "0.3", "--to", "0.2"), ("--to", "9"), ("--from", "nan")):
        refused(*film, *part, saying=saying)
    refused("log", "export", on_a_twin, "--from", "0.1", saying="give --video FILE as well")


@pytest.mark.parametrize("verb", ["log explain", "log export", "log show"])
def test_what_is_no_log_is_refused(equipoise, tmp_path, verb):
    (tmp_path / "x.mcap").write_bytes(b"hello")
    for name in ("x.mcap", "nowhere.mcap"):
        ran = equipoise(*verb.split(), name)
        assert ran.code == 2
        assert name in ran.err
        assert "Traceback" not in ran.err


def test_show_refuses_a_log_of_which_nothing_is_readable(equipoise, pushed, tmp_path):
    pytest.importorskip("viser", reason="viser is not installed (extra console)")
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "cut.mcap").write_bytes(pushed.read_bytes()[:900])
    excited = RunLog.simulated(conditions(), RunEnd(outcome=Outcome.EXCITED), {})
    excited.save(tmp_path / "excited.mcap", command="test")
    for name, saying in (
        ("empty.mcap", "empty.mcap"),
        ("cut.mcap", "cut.mcap"),
        ("excited.mcap", "balancing"),
    ):
        ran = equipoise("log", "show", name)
        assert ran.code == 2, ran
        assert saying in ran.err
        assert ran.err.count("\n") == 1
        assert "http" not in ran.out


def test_show_refuses_an_address_that_is_none_and_says_what_it_needs(
    equipoise, on_a_twin, monkeypatch
):
    pytest.importorskip("viser", reason="viser is not installed (extra console)")
    ran = equipoise("log", "show", on_a_twin, "--listen", "nowhere")
    assert ran.code == 2
    assert "'nowhere' is not an IP address of this computer" in ran.err
    monkeypatch.setitem(sys.modules, "viser", None)
    ran = equipoise("log", "show", on_a_twin)
    assert ran.code == 2
    assert "needs the package viser" in ran.err
