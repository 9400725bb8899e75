"""Run logs: what is written is read, by us and by anybody who reads MCAP; damage is found."""

import io
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from equipoise.errors import ArtefactError, OutsideError
from equipoise.mcapfile import sealed
from equipoise.runlog import (
    COLUMNS,
    FORMAT,
    PARTS,
    EncoderSamples,
    Replies,
    RunConditions,
    RunLog,
    Stream,
    TruthColumns,
    read_header,
)
from equipoise.settings import resolve

OLD = Path(__file__).parent / "data" / "run-v1.mcap"
"""Four ticks of an ideal model, as version 0.1.0 wrote them."""


def conditions(**changes):
    given = {
        "policy": "sha256:0123",
        "world": "twin:nominal-1",
        "arm": "two-link",
        "joints": ("A1", "A2"),
        "held_joint": None,
        "pendulum": {"w2": 70.2, "k": 7.15, "c": 0.15, "coulomb": 0.0, "drag": 0.0},
        "start": (0.0, 0.0, 0.03, 0.2),
        "h": 0.01,
        "duration": 60.0,
        "seed": 4,
        "actuator": "sha256:4567",
        "counts_per_rev": 8192,
        "world_settings": {"transport": 0.01, "cycle": 1, "inner": "velocity", "lag": 1.0},
        "zero_error": 0.002,
        "settings": resolve("paper"),
        "cause": "track",
    }
    return RunConditions(**(given | changes))


def made_up(ticks=40, rig=True):
    """A run of random numbers: nothing here depends on what they mean."""
    rng = np.random.default_rng(3)
    columns = {name: rng.standard_normal(ticks) for name in COLUMNS}
    columns |= {"time": 0.01 * np.arange(ticks), "box": rng.integers(0, 270, ticks)}
    columns |= {name: rng.standard_normal((ticks, 2)) for name in ("q", "dq")}
    if rig:
        columns |= {
            "truth": TruthColumns(
                *rng.standard_normal((4, ticks)), rng.standard_normal((ticks, 2))
            ),
            # The first reply and the first count were measured before the release.
            "stream": Stream(0.005 * np.arange(2 * ticks), rng.standard_normal((2 * ticks, 2))),
            "replies": Replies(0.005 * np.arange(ticks) - 0.004, rng.standard_normal((ticks, 2))),
            "encoder": EncoderSamples(
                0.01 * np.arange(ticks) - 0.001, rng.integers(-4096, 4096, ticks)
            ),
        }
    return RunLog(conditions=conditions(), **columns)


def arrays(run):
    """All arrays of a run by name."""
    ticks = {name: getattr(run, name) for name in COLUMNS}
    parts = {f"{p}.{name}": v for p in PARTS for name, v in getattr(run, p)._asdict().items()}
    return ticks | parts


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
    run = RunLog.of_excitation(
        conditions(policy=""),
        Stream(time, np.column_stack((np.sin(time), np.cos(time)))),
        Replies(time[:-2] + 0.001, np.column_stack((np.sin(time), np.cos(time)))[:-2]),
    )
    run.save(tmp_path / "run.mcap", command="test")
    same(run, RunLog.load(tmp_path / "run.mcap"))
    assert run.lasted == time[-1]
    assert run.q.shape == run.truth.q.shape == (0, 2)
    topics = Counter(channel.topic for _, channel, _ in messages(tmp_path / "run.mcap"))
    assert topics == {"/run": 1, "/stream": 30, "/reply": 28, "/end": 1}


def test_rows_keep_their_order_where_their_time_stamps_jump_back(tmp_path):
    run = made_up()
    jumping = np.array([0.0, 0.02, 0.01, 0.01, 0.4, 0.3])
    counts = np.array([5, 4, 3, 2, 1, 0])
    run = RunLog(**vars(run) | {"encoder": EncoderSamples(jumping, counts)})
    run.save(tmp_path / "run.mcap", command="test")
    same(run, RunLog.load(tmp_path / "run.mcap"))


