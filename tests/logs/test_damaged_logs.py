"""Logs that were cut or damaged: the sound part is read, or one sentence refuses."""

import random
import struct

import numpy as np
import pytest
from mcap.opcode import Opcode

from equipoise.control.policy import shipped_policy
from equipoise.errors import ArtefactError, EquipoiseError
from equipoise.logs.recorder import Recorder
from equipoise.logs.run_log import RunLog
from equipoise.logs.writer import RunWriter
from equipoise.rig.simulate import simulate_run
from tests.cli.damage import mutations
from tests.rig.replayed import replay

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
        assert part.damage or not shorter
    assert read > 30


def test_the_sound_part_of_a_twins_log_is_replayed(twin_log, tmp_path):
    data = twin_log.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: int(0.7 * len(data))])
    found = replay(read_any(tmp_path / "cut.mcap"), shipped_policy())
    assert found.difference is None
    assert not found.whole
    assert 50 < found.ticks < 200
    with pytest.raises(ArtefactError):
        RunLog.load(tmp_path / "cut.mcap")


def test_a_chunk_that_is_lost_as_a_whole_ends_what_is_read(log, tmp_path):
    data, whole = log.read_bytes(), read_any(log)
    place, chunks = 8, []  # behind the magic
    while data[place] != Opcode.DATA_END:
        length = 9 + struct.unpack_from("<Q", data, place + 1)[0]
        if data[place] == Opcode.CHUNK:
            chunks.append((place, length))
        place += length
    begin, length = chunks[1]
    (tmp_path / "run.mcap").write_bytes(data[:begin] + data[begin + length :])
    part = read_any(tmp_path / "run.mcap")
    assert part.damage
    assert is_a_prefix(part, whole)
