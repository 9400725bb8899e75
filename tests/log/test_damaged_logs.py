"""Logs that were cut or damaged: the sound part is read, or one sentence refuses."""

import random

from equipoise import EquipoiseError, RunLog
from equipoise.log.conditions import RunEnd
from equipoise.outcomes import Outcome
from tests.cli.damage import mutations
from tests.log.made_up import drained


def is_a_prefix(part, whole):
    """Whether all that was read of a damaged log was written so."""
    both = [(part.tables[name], rows) for name, rows in whole.tables.items()]
    same = part.conditions == whole.conditions and part.end in (None, whole.end)
    return same and all(a.tobytes() == b[: len(a)].tobytes() for a, b in both)


def test_what_is_read_of_a_damaged_log_was_written_so(tmp_path):
    sound, draw = tmp_path / "sound.mcap", random.Random(1)
    _, writer = drained(sound, 600)  # four chunks
    writer.finish(6.0, RunEnd(outcome=Outcome.SURVIVED))
    data, whole = sound.read_bytes(), RunLog.load(sound)
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
            part = RunLog.load(path, damaged=True)
        except EquipoiseError:
            continue
        read += 1
        assert is_a_prefix(part, whole)
        shorter = any(len(b) < len(whole.tables[n]) for n, b in part.tables.items())
        assert part.damage or not shorter
    assert read > 15
