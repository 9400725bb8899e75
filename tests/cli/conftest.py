"""The command as a user sees it: exit code, stdout, stderr, and the files that are left."""

import json
import shlex
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import typer

from equipoise.cli import main
from equipoise.cli.app import app
from equipoise.identification.recording import simulate_swing, write_swing
from equipoise.worlds.evaluation import evaluate


class Ran(NamedTuple):
    code: int
    out: str
    err: str

    @property
    def json(self):
        """The one object on stdout: more than that does not parse."""
        return json.loads(self.out)


@pytest.fixture
def equipoise(tmp_path, monkeypatch, capfd):
    """Run the command in an empty folder; each call returns what came of it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    capfd.readouterr()

    def run(*arguments):
        code = main([str(argument) for argument in arguments])
        ran = Ran(code, *capfd.readouterr())
        for line in ran.out.splitlines():
            if line.startswith("next: equipoise "):
                parse(shlex.split(line)[2:])
        return ran

    return run


def parse(words):
    """Parse the words of a command as typer does, or fail; nothing runs."""
    group = typer.main.get_command(app)
    context = group.make_context("equipoise", list(words))
    name, command, rest = group.resolve_command(context, list(words))
    if hasattr(command, "commands"):
        context = command.make_context(name, rest, parent=context)
        name, command, rest = command.resolve_command(context, rest)
    return command.make_context(name, rest, parent=context).params


def verbs():
    """Every verb, as it is typed, and its command."""
    found = {}
    for name, command in typer.main.get_command(app).commands.items():
        for verb, inner in getattr(command, "commands", {"": command}).items():
            found[f"{name} {verb}".strip()] = inner
    return found


@pytest.fixture
def refused(equipoise, tmp_path):
    """Run the command and expect a refusal: exit code 2, one message, no traceback, no file."""

    def run(*arguments, saying):
        before = contents(tmp_path)
        ran = equipoise(*arguments)
        assert ran.code == 2, ran
        assert "Traceback" not in ran.err
        assert saying in ran.err
        # Lines of stages that were done before begin with two blanks.
        message = [x for x in ran.err.splitlines() if x.strip() and not x.startswith("  ")]
        assert message[0].startswith("error: ") or message[0].startswith("Usage: ")
        assert len(message) == 1 or message[0].startswith("Usage: ")
        assert contents(tmp_path) == before
        return ran

    return run


def contents(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


@pytest.fixture
def swing(pendulum, tmp_path):
    """A good recording of ten periods."""
    path = tmp_path / "swing.csv"
    write_swing(path, recorded(pendulum))
    return path


def recorded(pendulum):
    return simulate_swing(
        pendulum.parameters(),
        theta0=0.6,
        duration=7.5,
        rate_hz=200.0,
        counts_per_rev=8192,
        noise=1e-4,
    )


@pytest.fixture
def pendulum_file(pendulum, tmp_path):
    path = tmp_path / "pendulum.json"
    pendulum.save(path, command="test")
    return path


@pytest.fixture
def policy_file(small_policy, tmp_path):
    """A policy for an iiwa 14 that has hardly been trained; its trials last two seconds."""
    path = tmp_path / "policy.json"
    small_policy.save(path, command="test")
    return path


@pytest.fixture(scope="session")
def small_evaluation(small_policy):
    return evaluate(small_policy)


@pytest.fixture
def csv(tmp_path):
    """Write a recording from columns of anything."""

    def write(header, *columns, name="swing.csv"):
        rows = [
            header,
            *(",".join(str(cell) for cell in row) for row in zip(*columns, strict=True)),
        ]
        path = Path(tmp_path / name)
        path.write_text("\n".join(rows) + "\n")
        return path

    return write


TIME = np.arange(0.0, 7.5, 0.005)
"""Time stamps of made-up recordings [s]."""
COSINE = 0.5 * np.cos(2.0 * np.pi * TIME / 0.75)
"""A swing of the paper's period [rad]."""
