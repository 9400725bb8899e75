"""Run logs: what is written is read, by us and by anybody who reads MCAP; damage is found."""

import io
import json

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from equipoise.errors import ArtefactError, OutsideError
from equipoise.runlog import COLUMNS, FORMAT, RunConditions, RunLog, provenance_of
from equipoise.settings import resolve


def made_up(ticks=40, **changes):
    """A run of random numbers: nothing here depends on what they mean."""
    rng = np.random.default_rng(3)
    conditions = {
        "policy": "sha256:0123",
        "world": "model",
        "arm": "two-link",
        "joints": ("A1", "A2"),
        "held_joint": None,
        "pendulum": {"w2": 70.2, "k": 7.15, "c": 0.15, "coulomb": 0.0, "drag": 0.0},
        "start": (0.0, 0.0, 0.03, 0.2),
        "h": 0.01,
        "duration": 60.0,
        "seed": 4,
        "settings": resolve("paper"),
        "cause": "track",
    }
    columns = {name: rng.standard_normal(ticks) for name in COLUMNS}
    columns |= {"time": 0.01 * np.arange(ticks), "box": rng.integers(0, 270, ticks)}
    columns |= {name: rng.standard_normal((ticks, 2)) for name in ("q", "dq")}
    return RunLog(conditions=RunConditions(**(conditions | changes)), **columns)


@pytest.fixture
def run():
    return made_up()


@pytest.fixture
def file(run, tmp_path):
    run.save(tmp_path / "run.mcap", command="test", inputs={"policy": "sha256:0123"})
    return tmp_path / "run.mcap"


@pytest.mark.parametrize("ticks", [0, 1, 40])
def test_a_run_comes_back_to_the_last_bit(tmp_path, ticks):
    run = made_up(ticks)
    run.save(tmp_path / "deep" / "run.mcap", command="test")
    back = RunLog.load(tmp_path / "deep" / "run.mcap")
    assert back.conditions == run.conditions
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(back, name), getattr(run, name), strict=True)
    assert back.digest == run.digest
    assert back.lasted == pytest.approx(0.01 * ticks)


def test_the_file_says_where_it_comes_from(file):
    provenance = provenance_of(file)
    assert (provenance.command, provenance.inputs) == ("test", {"policy": "sha256:0123"})
    assert "numpy" in provenance.software


def test_any_reader_of_mcap_finds_named_numbers_with_a_schema(file, run):
    with file.open("rb") as stream:
        messages = list(make_reader(stream, validate_crcs=True).iter_messages())
    topics = [channel.topic for _, channel, _ in messages]
    assert topics == ["/run", *["/tick"] * 40, "/end"]
    for schema, channel, message in messages:
        assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
        known = json.loads(schema.data)["properties"]
        assert set(json.loads(message.data)) == set(known)
    _, _, seventh = messages[8]
    tick = json.loads(seventh.data)
    assert seventh.log_time == 70_000_000  # 0.07 s in nanoseconds
    assert tick["phi"] == run.phi[7]
    assert tick["q"] == run.q[7].tolist()
    assert json.loads(messages[-1][2].data) == {"lasted": 0.4, "cause": "track"}


def test_its_arrays_cannot_be_written_to(run):
    with pytest.raises(ValueError, match="read-only"):
        run.phi[0] = 1.0


def test_a_file_cut_anywhere_is_refused(file):
    data = file.read_bytes()
    for length in [0, 1, 8, 100, len(data) // 3, len(data) // 2, len(data) - 100, len(data) - 1]:
        file.write_bytes(data[:length])
        with pytest.raises(ArtefactError, match="make the|record the run again|give a file"):
            RunLog.load(file)


def test_a_damaged_byte_is_found_or_does_no_harm(file, run):
    # The tail of the file repeats the schemas and counts messages, which decides nothing: damaged
    # there, a run may still be read, but then it is the one that was written.
    data = file.read_bytes()
    refused = 0
    for place in range(0, len(data), 29):
        file.write_bytes(data[:place] + bytes([data[place] ^ 0x55]) + data[place + 1 :])
        try:
            assert RunLog.load(file).digest == run.digest
        except ArtefactError:
            refused += 1
    assert refused > 0.3 * len(data) / 29


def edited(file, change):
    """Write the file again, sound to any reader of MCAP, with its messages changed."""
    out = io.BytesIO()
    writer = Writer(out)
    writer.start(profile="", library="")
    with file.open("rb") as stream:
        reader = make_reader(stream)
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, change("metadata", dict(metadata.metadata)))
        channels = {}
        for schema, channel, message in reader.iter_messages():
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "json", number)
            content = change(channel.topic, json.loads(message.data))
            if content is not None:
                data = json.dumps(content, separators=(",", ":"), sort_keys=True).encode()
                writer.add_message(channels[channel.topic], message.log_time, data, 0, 0)
    writer.finish()
    file.write_bytes(out.getvalue())


def test_writing_it_again_unchanged_does_no_harm(file, run):
    edited(file, lambda topic, content: content)
    assert RunLog.load(file).digest == run.digest


EDITS = {
    "a nicer state": lambda t, c: c | {"phi": 0.0} if t == "/tick" else c,
    "another cause": lambda t, c: c | {"cause": "lasted"} if t == "/run" else c,
    "a missing tick": lambda t, c: None if t == "/tick" and c["time"] == 0.2 else c,
    "no conditions": lambda t, c: None if t == "/run" else c,
    "a missing column": lambda t, c: {k: v for k, v in c.items() if k != "u"},
    "an unknown setting": lambda t, c: c | {"luck": 1} if t == "/run" else c,
    "a word for a number": lambda t, c: c | {"x": "far"} if t == "/tick" else c,
    "no digest": lambda t, c: {"version": "1"} if t == "metadata" else c,
    "no version": lambda t, c: {"digest": c["digest"]} if t == "metadata" else c,
}


@pytest.mark.parametrize("edit", EDITS)
def test_an_edited_run_is_refused(file, edit):
    edited(file, EDITS[edit])
    with pytest.raises(ArtefactError, match="record the run again|give a file that it wrote"):
        RunLog.load(file)


def test_a_newer_version_is_refused(file):
    edited(file, lambda t, c: c | {"version": "2"} if t == "metadata" else c)
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


def test_what_is_no_number_or_of_another_length_is_refused(run):
    arrays = {name: getattr(run, name) for name in COLUMNS}
    with pytest.raises(ArtefactError, match="phi .* not finite"):
        RunLog(conditions=run.conditions, **arrays | {"phi": np.full(40, np.nan)})
    with pytest.raises(ArtefactError, match="u .* shape"):
        RunLog(conditions=run.conditions, **arrays | {"u": run.u[1:]})
    with pytest.raises(ArtefactError, match="q .* shape"):
        RunLog(conditions=run.conditions, **arrays | {"q": run.q[:, :1]})


def test_the_format_has_its_name(file):
    with file.open("rb") as stream:
        assert [m.name for m in make_reader(stream).iter_metadata()] == [FORMAT]
