"""Run logs: what is written is read, by us and by anybody who reads MCAP; edits are refused."""

import json
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from equipoise.artefacts import Provenance
from equipoise.errors import ArtefactError, OutsideError
from equipoise.logs import writer
from equipoise.logs.columns import TABLES, to_messages
from equipoise.logs.conditions import RunEnd
from equipoise.logs.run_log import RunLog, simulated_log
from equipoise.logs.writer import LogEncoder
from equipoise.outcomes import Outcome
from tests.logs.made_up import conditions, made_up


def messages(file):
    with file.open("rb") as stream:
        return list(make_reader(stream, validate_crcs=True).iter_messages())


@pytest.fixture
def run():
    return made_up()


@pytest.fixture
def file(run, tmp_path):
    run.save(tmp_path / "run.mcap", command="test", inputs={"policy": "sha256:0123"})
    return tmp_path / "run.mcap"


def excited():
    """An excitation of the arm, without ticks."""
    time = 0.005 * np.arange(30)
    q = np.tile(np.sin(time)[:, None], 7)
    replies = {"time": time[:-2] + 0.001, "q": q[:-2]}
    end = RunEnd(outcome=Outcome.EXCITED)
    return simulated_log(conditions(), end, {}, stream={"time": time, "q": q}, replies=replies)


JUMPING = {"time": np.array([0.0, 0.02, 0.01, 0.01, 0.4, 0.3]), "counts": np.arange(6)}
RUNS = {
    "no ticks": lambda: made_up(0),
    "one tick": lambda: made_up(1, rig=False),
    "all tables": made_up,
    "an excitation": excited,
    "time stamps that jump back": lambda: made_up(encoder=JUMPING),
}


@pytest.mark.parametrize("kind", RUNS)
def test_a_run_comes_back_to_the_last_bit(tmp_path, kind):
    run = RUNS[kind]()
    run.save(tmp_path / "deep" / "run.mcap", command="test", inputs={"policy": "sha256:0123"})
    back = RunLog.load(tmp_path / "deep" / "run.mcap")
    assert back.conditions == run.conditions
    assert {name: rows.tobytes() for name, rows in back.tables.items()} == {
        name: rows.tobytes() for name, rows in run.tables.items()
    }
    assert (back.digest, back.lasted, back.damage) == (run.digest, run.lasted, "")
    provenance = back.provenance
    assert (provenance.command, provenance.inputs) == ("test", {"policy": "sha256:0123"})
    assert {type(value) for value in back.conditions.world_settings.values()} == {float, int, str}


def test_any_reader_of_mcap_finds_named_numbers_with_a_schema(file, run):
    found = messages(file)
    topics = [channel.topic for _, channel, _ in found]
    counts = {"tick": 40, "truth": 40, "stream": 80, "reply": 40, "encoder": 40, "event": 0}
    assert {name: Counter(topics)[f"/{name}"] for name in TABLES} == counts
    for schema, channel, message in found:
        assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
        if channel.topic != "/end":
            known = json.loads(schema.data)["properties"]
            assert set(json.loads(message.data)) <= set(known)
    (tick,) = {schema.data for schema, channel, _ in found if channel.topic == "/tick"}
    assert json.loads(tick)["properties"]["u"]["description"].endswith("[m/s^2]")
    assert topics[-1] == "/end"


def test_each_message_stands_at_its_time_in_the_file(file, run):
    found = {}
    for _, channel, message in messages(file):
        found.setdefault(channel.topic, []).append((message.log_time, json.loads(message.data)))
    # Nanoseconds since the first row: a reply that was measured 4 ms before the release.
    stamp, tick = found["/tick"][7]
    assert (stamp, tick["phi"], tick["q"]) == (74_000_000, run.phi[7], run.q[7].tolist())
    stamp, setpoint = found["/stream"][7]
    assert (stamp, setpoint) == (39_000_000, {"time": 0.035, "q": [*run.stream.q[7]]})
    stamp, reply = found["/reply"][0]
    assert (stamp, reply) == (0, {"time": -0.004, "sent": -0.004, "q": [*run.replies.q[0]]})
    assert found["/end"][0][0] == 404_000_000
    with file.open("rb") as stream:
        as_written = make_reader(stream).iter_messages(log_time_order=False)
        stamps = [message.log_time for _, _, message in as_written]
    assert stamps == sorted(stamps)


EDITS = {
    "half a count": {"counts": 0.5},
    "a word for a number": {"compute": "far"},
    "a huge number": {"compute": 1e300},
    "a short posture": {"dq": [0.0, 0.0, 0.0]},
    "no such phase": {"state": 99},
}


@pytest.mark.parametrize("edit", EDITS)
def test_rows_of_another_form_are_refused(monkeypatch, run, tmp_path, edit):
    def changed(rows):
        for row in to_messages(rows):
            yield row | {name: value for name, value in EDITS[edit].items() if name in row}

    monkeypatch.setattr(writer, "to_messages", changed)
    run.save(tmp_path / "run.mcap", command="test")
    for damaged in (False, True):
        with pytest.raises(ArtefactError):
            RunLog.load(tmp_path / "run.mcap", damaged=damaged)


@pytest.mark.parametrize("changes", [None, {"luck": 1}, {"phases": []}])
def test_conditions_of_another_form_are_refused(run, tmp_path, changes):
    told = json.dumps(run.conditions.model_dump(mode="json") | changes) if changes else ""
    conditions = SimpleNamespace(arm=run.conditions.arm, model_dump_json=lambda: told)
    with (tmp_path / "run.mcap").open("wb") as stream:
        encoder = LogEncoder(stream, conditions, Provenance.now("test", None), 0.0)
        encoder.finish(0.0, run.end)
    with pytest.raises(ArtefactError):
        RunLog.load(tmp_path / "run.mcap", damaged=True)


def test_other_files_are_refused(tmp_path):
    (tmp_path / "text.mcap").write_text("time,phi\n")
    (tmp_path / "empty.mcap").write_bytes(b"")
    with (tmp_path / "foreign.mcap").open("wb") as stream:
        foreign = Writer(stream)
        foreign.start(profile="", library="")
        foreign.finish()
    for name in ("nowhere.mcap", "text.mcap", "empty.mcap", "foreign.mcap", ""):
        with pytest.raises(ArtefactError):
            RunLog.load(tmp_path / name, damaged=True)


def test_a_disk_that_refuses_leaves_nothing(run, tmp_path):
    (tmp_path / "taken").write_text("a file where a folder should be")
    with pytest.raises(OutsideError):
        run.save(tmp_path / "taken" / "run.mcap", command="test")
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]
