"""The operator at a terminal, or at what stands in for one."""

import os
import sys

import pytest

from equipoise.cli.console import Console, single_keys
from equipoise.cli.output import Output
from equipoise.devices.operator import Told

ASKED = Told("checklist", "Is the E-stop in somebody's hand? Type estop.", ("estop",))
BUTTON = Told("reference", "Press the button or Enter.", ("ok",))


@pytest.fixture
def typist(monkeypatch):
    """The writing end of what the console reads."""
    read, write = os.pipe()
    with os.fdopen(read) as stdin, os.fdopen(write, "w", buffering=1) as typist:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield typist


def test_lines_are_heard_whole_and_once(typist):
    console = Console(Output(False))
    console.tell(ASKED)
    assert console.words() == []
    typist.write("esto")
    typist.flush()
    assert console.words() == []
    typist.write("p\n")
    assert console.words() == ["estop"]
    assert console.words() == []


def test_nobody_who_could_answer_denies_what_is_asked_once(typist):
    console = Console(Output(False))
    console.tell(ASKED)
    typist.write("estop\n")
    typist.close()
    assert console.words() == ["estop"]
    console.tell(Told("home", "Is this home?", ("y", "n")))
    assert console.words() == ["n"]
    assert console.words() == []


def test_the_button_needs_no_keyboard(typist):
    typist.close()
    console = Console(Output(False))
    for event in (Told("balancing", "Balancing."), BUTTON):
        console.tell(event)
        assert console.words() == console.words() == []


@pytest.mark.parametrize("closed", [True, False])
def test_without_any_input_it_speaks_and_denies(monkeypatch, closed):
    stdin = None
    if closed:
        stdin = open(os.devnull)  # noqa: SIM115
        stdin.close()
    monkeypatch.setattr(sys, "stdin", stdin)
    console = Console(Output(False))
    with single_keys():
        console.tell(ASKED)
        assert console.words() == ["n"]
