"""Run logs: what is written is read, by us and by anybody who reads MCAP; damage is found."""

import io
import json
from collections import Counter

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from equipoise.errors import ArtefactError, OutsideError
from equipoise.logs.conditions import RunEnd
from equipoise.logs.container import with_checksum
from equipoise.logs.layout import TABLES
from equipoise.logs.run_log import RunLog
from equipoise.logs.writer import FORMAT
from equipoise.outcomes import Outcome
from tests.logs.made_up import arrays, columns, conditions, made_up


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


@pytest.mark.parametrize("rig", [True, False])
@pytest.mark.parametrize("ticks", [0, 1, 40])
def test_a_run_comes_back_to_the_last_bit(tmp_path, ticks, rig):
    run = made_up(ticks, rig)
    run.save(tmp_path / "deep" / "run.mcap", command="test")
    back = RunLog.load(tmp_path / "deep" / "run.mcap")
    same(run, back)
    assert back.lasted == pytest.approx(0.01 * ticks)
    assert [len(part[0]) for part in (back.truth, back.stream, back.replies, back.encoder)] == (
        [ticks, 2 * ticks, ticks, ticks] if rig else [0, 0, 0, 0]
    )


def test_numbers_keep_their_kinds(file):
    back = RunLog.load(file)
    kinds = {name: type(value) for name, value in back.conditions.world_settings.items()}
    assert kinds == {"transport": float, "cycle": int, "inner": str, "lag": float}
    whole = {name for name, values in arrays(back).items() if values.dtype == np.int64}
    assert whole == {"box", "encoder.counts"}


def test_an_excitation_of_the_arm_has_no_ticks(tmp_path):
    time = 0.005 * np.arange(30)
    q = np.tile(np.sin(time)[:, None], 7)
    run = RunLog.simulated(
        conditions(policy=""),
        RunEnd(outcome=Outcome.EXCITED),
        {},
        stream={"time": time, "q": q},
        replies={"time": time[:-2] + 0.001, "q": q[:-2]},
    )
    run.save(tmp_path / "run.mcap", command="test")
    same(run, RunLog.load(tmp_path / "run.mcap"))
    assert run.lasted == time[-1]
    assert run.q.shape == run.truth.q.shape == (0, 7)
    topics = Counter(channel.topic for _, channel, _ in messages(tmp_path / "run.mcap"))
    assert {topic: topics[topic] for topic in ("/stream", "/reply", "/tick", "/end")} == {
        "/stream": 30,
        "/reply": 28,
        "/tick": 0,
        "/end": 1,
    }


def test_rows_keep_their_order_where_their_time_stamps_jump_back(tmp_path):
    jumping = {"time": np.array([0.0, 0.02, 0.01, 0.01, 0.4, 0.3]), "counts": np.arange(6)}
    run = made_up(encoder=jumping)
    run.save(tmp_path / "run.mcap", command="test")
    same(run, RunLog.load(tmp_path / "run.mcap"))


def test_the_file_says_where_it_comes_from(file):
    provenance = RunLog.load(file).provenance
    assert (provenance.command, provenance.inputs) == ("test", {"policy": "sha256:0123"})
    assert "numpy" in provenance.software


def test_any_reader_of_mcap_finds_named_numbers_with_a_schema(file, run):
    found = messages(file)
    topics = [channel.topic for _, channel, _ in found]
    assert {name: Counter(topics)[f"/{name}"] for name in TABLES} == {
        "tick": 40,
        "truth": 40,
        "stream": 80,
        "reply": 40,
        "encoder": 40,
        "event": 0,
    }
    assert topics[-1] == "/end"
    for schema, channel, message in found:
        assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
        if channel.topic != "/end":
            known = json.loads(schema.data)["properties"]
            assert set(json.loads(message.data)) <= set(known)
    (tick,) = {schema.data for schema, channel, _ in found if channel.topic == "/tick"}
    assert json.loads(tick)["properties"]["u"]["description"].endswith("[m/s^2]")
    end = json.loads(found[-1][2].data)
    assert end == {"lasted": 0.4, "outcome": "track", "digest": run.digest}


