"""Run logs: what is written is read, by us and by anybody who reads MCAP; edits are refused."""

import io
import json
from collections import Counter

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from equipoise.errors import ArtefactError, OutsideError
from equipoise.logs.columns import TABLES
from equipoise.logs.conditions import RunEnd
from equipoise.logs.run_log import RunLog, simulated_log
from equipoise.outcomes import Outcome
from tests.logs.made_up import arrays, conditions, made_up


def messages(file):
    with file.open("rb") as stream:
        return list(make_reader(stream, validate_crcs=True).iter_messages())


def same(one, other):
    assert one.conditions == other.conditions
    for name, values in arrays(one).items():
        np.testing.assert_array_equal(arrays(other)[name], values, strict=True)
    assert one.digest == other.digest


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
    same(run, back)
    assert (back.lasted, back.damage) == (run.lasted, "")
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


def test_its_arrays_cannot_be_written_to(run):
    for values in arrays(run).values():
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 1


def edited(file, change):
    """Write the file again, sound to any reader of MCAP, with its messages changed."""
    out = io.BytesIO()
    writer = Writer(out)
    writer.start(profile="", library="")
    with file.open("rb") as stream:
        reader = make_reader(stream)
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, change("metadata", dict(metadata.metadata)))
        channels, sequence = {}, 0
        for schema, channel, message in reader.iter_messages():
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "json", number)
            content = change(channel.topic, json.loads(message.data))
            if content is not None:
                data = json.dumps(content, separators=(",", ":"), sort_keys=True).encode()
                writer.add_message(channels[channel.topic], message.log_time, data, 0, sequence)
                sequence += 1
    writer.finish()
    file.write_bytes(out.getvalue())


def conditions_with(entries, **changes):
    return entries | {"conditions": json.dumps(json.loads(entries["conditions"]) | changes)}


EDITS = {
    "half a count": lambda t, c: c | {"counts": 0.5} if t == "/encoder" else c,
    "no conditions": lambda t, c: {**c, "conditions": ""} if t == "metadata" else c,
    "an unknown setting": lambda t, c: conditions_with(c, luck=1) if t == "metadata" else c,
    "a word for a number": lambda t, c: c | {"x": "far"} if t == "/tick" else c,
    "a huge number": lambda t, c: c | {"x": 1e300} if t == "/tick" else c,
    "a short posture": lambda t, c: c | {"q": c["q"][:3]} if t == "/stream" else c,
    "no such phase": lambda t, c: c | {"state": 99} if t == "/tick" else c,
    "no object": lambda t, c: [1] if t == "/end" else c,
}


@pytest.mark.parametrize("edit", EDITS)
def test_a_run_of_another_form_is_refused(file, edit):
    edited(file, EDITS[edit])
    for damaged in (False, True):
        with pytest.raises(ArtefactError):
            RunLog.load(file, damaged=damaged)


def test_other_files_are_refused(tmp_path):
    (tmp_path / "text.mcap").write_text("time,phi\n")
    (tmp_path / "empty.mcap").write_bytes(b"")
    with (tmp_path / "foreign.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="", library="")
        writer.finish()
    for name in ("nowhere.mcap", "text.mcap", "empty.mcap", "foreign.mcap", ""):
        with pytest.raises(ArtefactError):
            RunLog.load(tmp_path / name, damaged=True)


def test_a_disk_that_refuses_leaves_nothing(run, tmp_path):
    (tmp_path / "taken").write_text("a file where a folder should be")
    with pytest.raises(OutsideError):
        run.save(tmp_path / "taken" / "run.mcap", command="test")
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]
