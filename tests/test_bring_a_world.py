"""A user's world in one file: bring-a-world.md as printed, and the conformance suite on it."""

import json
import shlex
import sys
import tomllib
from importlib.metadata import EntryPoint

import gymnasium as gym
import numpy as np
import pytest

from equipoise import evaluate, shipped_policy, simulation
from equipoise.cli import main
from equipoise.errors import InputError, SettingsError
from equipoise.simulation import setup_of, simulate, world_class
from tests.test_pages import blocks

FOUND = blocks("docs/how-to/bring-a-world.md", "python", "toml", "sh")
BLOCKS = dict(FOUND)
WORLD, SUITE = (text for language, text in FOUND if language == "python")
POLICY = shipped_policy()
BROKEN = """
from own_world import Windy

class Falls(Windy):
    def loop(self):
        loop = super().loop()
        loop.send = lambda q: 1 / 0
        return loop

no_world = 3
"""


@pytest.fixture(autouse=True)
def folder(tmp_path):
    (tmp_path / "own_world.py").write_text(WORLD)
    (tmp_path / "broken_world.py").write_text(BROKEN)
    yield
    for name in ("own_world", "broken_world"):
        sys.modules.pop(name, None)


def make(world="own_world:Windy"):
    setup = setup_of(POLICY, world)
    return simulate(world, setup, seed=1, stream=7), setup


printed: dict = {}
exec(SUITE, printed)
TestWindy = printed["TestWindy"]  # the suite of the page, collected as it is printed


def test_the_page_runs_as_it_is_printed(capsys):
    command, *words = shlex.split(BLOCKS["sh"])
    assert command == "equipoise"
    assert main([*words, "--json"]) in (0, 1)
    told = json.loads(capsys.readouterr().out)
    assert (told["world"], told["trials"]) == ("own_world:Windy", 3)
    assert told["median_s"] > 1.0


def test_it_is_a_world_of_environments():
    env = gym.make("equipoise.envs:equipoise/Balance-v0", world="own_world:Windy")
    first = env.reset(seed=3)[0], env.step(np.array([0.5]))[0]
    again = env.reset(seed=3)[0], env.step(np.array([0.5]))[0]
    assert np.array_equal(first, again)


def test_it_has_no_lanes_but_gymnasiums_own_vector_form():
    name = "equipoise.envs:equipoise/Balance-v0"
    with pytest.raises(InputError, match="own_world:Windy.*vectorization_mode='sync'"):
        gym.make_vec(name, 2, world="own_world:Windy")
    envs = gym.make_vec(name, 2, "sync", world="own_world:Windy")
    assert envs.reset(seed=3)[0].shape == (2, 4)


def test_a_registered_world_is_found_by_its_name(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(tmp_path)
    named = tomllib.loads(BLOCKS["toml"])["project"]["entry-points"][simulation.GROUP]
    points = {name: EntryPoint(name, value, simulation.GROUP) for name, value in named.items()}
    monkeypatch.setattr(simulation, "registered", lambda group: points)
    assert world_class("windy:anything").ideal_arm


@pytest.mark.parametrize(
    ("world", "error"),
    [
        ("nowhere", SettingsError),
        ("ideal:other", SettingsError),
        ("broken_world:nothing", InputError),
        ("broken_world:no_world", SettingsError),
        ("broken_world:Falls", InputError),
    ],
)
def test_a_world_that_cannot_be_used_is_one_clear_error(world, error):
    with pytest.raises(error):
        evaluate(POLICY, POLICY.settings, world=world, with_baselines=False)
