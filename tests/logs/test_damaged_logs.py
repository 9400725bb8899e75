"""Logs that were cut, damaged or forged: the sound part is read, or one sentence refuses."""

import io
import json
import random
import struct
import tracemalloc
from functools import partial

import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from equipoise.control.policy import shipped_policy
from equipoise.errors import ArtefactError, EquipoiseError
from equipoise.identification.actuator import identify_run
from equipoise.logs import container
from equipoise.logs.container import with_checksum
from equipoise.logs.recorder import Recorder
from equipoise.logs.run_log import RunLog
from equipoise.logs.runs import export, load_run
from equipoise.logs.writer import RunWriter
from equipoise.rig.explanation import explain
from equipoise.rig.simulate import simulate_run
from tests.cli.damage import mutations, outcomes
from tests.studies.replayed import replay

pytestmark = pytest.mark.compiled_only  # the twin takes minutes otherwise


def read_any(path):
    return RunLog.load(path, damaged=True)


@pytest.fixture(scope="module")
def twin_log(tmp_path_factory):
    path = tmp_path_factory.mktemp("twin") / "run.mcap"
    simulate_run(shipped_policy(), world="twin:nominal", duration=2.0).save(path, command="test")
    return path


@pytest.fixture(scope="module")
def short_log(rig_log, tmp_path_factory):
    """The last two seconds of a run on a rig: rows are written again, as a recorder has them."""
    path, run = tmp_path_factory.mktemp("short") / "run.mcap", RunLog.load(rig_log)
    since = float(run.tables["tick"]["time"][-1]) - 2.0
    recorder = Recorder(7)
    writer = RunWriter(path, run.conditions, since)
    recorder.reply.push(*run.tables["reply"][0].tolist())  # where the servo began
    for step in np.arange(since, since + 2.5, 0.1):
        for name, ring in recorder.rings.items():
            rows = run.tables[name]
            for row in rows[(rows["time"] >= step) & (rows["time"] < step + 0.1)]:
                ring.push(*row.tolist())
        writer.drain(recorder)
    writer.finish(since + 2.5, run.end)
    return path


@pytest.fixture(params=["short", "twin"])
def log(request):
    return request.getfixturevalue(f"{request.param}_log")


def verbs(path, out):
    """Do what the verbs do with a log; a refusal by one is no refusal by the others."""
    steps = (
        lambda: RunLog.load(path),
        lambda: explain(read_any(path)),
        lambda: export(read_any(path), out),
        lambda: identify_run(load_run(path)),
    )
    refusals = []
    for step in steps:
        try:
            step()
        except EquipoiseError as error:
            refusals.append(error)
    if len(refusals) == len(steps):
        raise refusals[0]


def bits(data, places):
    """Copies with one bit flipped."""
    for i, place in enumerate(places):
        yield data[:place] + bytes([data[place] ^ (1 << i % 8)]) + data[place + 1 :]


def cuts(data, places):
    return (data[:place] for place in places)


def is_a_prefix(part, whole):
    """Whether all that was read of a damaged log was written so."""
    both = [(part.tables[name], rows) for name, rows in whole.tables.items()]
    same = part.conditions == whole.conditions and part.end in (None, whole.end)
    return same and all(a.tobytes() == b[: len(a)].tobytes() for a, b in both)


def test_what_is_read_of_a_damaged_log_was_written_so(log, tmp_path):
    data, whole = log.read_bytes(), read_any(log)
    draw = random.Random(1)
    places = [*range(0, 600, 8), *(draw.randrange(len(data)) for _ in range(30))]
    read = 0
    path = tmp_path / "run.mcap"
    for copy in (*bits(data, places), *cuts(data, places[75:]), *mutations(data, 32)):
        path.write_bytes(copy)
        try:
            part = read_any(path)
        except EquipoiseError:
            continue
        read += 1
        assert is_a_prefix(part, whole)
        shorter = any(len(b) < len(whole.tables[n]) for n, b in part.tables.items())
        assert part.missing_part or not shorter
    assert read > 30


