"""The live display, on a terminal of which the test has the other end, and in a pipe."""

import io
import os
import re
import sys

import pyte
import pytest

from equipoise.cli import stages as display
from equipoise.cli.output import Output
from equipoise.cli.stages import Stages
from equipoise.progress import StageProgress

pytest.importorskip("pty", reason="there are no pseudo-terminals")


@pytest.fixture(params=[80, 120])
def terminal(request, monkeypatch):
    """Sit down at a terminal, in the test itself; that returns how to read its screen."""
    import fcntl
    import pty
    import struct
    import termios
    import threading

    end, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, request.param, 0, 0))
    screen = pyte.Screen(request.param, 24)
    stream = pyte.ByteStream(screen)

    def listen():
        while True:
            try:
                data = os.read(end, 4096)
            except OSError:
                return
            stream.feed(data)

    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    monkeypatch.setenv("COLUMNS", str(request.param))
    monkeypatch.setenv("TERM", "xterm")

    def shown():
        sys.stdout.flush()
        sys.stderr.flush()
        listener.join(0.4)  # some refreshes of a tenth of a second
        return [line.rstrip() for line in screen.display if line.strip()]

    def sit():
        for name in ("stdout", "stderr"):
            monkeypatch.setattr(sys, name, os.fdopen(os.dup(slave), "w"))
        return shown

    yield sit
    monkeypatch.undo()
    os.close(slave)


def test_bars_move_side_by_side_and_leave_only_lines(terminal):
    terminal = terminal()
    output = Output(as_json=False)
    with output.stages() as show:
        for done in range(0, 100, 7):
            show(StageProgress("train", done, 100, "episodes", "45 % stand"))
            show(StageProgress("select", done / 2, 100, "trials"))
        output.say("words between")
        lines = terminal()
        assert lines[0] == "words between"
        assert [line.split()[0] for line in lines[1:]] == ["train", "select"]
        assert "98 of 100 episodes" in lines[1]
        assert "━" in lines[1]
        show(StageProgress("train", 100, 100, "episodes"))
        show(StageProgress("select", 100, 100, "trials"))
    output.say("the end")
    first, train, select, last = terminal()
    assert (first, last) == ("words between", "the end")
    assert re.fullmatch(r"  train +\d+\.\d s  100 episodes", train)
    assert re.fullmatch(r"  select +\d+\.\d s  100 trials", select)


def test_an_interruption_leaves_no_bar_behind(terminal):
    terminal = terminal()
    output = Output(as_json=False)

    def work():
        with output.stages() as show:
            show(StageProgress("train", 30, 100, "episodes"))
            assert "train" in terminal()[-1]
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    output.say("interrupted")
    assert terminal() == ["interrupted"]


class Clock:
    now = 0.0

    def monotonic(self):
        return self.now


def test_where_there_is_no_terminal_a_long_stage_has_a_line_each_half_minute(monkeypatch):
    from rich.console import Console

    clock, told = Clock(), io.StringIO()
    monkeypatch.setattr(display, "time", clock)
    with Stages(Console(file=told, width=80), quiet=False, redirect=False) as stages:
        for done in range(250):
            clock.now = 0.4 * done
            stages.show(StageProgress("train", done, 250, "episodes"))
        stages.show(StageProgress("train", 250, 250, "episodes"))
    lines = told.getvalue().splitlines()
    assert lines[0].split()[:3] == ["train", "30", "%"]
    assert lines[0].endswith("75 of 250 episodes, about 70 s left")
    assert len(lines) == 4
    assert lines[-1].split() == ["train", "99.6", "s", "250", "episodes"]


def test_with_json_nothing_is_written_where_there_is_no_terminal():
    from rich.console import Console

    told = io.StringIO()
    with Stages(Console(file=told), quiet=True, redirect=False) as stages:
        stages.show(StageProgress("train", 1, 1))
    assert told.getvalue() == ""