def test_a_file_of_version_1_is_read():
    run = RunLog.load(OLD)
    n = np.arange(4)
    np.testing.assert_array_equal(run.time, 0.01 * n)
    np.testing.assert_array_equal(run.x, 0.1 * n)
    np.testing.assert_array_equal(run.x_dot, 0.2 * n)
    np.testing.assert_array_equal(run.phi, 0.03 + 0.1 * n)
    np.testing.assert_array_equal(run.phi_dot, 0.2 + 0.1 * n)
    np.testing.assert_array_equal(run.box, 120 + n)
    np.testing.assert_array_equal(run.u, [2.0, -2.0, 0.5, -0.5])
    np.testing.assert_array_equal(run.tracked, [1.9, -1.9, 0.4, -0.4])
    np.testing.assert_array_equal(run.q, [[0.0, 0.5], [0.01, 0.5], [0.02, 0.5], [0.03, 0.5]])
    np.testing.assert_array_equal(run.dq, np.outer(n, [0.1, 0.0]))
    assert (run.conditions.joints, run.conditions.held_joint) == (("A1", "A2"), 2)
    assert (run.conditions.cause, run.lasted) == ("track", 0.04)


def test_version_1_knew_the_ideal_model_alone(tmp_path):
    run = RunLog.load(OLD)
    assert (run.conditions.actuator, run.conditions.counts_per_rev) == ("ideal", None)
    assert (run.conditions.world_settings, run.conditions.zero_error) == (None, None)
    np.testing.assert_array_equal(run.estimated_phi, run.phi)
    np.testing.assert_array_equal(run.estimated_phi_dot, run.phi_dot)
    np.testing.assert_array_equal(run.bias, np.zeros(4))
    assert run.truth.q.shape == run.stream.q.shape == run.replies.q.shape == (0, 2)
    # Written again it has the present version, and is the same run.
    run.save(tmp_path / "run.mcap", command="test")
    same(run, RunLog.load(tmp_path / "run.mcap"))
    assert (read_header(OLD).version, read_header(tmp_path / "run.mcap").version) == (1, 2)


def test_an_edited_file_of_version_1_is_refused(tmp_path):
    file = tmp_path / "run.mcap"
    file.write_bytes(OLD.read_bytes())
    edited(file, lambda topic, content: content)
    RunLog.load(file)
    edited(file, lambda topic, content: content | {"u": 1.0} if topic == "/tick" else content)
    with pytest.raises(ArtefactError, match="does not match its digest"):
        RunLog.load(file)


def test_the_file_says_where_it_comes_from(file, run):
    header = read_header(file)
    assert header.digest == run.digest
    assert (header.provenance.command, header.provenance.inputs) == (
        "test",
        {"policy": "sha256:0123"},
    )
    assert "numpy" in header.provenance.software


def test_any_reader_of_mcap_finds_named_numbers_with_a_schema(file, run):
    found = messages(file)
    topics = [channel.topic for _, channel, _ in found]
    assert Counter(topics[1:-1]) == {
        "/tick": 40,
        "/truth": 40,
        "/stream": 80,
        "/reply": 40,
        "/encoder": 40,
    }
    assert (topics[0], topics[-1]) == ("/run", "/end")
    for schema, channel, message in found:
        assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
        known = json.loads(schema.data)["properties"]
        told = set(json.loads(message.data))
        # A guard is told where one ended the run, friction where a twin has it.
        assert told | ({"guard", "friction"} & set(known)) == set(known)
    assert json.loads(found[-1][2].data) == {"lasted": 0.4, "cause": "track"}


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
    assert (stamp, setpoint) == (39_000_000, {"time": 0.035, "q": [*run.stream.q[7]]})
    stamp, reply = found["/reply"][0]
    assert (stamp, reply) == (0, {"time": -0.004, "q": [*run.replies.q[0]]})
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
            writer.add_metadata(metadata.name, sealed(change("metadata", dict(metadata.metadata))))
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


