"""The log of a run on a rig: what is written comes back, and whatever breaks off leaves a file."""

import io
import os
import signal
import subprocess
import sys
from collections import Counter

import numpy as np
import pytest
from mcap.reader import make_reader

from equipoise.errors import ArtefactError
from equipoise.logs import writer as log_writer
from equipoise.logs.conditions import RunEnd
from equipoise.logs.container import MAGIC
from equipoise.logs.layout import TABLES
from equipoise.logs.recorder import Recorder, push_event, read_events
from equipoise.logs.run_log import RunLog
from equipoise.logs.writer import TAIL, RunWriter
from equipoise.outcomes import Outcome
from tests.logs.made_up import rig_conditions

CONDITIONS = rig_conditions()
POSTURE = np.linspace(0.0, 0.6, 7)


def push(recorder, ticks, begin=0):
    for i in range(begin, begin + ticks):
        t = 0.01 * i
        recorder.tick.push(
            t, 1e-5, 2e-4, 3, 0.1, np.nan, 0.2, 0.3, 17, -2.0, 0.2, 0.3, 0.0, POSTURE, POSTURE
        )
        recorder.stream.push(t, POSTURE)
        recorder.reply.push(t, t - 0.004, POSTURE, np.full(7, np.nan), t)
        recorder.encoder.push(t, 4096 + i, 0, 0, 0, t)


def drained(path, ticks, recorder=None):
    recorder = recorder or Recorder(7)
    writer = RunWriter(path, CONDITIONS, 0.0)
    for begin in range(0, ticks, 100):
        push(recorder, min(100, ticks - begin), begin)
        writer.drain(recorder)
    return recorder, writer


def counted(path):
    """Number of messages by topic, as MCAP's own reader counts them."""
    reader = make_reader(io.BytesIO(path.read_bytes()), validate_crcs=True)
    reader.get_summary()
    return Counter(channel.topic for _, channel, _ in reader.iter_messages())


def test_what_is_written_comes_back(tmp_path):
    path = tmp_path / "run.mcap"
    recorder, writer = drained(path, 250)
    push_event(recorder.event, 2.5, "stopping", ("y", "n"), "stop – it fell")
    writer.drain(recorder)
    writer.finish(2.5, RunEnd(outcome=Outcome.LASTED))
    run = RunLog.load(path, damaged=True)
    assert run.conditions == CONDITIONS
    assert run.end == RunEnd(outcome=Outcome.LASTED)
    assert run.events == ((2.5, "stopping", ("y", "n"), "stop – it fell"),)
    tick, reply = run.tables["tick"], run.tables["reply"]
    assert tick["time"] == pytest.approx(0.01 * np.arange(250))
    assert np.isnan(tick["x_dot"]).all()
    assert tick["q"][3] == pytest.approx(POSTURE)
    assert np.isnan(reply["torque"]).all()
    assert run.tables["encoder"]["counts"].tolist() == list(range(4096, 4346))
    assert counted(path) == {
        **dict.fromkeys(("/tick", "/stream", "/reply", "/encoder"), 250),
        "/event": 1,
        "/end": 1,
        "/robot_description": 1,
        **dict.fromkeys(("/tf", "/joint_states"), 63),
    }


def test_after_each_chunk_the_file_is_one_that_every_reader_takes(tmp_path):
    path, sizes = tmp_path / "run.mcap", set()
    recorder = Recorder(7)
    writer = RunWriter(path, CONDITIONS, 0.0)
    assert RunLog.load(path, damaged=True).conditions == CONDITIONS
    for begin in range(0, 2000, 100):
        push(recorder, 100, begin)
        writer.drain(recorder)
        found = counted(path)
        count = sum(found[f"/{name}"] for name in TABLES)
        run = RunLog.load(path, damaged=True)
        # Ticks of which a later message is missing are left out.
        assert count - 1 <= sum(map(len, run.tables.values())) <= count
        assert run.end is None
        sizes.add(count)
    assert len(sizes) > 3
    # No more is kept back than a chunk, of which a second has 200 kB.
    assert max(sizes) > 4 * 2000 - 4 * 160


def test_a_torn_tail_leaves_what_stands_before_it(tmp_path):
    path = tmp_path / "run.mcap"
    drained(path, 1500)
    whole = path.read_bytes()
    before = len(RunLog.load(path, damaged=True).tables["tick"])
    for cut in range(len(whole) - len(TAIL), len(whole), 7):
        path.write_bytes(whole[:cut])
        assert len(RunLog.load(path, damaged=True).tables["tick"]) == before
    path.write_bytes(whole[: len(whole) // 2])
    assert 0 < len(RunLog.load(path, damaged=True).tables["tick"]) < before


def test_a_writer_that_is_killed_leaves_its_chunks(tmp_path):
    path = tmp_path / "run.mcap"
    script = (
        "import sys; from pathlib import Path; from tests.logs.test_writer import drained\n"
        "drained(Path(sys.argv[1]), 1000); print('written', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(["src", ".", *sys.path])},
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"written\n"
        process.send_signal(signal.SIGKILL)
    assert counted(path).total() > 3000
    assert len(RunLog.load(path, damaged=True).tables["tick"]) > 800


def test_a_full_disk_ends_the_log_and_leaves_it_whole(tmp_path, monkeypatch):
    path, room = tmp_path / "run.mcap", 60_000
    real = os.pwrite

    def full(file, data, place):
        taken = data[: max(room - place, 0)]
        if data and not taken:
            raise OSError(28, "No space left on device")
        return real(file, taken, place)

    monkeypatch.setattr(log_writer.os, "pwrite", full)
    recorder, writer = drained(path, 3000)
    assert writer.problem is not None
    assert "no space left" in writer.problem.lower()
    writer.finish(30.0, RunEnd(outcome=Outcome.LASTED))
    assert path.stat().st_size <= room
    assert counted(path).total() > 500
    assert RunLog.load(path, damaged=True).end is None
    # The rings are drained on, so that nothing is dropped that others may want.
    assert recorder.lost == 0


def test_a_ring_that_nobody_drains_drops_and_counts():
    recorder = Recorder(7)
    push(recorder, 1500)
    assert recorder.tick.lost == 500
    assert len(recorder.tick.take()) == 1000
    assert recorder.tick.take().size == 0
    push(recorder, 10)
    assert len(recorder.tick.take()) == 10


def test_rings_lie_in_memory_that_two_share():
    buffer = bytearray(Recorder.buffer_size(7))
    one, other = Recorder(7, buffer), Recorder(7, buffer)
    push(one, 3)
    assert other.stream.take()["time"] == pytest.approx([0.0, 0.01, 0.02])
    push_event(one.notices, 1.0, "lift", (), "Lift the pendulum.")
    assert read_events(other.notices.take()) == [(1.0, "lift", (), "Lift the pendulum.")]
    other.typed.push(b"stop")
    assert one.typed.take()["word"].tolist() == [b"stop"]
    one.pulse[0] = 5.0
    assert other.pulse[0] == 5.0


@pytest.mark.parametrize("content", [b"", b"hello", TAIL])
def test_what_is_no_log_is_refused(tmp_path, content):
    path = tmp_path / "run.mcap"
    with pytest.raises(ArtefactError, match="there is no file"):
        RunLog.load(path, damaged=True)
    path.write_bytes(content)
    with pytest.raises(ArtefactError, match="is not an MCAP file"):
        RunLog.load(path, damaged=True)
    path.write_bytes(MAGIC + content)
    with pytest.raises(ArtefactError, match="no run log of Equipoise|in its header"):
        RunLog.load(path, damaged=True)
