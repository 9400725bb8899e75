"""Logs that were cut or damaged: the sound part is read, or one sentence refuses."""

import random

import pytest

from equipoise.errors import ArtefactError, EquipoiseError
from equipoise.log.conditions import RunEnd
from equipoise.log.run_log import RunLog
from equipoise.outcomes import Outcome
from tests.cli.damage import mutations
from tests.log.made_up import drained


def read_any(path):
    return RunLog.load(path, damaged=True)


@pytest.fixture
def log(tmp_path):
    """A log of four chunks, as a recorder writes it."""
    _, writer = drained(tmp_path / "sound.mcap", 600)
    writer.finish(6.0, RunEnd(outcome=Outcome.SURVIVED))
    return tmp_path / "sound.mcap"


def is_a_prefix(part, whole):
    """Whether all that was read of a damaged log was written so."""
    both = [(part.tables[name], rows) for name, rows in whole.tables.items()]
    same = part.conditions == whole.conditions and part.end in (None, whole.end)
    return same and all(a.tobytes() == b[: len(a)].tobytes() for a, b in both)


def test_what_is_read_of_a_damaged_log_was_written_so(log, tmp_path):
    data, whole = log.read_bytes(), read_any(log)
    draw = random.Random(1)
    places = [*range(0, 600, 16), *(draw.randrange(len(data)) for _ in range(15))]
    flips = (
        data[:place] + bytes([data[place] ^ (1 << i % 8)]) + data[place + 1 :]
        for i, place in enumerate(places)
    )
    cuts = (data[:place] for place in places[38:])
    read, path = 0, tmp_path / "run.mcap"
    for copy in (*flips, *cuts, *mutations(data, 16)):
        path.write_bytes(copy)
        try:
            part = read_any(path)
        except EquipoiseError:
            continue
        read += 1
        assert is_a_prefix(part, whole)
        shorter = any(len(b) < len(whole.tables[n]) for n, b in part.tables.items())
        assert part.damage or not shorter
    assert read > 15


def test_a_cut_log_is_read_to_its_last_chunk_on_request_alone(log):
    data = log.read_bytes()
    log.write_bytes(data[: int(0.6 * len(data))])
    part = read_any(log)
    assert part.damage
    assert 0 < len(part.tables["tick"]) < 600
    with pytest.raises(ArtefactError):
        RunLog.load(log)