def test_a_log_ends_where_it_was_cut(log, tmp_path):
    """... and no earlier than half a second before, the content of a chunk."""
    data, whole = log.read_bytes(), read_any(log)

    def reach(run):
        return len(run.tables["tick"])

    path, reached = tmp_path / "run.mcap", []
    for share in (0.4, 0.5, 0.7):  # behind four fifths a twin's log has but an index
        path.write_bytes(data[: int(share * len(data))])
        reached.append(reach(read_any(path)))
        assert "cut short" in read_any(path).missing_part
    assert reached == sorted(reached)
    assert reached[0] > 0
    assert reached[-1] > 0.4 * reach(whole)


def test_the_sound_part_of_a_twins_log_is_replayed(twin_log, tmp_path):
    data = twin_log.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: int(0.7 * len(data))])
    found = replay(read_any(tmp_path / "cut.mcap"), shipped_policy())
    assert found.difference is None
    assert not found.whole
    assert 50 < found.ticks < 200
    with pytest.raises(
        ArtefactError, match=r"is cut short.* at byte .*sound before that: .* ticks"
    ):
        RunLog.load(tmp_path / "cut.mcap")


def test_a_damaged_log_has_two_outcomes(log, tmp_path):
    use = partial(verbs, out=tmp_path / "csv")
    found = outcomes(lambda path: path, tmp_path / "run.mcap", mutations(log.read_bytes(), 16), use)
    assert found["read"] > 2


@pytest.mark.slow
def test_a_damaged_log_has_two_outcomes_some_thousand_times(log, tmp_path):
    data, draw = log.read_bytes(), random.Random(2)
    use = partial(verbs, out=tmp_path / "csv")
    places = [draw.randrange(len(data)) for _ in range(1000)]
    for damaged in (bits(data, [*range(1000), *places]), cuts(data, places), mutations(data, 2000)):
        found = outcomes(lambda path: path, tmp_path / "run.mcap", damaged, use)
        assert found["read"] > 100


# Logs that somebody forged: checksums fit, numbers do not.


VALUES = (None, True, -1, 0, 1.5, 1e300, -1e300, float("nan"), float("inf"), 2**70, 10**4000,
          "", "x", "5", "\x1b[2J", [], {}, [[]], ["a"], {"a": 1}, 1e-300, -5, 3600.0)  # fmt: skip