def test_each_message_stands_at_its_time_in_the_file(file, run):
    found = {}
    for _, channel, message in messages(file):
        found.setdefault(channel.topic, []).append((message.log_time, json.loads(message.data)))
    # Nanoseconds since the first row: a reply that was measured 4 ms before the release.
    stamp, tick = found["/tick"][7]
    assert (stamp, tick["phi"], tick["q"]) == (74_000_000, run.phi[7], run.q[7].tolist())
    stamp, truth = found["/truth"][7]
    assert (stamp, truth["phi"], truth["q"]) == (74_000_000, run.truth.phi[7], [*run.truth.q[7]])
    stamp, setpoint = found["/stream"][7]
    sent = {"time": 0.035, "q": [*run.stream.q[7]]}
    assert (stamp, setpoint) == (39_000_000, sent)
    stamp, reply = found["/reply"][0]
    measured = {"time": -0.004, "sent": -0.004, "q": [*run.replies.q[0]]}
    assert (stamp, reply) == (0, measured)
    stamp, sample = found["/encoder"][7]
    assert (stamp, sample["counts"]) == (73_000_000, run.encoder.counts[7])
    assert found["/end"][0][0] == 404_000_000
    with file.open("rb") as stream:
        as_written = make_reader(stream).iter_messages(log_time_order=False)
        stamps = [message.log_time for _, _, message in as_written]
    assert stamps == sorted(stamps)


def test_its_arrays_cannot_be_written_to(run):
    for values in arrays(run).values():
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 1


