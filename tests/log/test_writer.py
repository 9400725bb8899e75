"""The log of a run on a rig: what is written comes back, and whatever breaks off leaves a file."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from equipoise.control.ticks import OperatorMessage
from equipoise.errors import ArtefactError
from equipoise.log.conditions import RunEnd
from equipoise.log.recorder import CONNECTING, Recorder, push_event
from equipoise.log.run_log import RunLog
from equipoise.log.writer import RunWriter
from equipoise.outcomes import Outcome
from tests.log.made_up import POSTURE, RIG, drained, full_disk, push


def sound_ticks(path):
    return len(RunLog.load(path, damaged=True).tables["tick"])


def test_what_is_written_comes_back(tmp_path):
    path = tmp_path / "run.mcap"
    recorder, writer = drained(path, 250)
    push_event(recorder.event, 2.5, OperatorMessage("stopping", "stop – it fell", ("y", "n")))
    writer.drain(recorder)
    writer.finish(2.5, RunEnd(outcome=Outcome.SURVIVED))
    run = RunLog.load(path)
    assert (run.conditions, run.end) == (RIG, RunEnd(outcome=Outcome.SURVIVED))
    assert run.events == (OperatorMessage("stopping", "stop – it fell", ("y", "n"), 2.5),)
    tick, reply = run.tables["tick"], run.tables["reply"]
    assert tick["time"] == pytest.approx(0.01 * np.arange(250))
    assert np.isnan(tick["x_dot"]).all()
    assert tick["q"][3] == pytest.approx(POSTURE)
    assert np.isnan(reply["torque"]).all()
    assert run.tables["encoder"]["counts"].tolist() == list(range(4096, 4346))


def test_every_number_that_a_protocol_can_carry_comes_back_or_is_unknown(tmp_path):
    recorder, writer = Recorder(7), RunWriter(tmp_path / "run.mcap", RIG, 0.0)
    # A board's counts are 32 bits; the driver goes on beyond their ends.
    counts = [-(2**31), 2**31 - 1, 2**31 + 8192]
    torques = [1.0, 1e300, -np.inf]
    for i, (count, torque) in enumerate(zip(counts, torques, strict=True)):
        recorder.encoder.push(time=0.01 * i, counts=count)
        recorder.reply.push(time=0.01 * i, sent=0.0, q=POSTURE, torque=np.full(7, torque))
    writer.drain(recorder)
    writer.finish(0.1, RunEnd(outcome=Outcome.SURVIVED))
    tables = RunLog.load(tmp_path / "run.mcap").tables
    assert tables["encoder"]["counts"].tolist() == counts
    torques = tables["reply"]["torque"][:, 0].tolist()
    assert torques == pytest.approx([1.0, np.nan, np.nan], nan_ok=True)


def test_a_writer_that_is_killed_leaves_its_chunks(tmp_path):
    path = tmp_path / "run.mcap"
    script = (
        "import sys; from pathlib import Path; from tests.log.made_up import drained\n"
        "drained(Path(sys.argv[1]), 1000); print('written', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", script, str(path)]
    env = os.environ | {"PYTHONPATH": os.pathsep.join(["src", ".", *sys.path])}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, env=env, **pipes) as process:
        assert process.stdout.readline() == b"written\n"
        process.send_signal(signal.SIGKILL)
    assert sound_ticks(path) > 800
    with pytest.raises(ArtefactError):
        RunLog.load(path)


def test_an_existing_log_is_replaced_once_the_run_is_connected(tmp_path):
    path, recorder = tmp_path / "run.mcap", Recorder(7)
    path.write_text("another log")
    writer = RunWriter(path, RIG, 0.0)
    push_event(recorder.event, 0.0, OperatorMessage(CONNECTING, ""))
    writer.drain(recorder)
    writer.finish(1.0, RunEnd())
    assert path.read_text() == "another log"
    _, writer = drained(path, 10)
    writer.finish(1.0, RunEnd(outcome=Outcome.SURVIVED))
    assert sound_ticks(path) == 10
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


def test_a_full_disk_ends_the_log_and_leaves_what_was_written(tmp_path):
    path, room = tmp_path / "run.mcap", 60_000
    with full_disk(room):
        recorder, writer = drained(path, 3000)
        assert writer.problem is not None
        writer.finish(30.0, RunEnd(outcome=Outcome.SURVIVED))
    assert path.stat().st_size <= room
    assert RunLog.load(path, damaged=True).end is None
    assert 100 < sound_ticks(path) < 2900
    # The rings are drained on, so that nothing is dropped that others may want.
    assert recorder.lost == 0


def test_a_ring_that_nobody_drains_drops_and_counts():
    recorder = Recorder(7)
    push(recorder, 1500)
    assert recorder.tick.lost == 500
    assert [len(recorder.tick.take()) for _ in range(2)] == [1000, 0]
    push(recorder, 10)
    assert len(recorder.tick.take()) == 10
