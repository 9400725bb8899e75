"""Text from files and wires never reaches a terminal or a page raw."""

import json
import unicodedata
from itertools import count

import pytest

from equipoise.arm.iiwa import iiwa
from equipoise.cli.output import Output
from equipoise.cli.terminal_operator import TerminalOperator
from equipoise.control.ticks import OperatorMessage
from equipoise.log.conditions import RunEnd
from equipoise.log.recorder import Recorder, push_event
from equipoise.log.writer import RunWriter
from tests.log.made_up import rig_conditions

ESCAPES = "\x1b[2J\x1b]0;owned\x07\x9b31m\x7f\u202e"
"""Clears the screen, sets the title, colours, deletes, and reverses what follows."""
HOSTILE = f"evil{ESCAPES}\r\u2028\nerror: forged [bold red]$x^{{$"
SHOWN = r"evil\x1b[2J\x1b]0;owned\x07\x9b31m\x7f\u202e"


def raw(text):
    """The characters of an output that a terminal would act on."""
    return {c for c in text if unicodedata.category(c) in ("Cc", "Cf", "Zl", "Zp") and c != "\n"}


def check(ran, *, shown=SHOWN):
    said = ran.out + ran.err
    assert not raw(said), ran
    assert not any(line.startswith("error: forged") for line in said.splitlines())
    assert "Traceback" not in said
    assert shown in said.replace("\n", ""), ran


def test_output_escapes_whatever_it_is_given(capsys):
    output = Output(as_json=False)
    ways = (
        lambda: output.tell(HOSTILE),
        lambda: output.warn(HOSTILE),
        lambda: output.result(**{HOSTILE: HOSTILE}),
        lambda: output.result(table={HOSTILE: {HOSTILE: HOSTILE}}, then=HOSTILE),
        lambda: TerminalOperator(output).notify(OperatorMessage("notice", HOSTILE)),
    )
    for way in ways:
        way()
        said = capsys.readouterr().out
        assert "owned" in said
        assert not raw(said), said


def test_a_live_display_escapes_its_words(capsys, monkeypatch):
    monkeypatch.setenv("TTY_COMPATIBLE", "1")  # rich takes it for a terminal
    monkeypatch.setenv("FORCE_COLOR", "1")
    with Output(as_json=False).busy(HOSTILE) as rename:
        rename(HOSTILE)
    said = capsys.readouterr().err
    assert r"evil\x1b[2J" in said
    assert "\x1b[2J" not in said
    assert "\x1b]0;" not in said


FIRST, *OTHERS = iiwa(7).joints
HOSTILE_JOINTS = (FIRST.model_copy(update={"name": HOSTILE}), *OTHERS)
HOSTILE_ARM = iiwa(7).model_copy(update={"joints": HOSTILE_JOINTS})


@pytest.fixture
def rig_log(tmp_path):
    """The log of a run that stopped before it balanced."""
    path, recorder = tmp_path / "rig.mcap", Recorder(7)
    texts = dict.fromkeys(("world", "encoder", "policy", "actuator"), HOSTILE)
    writer = RunWriter(path, rig_conditions(arm=HOSTILE_ARM, **texts), 0.0)
    push_event(recorder.event, 0.5, OperatorMessage("stopping", HOSTILE))
    writer.drain(recorder)
    writer.finish(1.0, RunEnd(evidence={"text": HOSTILE, HOSTILE: HOSTILE}))
    return path


@pytest.mark.parametrize("verb", ["log explain", "identify", "log export"])
def test_a_log(equipoise, rig_log, verb):
    ran = equipoise(*verb.split(), rig_log, code=None)
    check(ran, shown=SHOWN if verb == "log explain" else "")
    if (ran := equipoise(*verb.split(), rig_log, "--json", code=None)).out:
        assert ran.json


def test_settings_worlds_and_rigs(equipoise, tmp_path):
    key = json.dumps(HOSTILE)
    (tmp_path / "bad.toml").write_text(f"{key} = 1\n", encoding="utf-8")
    for arguments in (
        ("train", "--settings", "bad.toml"),
        ("evaluate", "--world", "twin:bad.toml"),
        ("rig", "doctor", "--rig", "bad.toml"),
    ):
        check(equipoise(*arguments, code=2), shown=r"evil\x1b[2J\x1b]0;owned\x07")


numbers = count()


@pytest.mark.parametrize(
    ("text", "command"),
    [
        ("end()", "evaluate {}:end"),
        ("class P:\n    act, __init__ = end, end", "evaluate {}:P"),
        ("def r(state, u, after, failed):\n    return end()", "train --reward {}:r"),
        ("def l(tables, transition, params):\n    end()", "train --algorithm {}:l"),
    ],
)
def test_code_of_a_guest(equipoise, tmp_path, text, command):
    name = f"hostile_guest_{next(numbers)}"  # a module is imported once
    end = f"raise BaseException({ESCAPES!r})"
    (tmp_path / f"{name}.py").write_text(f"import sys\ndef end(*_):\n    {end}\n{text}\n")
    check(equipoise(*command.format(name).split(), code=2), shown="hostile_guest")
    assert not list(tmp_path.glob("*.json"))