def parts(value, path=()):
    """Yield where something stands in a document."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, below in items:
        yield (*path, key)
        if isinstance(below, dict | list):
            yield from parts(below, (*path, key))


def change(document, draw):
    """Replace or remove a part."""
    *above, last = draw.choice(list(parts(document)))
    for key in above:
        document = document[key]
    if draw.random() < 0.15:
        del document[last]
    else:
        document[last] = draw.choice(VALUES)


def forged(data, count, seed=0):
    """Yield copies whose conditions, end or rows hold something else, with fitting checksums."""
    reader = make_reader(io.BytesIO(data))
    (metadata,) = reader.iter_metadata()
    messages = list(reader.iter_messages(log_time_order=False))
    for i in range(count):
        draw = random.Random(f"{seed} {i}")
        entries = dict(metadata.metadata)
        changed = {}
        heads = [n for n, (_, c, _) in enumerate(messages) if c.topic == "/end"]
        target = draw.choice(["metadata", "metadata", "head", "head", "row"])
        if target == "metadata":
            conditions = json.loads(entries["conditions"])
            change(conditions, draw)
            entries["conditions"] = json.dumps(conditions)
        else:
            number = draw.choice(heads) if target != "row" else draw.randrange(len(messages))
            content = json.loads(messages[number][2].data)
            change(content, draw)
            changed[number] = json.dumps(content, separators=(",", ":"), sort_keys=True).encode()
        out = io.BytesIO()
        writer = Writer(out)
        writer.start(profile="", library="")
        writer.add_metadata(metadata.name, with_checksum(entries))
        channels = {}
        for number, (schema, channel, message) in enumerate(messages):
            if channel.topic not in channels:
                place = writer.register_schema(schema.name, "jsonschema", b"{}")
                channels[channel.topic] = writer.register_channel(channel.topic, "json", place)
            text = changed.get(number, message.data)
            writer.add_message(channels[channel.topic], message.log_time, text, 0, number)
        writer.finish()
        yield out.getvalue()


def forge(log, tmp_path, monkeypatch, count):
    monkeypatch.setattr(RunLog, "digest", _AnyText())
    use = partial(verbs, out=tmp_path / "csv")
    return outcomes(lambda path: path, tmp_path / "run.mcap", forged(log.read_bytes(), count), use)


class _AnyText:
    """A digest that equals what any file states."""

    def __get__(self, *_):
        return self

    def __eq__(self, other):
        return True

    def __ne__(self, other):
        return False

    def __hash__(self):
        return 0

    def __getitem__(self, _):
        return "sha256:as stated"


def test_a_forged_log_has_two_outcomes(log, tmp_path, monkeypatch):
    found = forge(log, tmp_path, monkeypatch, 12)
    assert found["refused"] > 2


@pytest.mark.slow
def test_a_forged_log_has_two_outcomes_a_thousand_times(log, tmp_path, monkeypatch):
    found = forge(log, tmp_path, monkeypatch, 1500)
    assert found["refused"] > 100


def test_sizes_that_a_file_claims_take_no_memory(log, tmp_path):
    """A record of 2^60 bytes, a chunk of 8 GB, zeros compressed a thousandfold, many joints."""
    data = log.read_bytes()
    bomb = zstandard.compress(bytes(1 << 28))
    unsized = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(1 << 28))

    def chunk(content, size, compression=b"zstd"):
        body = struct.pack("<QQQI", 0, 0, size, 0) + struct.pack("<I", len(compression))
        body += compression + struct.pack("<Q", len(content)) + content
        return struct.pack("<BQ", 6, len(body)) + body

    begin = data[: data.index(b"\x06", 200)]
    (metadata,) = make_reader(io.BytesIO(data)).iter_metadata()
    conditions = json.loads(metadata.metadata["conditions"])
    conditions["arm"]["joints"] *= 10_000
    out = io.BytesIO()
    writer = Writer(out)
    writer.start(profile="", library="")
    many = dict(metadata.metadata) | {"conditions": json.dumps(conditions)}
    writer.add_metadata(metadata.name, with_checksum(many))
    writer.finish()
    hostile = [
        begin + struct.pack("<BQ", kind, 2**60) for kind in (1, 6, 12, 200)
    ] + [
        container.MAGIC + chunk(bomb, 1 << 33),
        container.MAGIC + chunk(bomb, 1000),
        container.MAGIC + chunk(unsized, 1000),
        container.MAGIC + chunk(bomb, 1 << 28),
        container.MAGIC + chunk(b"abc", 1 << 24, b"lz4"),
        container.MAGIC + struct.pack("<BQ", 12, 20) + b"\xff" * 20,
        out.getvalue(),
    ]  # fmt: skip
    path = tmp_path / "run.mcap"
    for content in hostile:
        path.write_bytes(content)
        tracemalloc.start()
        try:
            with pytest.raises(EquipoiseError):
                load_run(path)
            assert tracemalloc.get_traced_memory()[1] < 5 * container.MAX_CHUNK_SIZE
        finally:
            tracemalloc.stop()


def test_a_gap_in_the_sequence_ends_what_is_read(log, tmp_path):
    """A chunk that is lost as a whole leaves checksums that fit."""
    data, whole = log.read_bytes(), read_any(log)
    place, chunks = len(container.MAGIC), []
    while data[place] != container.DATA_END:
        length = 9 + struct.unpack_from("<Q", data, place + 1)[0]
        if data[place] == container.CHUNK_RECORD:
            chunks.append((place, length))
        place += length
    begin, length = chunks[1]
    (tmp_path / "run.mcap").write_bytes(data[:begin] + data[begin + length :])
    part = read_any(tmp_path / "run.mcap")
    assert "lacks messages" in part.missing_part
    assert is_a_prefix(part, whole)


def test_a_sound_log_stays_one_for_every_reader_of_mcap(log):
    records = list(StreamReader(io.BytesIO(log.read_bytes()), validate_crcs=True).records)
    assert len(records) > 10
    assert read_any(log).missing_part == ""
    assert np.isfinite(load_run(log).phi).all()