EDITS = {
    "a nicer state": lambda t, c: c | {"phi": 0.0} if t == "/tick" else c,
    "another cause": lambda t, c: c | {"cause": "lasted"} if t == "/run" else c,
    "a nicer truth": lambda t, c: c | {"x": 0.0} if t == "/truth" else c,
    "another count": lambda t, c: c | {"counts": 7} if t == "/encoder" else c,
    "another setpoint": lambda t, c: c | {"q": [0.0, 0.0]} if t == "/stream" else c,
    "no replies": lambda t, c: None if t == "/reply" else c,
    "half a count": lambda t, c: c | {"counts": 0.5} if t == "/encoder" else c,
    "an old version": lambda t, c: c | {"version": "1"} if t == "metadata" else c,
    "no such version": lambda t, c: c | {"version": "0"} if t == "metadata" else c,
    "a missing tick": lambda t, c: None if t == "/tick" and c["time"] == 0.2 else c,
    "no conditions": lambda t, c: None if t == "/run" else c,
    "a missing column": lambda t, c: {k: v for k, v in c.items() if k != "u"},
    "an unknown setting": lambda t, c: c | {"luck": 1} if t == "/run" else c,
    "a word for a number": lambda t, c: c | {"x": "far"} if t == "/tick" else c,
    "no digest": lambda t, c: {"version": "2"} if t == "metadata" else c,
    "no version": lambda t, c: {"digest": c["digest"]} if t == "metadata" else c,
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
    edited(file, lambda t, c: c | {"version": "3"} if t == "metadata" else c)
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


def changed(run, **columns):
    return RunLog(**vars(run) | columns)


def test_what_is_no_number_is_refused(run):
    with pytest.raises(ArtefactError, match="phi of .* not finite"):
        changed(run, phi=np.full(40, np.nan))
    with pytest.raises(ArtefactError, match="replies.q of .* not finite"):
        changed(run, replies=Replies(np.zeros(1), np.array([[0.0, np.inf]])))
    with pytest.raises(ArtefactError, match="encoder.counts of .* not whole"):
        changed(run, encoder=EncoderSamples(np.zeros(2), np.array([1.0, 1.5])))
    with pytest.raises(ArtefactError, match="box of .* not whole"):
        changed(run, box=run.phi)


def test_columns_of_another_length_are_refused(run):
    with pytest.raises(ArtefactError, match=r"u of .* shape \(39,\), expected \(40,\)"):
        changed(run, u=run.u[1:])
    with pytest.raises(ArtefactError, match=r"q of .* shape \(40, 1\), expected \(40, 2\)"):
        changed(run, q=run.q[:, :1])
    with pytest.raises(ArtefactError, match=r"truth.x of .* shape \(1,\), expected \(40,\)"):
        changed(run, truth=TruthColumns(*[np.zeros(1)] * 4, np.zeros((1, 2))))
    with pytest.raises(ArtefactError, match=r"truth.q of .* shape \(0,\), expected \(40, 2\)"):
        changed(run, truth=run.truth._replace(q=np.empty(0)))
    with pytest.raises(ArtefactError, match=r"stream.q of .* shape \(5, 3\), expected \(5, 2\)"):
        changed(run, stream=Stream(np.zeros(5), np.zeros((5, 3))))
    with pytest.raises(ArtefactError, match=r"encoder.counts of .* expected \(0,\)"):
        changed(run, encoder=EncoderSamples(np.empty(0), np.zeros(3, np.int64)))
    with pytest.raises(ArtefactError, match=r"u of .* shape \(0,\), expected \(40,\)"):
        changed(run, u=np.empty(0))


def test_the_format_has_its_name(file):
    with file.open("rb") as stream:
        assert [m.name for m in make_reader(stream).iter_metadata()] == [FORMAT]
