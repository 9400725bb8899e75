"""The command as a user sees it: exit code, stdout, stderr, and the files that are left."""

import json
from pathlib import Path
from typing import NamedTuple

import pytest
import typer

from equipoise import simulate_swing, write_swing
from equipoise.cli import main
from equipoise.cli.app import app


class Ran(NamedTuple):
    code: int
    out: str
    err: str

    @property
    def json(self):
        """The one object on stdout: more than that does not parse."""
        return json.loads(self.out)


@pytest.fixture
def equipoise(monkeypatch, capfd):
    """Run the command, and expect an exit code; each call returns what came of it."""
    monkeypatch.setenv("COLUMNS", "200")
    capfd.readouterr()

    def run(*arguments, code=0):
        ran = Ran(main([str(argument) for argument in arguments]), *capfd.readouterr())
        assert code in (ran.code, None), ran
        return ran

    return run


@pytest.fixture
def refused(equipoise, tmp_path):
    """Run the command and expect a refusal: exit code 2, one message, no traceback, no file."""

    def run(*arguments, saying=""):
        before = contents(tmp_path)
        ran = equipoise(*arguments, code=2)
        assert "Traceback" not in ran.err
        assert saying in " ".join(ran.err.split())
        # Lines of stages that were shown before begin with two blanks.
        message = [line for line in ran.err.splitlines() if line.strip() and line[:2] != "  "]
        assert message[0].startswith(("error: ", "Usage: "))
        assert len(message) == 1 or message[0].startswith("Usage: ")
        assert contents(tmp_path) == before
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


def contents(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


@pytest.fixture
def swing(pendulum, tmp_path):
    """A good recording of ten periods of the paper's pendulum."""
    path = tmp_path / "swing.csv"
    encoder = {"rate_hz": 200.0, "counts_per_rev": 100_000}
    write_swing(path, simulate_swing(pendulum.parameters(), theta0=0.5, duration=7.5, **encoder))
    return path


@pytest.fixture
def pendulum_file(pendulum, tmp_path):
    path = tmp_path / "pendulum.json"
    pendulum.save(path, command="test")
    return path


@pytest.fixture
def policy_file(small_policy, tmp_path):
    """A policy for an iiwa 14 that has hardly been trained; its trials last two seconds."""
    path = Path(tmp_path / "policy.json")
    small_policy.save(path, command="test")
    return path
