"""The operator's terminal: a real one, of which the test has the other end."""

import os
import pty
import select
import sys
import termios
from contextlib import suppress

import pytest

from equipoise.cli.output import Output
from equipoise.cli.terminal_operator import TerminalOperator, single_keys
from equipoise.control.ticks import OperatorMessage


class Terminal:
    """The keyboard's and the screen's end of a pseudo-terminal."""

    def __init__(self):
        self.end, slave = pty.openpty()
        self.keyboard = os.fdopen(slave, encoding="utf-8")
        self.screen = os.fdopen(os.dup(slave), "w", encoding="utf-8")

    def type(self, text):
        os.write(self.end, text.encode())
        # A terminal's line discipline takes a moment.
        select.select([self.keyboard], [], [], 1.0)

    def shows(self):
        shown = b""
        while select.select([self.end], [], [], 0.05)[0]:
            shown += os.read(self.end, 4096)
        return shown.decode()

    @property
    def modes(self):
        return termios.tcgetattr(self.keyboard)

    def hang_up(self):
        os.close(self.end)
        self.end = -1

    def close(self):
        self.keyboard.close()
        self.screen.close()
        if self.end >= 0:
            os.close(self.end)


@pytest.fixture
def seat(monkeypatch):
    """Put somebody at a terminal; in the test itself, for pytest has its own streams until then."""
    terminals = []

    def sit():
        terminals.append(terminal := Terminal())
        monkeypatch.setattr(sys, "stdin", terminal.keyboard)
        monkeypatch.setattr(sys, "stdout", terminal.screen)
        return terminal, TerminalOperator(Output(as_json=False))

    yield sit
    monkeypatch.undo()
    for terminal in terminals:
        terminal.close()


def test_each_key_is_heard_at_once_and_not_shown(seat):
    terminal, console = seat()
    before = terminal.modes
    with single_keys():
        assert not terminal.modes[3] & (termios.ICANON | termios.ECHO)
        # Ctrl-C stays what it is: a signal, which stops as well.
        assert terminal.modes[3] & termios.ISIG
        assert console.read_input() == []
        for key in (" ", "q", "\n", "ü", "\x1b[A", "\x1b"):
            terminal.type(key)
            assert console.read_input() == [key if key.isprintable() else "a key"]
        assert console.read_input() == []
        assert terminal.shows() == ""
    assert terminal.modes == before
    assert before[3] & termios.ICANON


def test_the_terminal_is_as_before_after_an_interruption(seat):
    terminal, _ = seat()
    before = terminal.modes
    with suppress(KeyboardInterrupt), single_keys():
        assert terminal.modes != before
        raise KeyboardInterrupt
    assert terminal.modes == before


def test_a_question_is_answered_by_a_line_which_is_shown(seat):
    terminal, console = seat()
    with single_keys():
        console.notify(OperatorMessage("checklist", "Type estop.", ("estop",)))
        terminal.shows()
        terminal.type("est")
        assert console.read_input() == []
        terminal.type("op\n")
        assert console.read_input() == ["estop"]
        assert terminal.shows().replace("\r", "") == "estop\n"
        terminal.type("y\nn\n")
        assert console.read_input() == ["y", "n"]
        # Once nothing is asked for, any key is heard again.
        console.notify(OperatorMessage("homing", "Moving to home."))
        terminal.type("x")
        assert console.read_input() == ["x"]


def test_a_terminal_that_is_closed_is_no_error(seat):
    terminal, console = seat()
    with single_keys():
        terminal.hang_up()
        assert console.read_input() == []
        assert console.read_input() == []
