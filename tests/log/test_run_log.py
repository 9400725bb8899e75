"""Run logs: what is written is read, by us and by anybody who reads MCAP; edits are refused."""

import json
from collections import Counter

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from equipoise import RunLog, excite
from equipoise.errors import ArtefactError
from equipoise.log import writer
from equipoise.log.columns import TABLES, to_messages
from tests.log.made_up import short_run

RUNS = {"all tables": short_run, "no ticks": lambda: excite("iiwa7", duration=0.2)}


@pytest.mark.parametrize("kind", RUNS)
def test_a_run_comes_back_to_the_last_bit(tmp_path, kind):
    run = RUNS[kind]()
    run.save(tmp_path / "deep" / "run.mcap", command="test", inputs={"policy": "sha256:0123"})
    back = RunLog.load(tmp_path / "deep" / "run.mcap")
    assert back.conditions == run.conditions
    assert back.tables.keys() == run.tables.keys()
    assert all(rows.tobytes() == run.tables[name].tobytes() for name, rows in back.tables.items())
    assert (back.digest, back.survival, back.damage) == (run.digest, run.survival, "")
    kinds = [list(map(type, one.conditions.world_settings.values())) for one in (back, run)]
    assert kinds[0] == kinds[1]


def test_any_reader_of_mcap_finds_named_numbers_with_a_schema(tmp_path):
    file = tmp_path / "run.mcap"
    short_run().save(file, command="test", inputs={"policy": "sha256:0123"})
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        (metadata,) = reader.iter_metadata()
        found = list(reader.iter_messages())
    provenance = json.loads(metadata.metadata["provenance"])
    assert (provenance["command"], provenance["inputs"]) == ("test", {"policy": "sha256:0123"})
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


EDITS = {
    "a word for a number": {"x": "far"},
    "a short posture": {"dq": [0.0, 0.0, 0.0]},
    "no such phase": {"state": 99},
}


@pytest.mark.parametrize("edit", EDITS)
def test_rows_of_another_form_are_refused(monkeypatch, tmp_path, edit):
    def changed(rows):
        for row in to_messages(rows):
            yield row | {name: value for name, value in EDITS[edit].items() if name in row}

    monkeypatch.setattr(writer, "to_messages", changed)
    short_run().save(tmp_path / "run.mcap", command="test")
    for damaged in (False, True):
        with pytest.raises(ArtefactError):
            RunLog.load(tmp_path / "run.mcap", damaged=damaged)


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
