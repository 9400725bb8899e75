"""The operator at a terminal, or at what stands in for one."""

import os
import sys

import pytest

from equipoise.cli.output import Output
from equipoise.cli.terminal_operator import TerminalOperator, single_keys
from equipoise.control.ticks import OperatorMessage

ASKED = OperatorMessage("checklist", "Is the E-stop in an operator's hand? Type estop.", ("estop",))
BUTTON = OperatorMessage("reference", "Press the button or Enter.", ("ok",))


@pytest.fixture
def typist(monkeypatch):
    """The writing end of what the console reads."""
    read, write = os.pipe()
    with os.fdopen(read) as stdin, os.fdopen(write, "w", buffering=1) as typist:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield typist


def test_lines_are_heard_whole_and_once(typist):
    console = TerminalOperator(Output(False))
    console.notify(ASKED)
    assert console.read_input() == []
    typist.write("esto")
    typist.flush()
    assert console.read_input() == []
    typist.write("p\n")
    assert console.read_input() == ["estop"]
    assert console.read_input() == []


def test_nobody_who_could_answer_denies_what_is_asked_once(typist):
    console = TerminalOperator(Output(False))
    console.notify(ASKED)
    typist.write("estop\n")
    typist.close()
    assert console.read_input() == ["estop"]
    console.notify(OperatorMessage("home", "Is this home?", ("y", "n")))
    assert console.read_input() == ["n"]
    assert console.read_input() == []


def test_the_button_needs_no_keyboard(typist):
    typist.close()
    console = TerminalOperator(Output(False))
    for event in (OperatorMessage("balancing", "Balancing."), BUTTON):
        console.notify(event)
        assert console.read_input() == console.read_input() == []


@pytest.mark.parametrize("closed", [True, False])
def test_without_any_input_it_speaks_and_denies(monkeypatch, closed):
    stdin = None
    if closed:
        stdin = open(os.devnull)  # noqa: SIM115
        stdin.close()
    monkeypatch.setattr(sys, "stdin", stdin)
    console = TerminalOperator(Output(False))
    with single_keys():
        console.notify(ASKED)
        assert console.read_input() == ["n"]