def test_a_file_cut_anywhere_is_refused(file, run):
    data = file.read_bytes()
    for length in [0, 1, 8, 100, len(data) // 3]:
        file.write_bytes(data[:length])
        with pytest.raises(ArtefactError, match="record the run again|give a file"):
            RunLog.load(file)
    # Behind the last row stand an index and the schemas once more.
    file.write_bytes(data[:-100])
    assert RunLog.load(file).digest == run.digest


def test_a_damaged_byte_is_found_or_does_no_harm(file, run):
    # The tail of the file repeats the schemas and counts messages, which decides nothing: damaged
    # there, a run may still be read, but then it is the one that was written.
    data = file.read_bytes()
    refused = 0
    for place in range(0, len(data), 97):
        file.write_bytes(data[:place] + bytes([data[place] ^ 0x55]) + data[place + 1 :])
        try:
            assert RunLog.load(file).digest == run.digest
        except ArtefactError:
            refused += 1
    assert refused > 0.3 * len(data) / 97


def edited(file, change):
    """Write the file again, sound to any reader of MCAP, with its messages changed."""
    out = io.BytesIO()
    writer = Writer(out)
    writer.start(profile="", library="")
    with file.open("rb") as stream:
        reader = make_reader(stream)
        for metadata in reader.iter_metadata():
            writer.add_metadata(
                metadata.name, with_checksum(change("metadata", dict(metadata.metadata)))
            )
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


def test_writing_it_again_unchanged_does_no_harm(file, run):
    edited(file, lambda topic, content: content)
    assert RunLog.load(file).digest == run.digest


def conditions_with(entries, **changes):
    told = json.loads(entries["conditions"]) | changes
    return entries | {"conditions": json.dumps(told)}


EDITS = {
    "a nicer state": lambda t, c: c | {"phi": 0.0} if t == "/tick" else c,
    "another cause": lambda t, c: c | {"outcome": "lasted"} if t == "/end" else c,
    "another seed": lambda t, c: conditions_with(c, seed=5) if t == "metadata" else c,
    "a nicer truth": lambda t, c: c | {"x": 0.0} if t == "/truth" else c,
    "another count": lambda t, c: c | {"counts": 7} if t == "/encoder" else c,
    "another setpoint": lambda t, c: c | {"q": [0.0] * 7} if t == "/stream" else c,
    "no replies": lambda t, c: None if t == "/reply" else c,
    "half a count": lambda t, c: c | {"counts": 0.5} if t == "/encoder" else c,
    "an old version": lambda t, c: c | {"version": "1"} if t == "metadata" else c,
    "no such version": lambda t, c: c | {"version": "0"} if t == "metadata" else c,
    "a missing tick": lambda t, c: None if t == "/tick" and c["time"] == 0.2 else c,
    "no conditions": lambda t, c: {**c, "conditions": ""} if t == "metadata" else c,
    "a missing column": lambda t, c: {k: v for k, v in c.items() if k != "u"},
    "an unknown setting": lambda t, c: conditions_with(c, luck=1) if t == "metadata" else c,
    "a word for a number": lambda t, c: c | {"x": "far"} if t == "/tick" else c,
    "no digest": lambda t, c: {"lasted": 0.4} if t == "/end" else c,
    "no version": lambda t, c: {k: v for k, v in c.items() if k != "version"},
}


@pytest.mark.parametrize("edit", EDITS)
def test_an_edited_run_is_refused(file, edit):
    edited(file, EDITS[edit])
    with pytest.raises(ArtefactError, match="record the run again|give a file that it wrote"):
        RunLog.load(file)


def test_conditions_that_only_a_newer_program_knows_are_refused_by_name(file):
    edited(file, EDITS["an unknown setting"])
    with pytest.raises(ArtefactError, match="does not know the field luck; upgrade it"):
        RunLog.load(file)


def test_a_newer_version_is_refused(file):
    edited(file, lambda t, c: c | {"version": "9"} if t == "metadata" else c)
    with pytest.raises(ArtefactError, match="upgrade Equipoise"):
        RunLog.load(file)


def test_other_files_are_refused(tmp_path):
    with pytest.raises(ArtefactError, match="there is no file"):
        RunLog.load(tmp_path / "nowhere.mcap")
    with pytest.raises(ArtefactError, match="cannot read"):
        RunLog.load(tmp_path)
    (tmp_path / "text.mcap").write_text("time,phi\n")
    with pytest.raises(ArtefactError, match="not an MCAP file"):
        RunLog.load(tmp_path / "text.mcap")
    with (tmp_path / "foreign.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="", library="")
        writer.finish()
    with pytest.raises(ArtefactError, match="no run log of Equipoise"):
        RunLog.load(tmp_path / "foreign.mcap")


def test_a_disk_that_refuses_leaves_nothing(run, tmp_path):
    (tmp_path / "taken").write_text("a file where a folder should be")
    with pytest.raises(OutsideError, match="cannot write"):
        run.save(tmp_path / "taken" / "run.mcap", command="test")
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def changed(table, **new):
    """A run with other columns in one of its tables."""
    return made_up(**{table: columns()[table] | new})


def test_what_is_no_number_is_refused():
    with pytest.raises(ArtefactError, match="phi of table tick .* not finite"):
        changed("ticks", phi=np.full(40, np.nan))
    with pytest.raises(ArtefactError, match="q of table reply .* not finite"):
        changed("replies", time=np.zeros(1), q=np.full((1, 7), np.inf))
    with pytest.raises(ArtefactError, match="counts of table encoder .* not whole"):
        changed("encoder", time=np.zeros(2), counts=np.array([1.0, 1.5]))
    with pytest.raises(ArtefactError, match="box of table tick .* not whole"):
        changed("ticks", box=np.full(40, 0.5))


def test_columns_of_another_length_are_refused():
    with pytest.raises(ArtefactError, match=r"u of .* shape \(39,\), expected \(40,\)"):
        changed("ticks", u=np.zeros(39))
    with pytest.raises(ArtefactError, match=r"q of .* shape \(40, 1\), expected \(40, 7\)"):
        changed("ticks", q=np.zeros((40, 1)))
    with pytest.raises(ArtefactError, match=r"x of table truth .* \(1,\), expected \(40,\)"):
        changed("truth", x=np.zeros(1))
    with pytest.raises(ArtefactError, match=r"q of table stream .* \(5, 3\), expected \(5, 7\)"):
        changed("stream", time=np.zeros(5), q=np.zeros((5, 3)))


def test_the_format_has_its_name(file):
    with file.open("rb") as stream:
        assert [m.name for m in make_reader(stream).iter_metadata()] == [FORMAT]
