"""Training in a world that Python steps: the compiled training, an episode at a time."""

import numpy as np
import pytest

from equipoise import paper
from equipoise.errors import InputError, SettingsError
from equipoise.learning.choice import compile_learner
from equipoise.learning.episodes import (
    ENDED,
    IN_USE,
    STEPS,
    new_training_loop,
    new_training_state,
    train_episodes,
)
from equipoise.learning.train import actuator_in, train, train_in_world, training_config
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator, shipped_actuator
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.pendulum import Pendulum
from equipoise.model.random import TRAINING_NOISE
from equipoise.settings import resolve
from equipoise.worlds import Setup
from equipoise.worlds.ideal import PlantSimulation

pytestmark = pytest.mark.compiled_only

ARM, PENDULUM = iiwa(7), Pendulum.assumed(70.2, 0.15)
FEW = [
    "learning.episodes=6",
    "learning.episode_duration=0.5",
    "selection.every=3",
    "selection.trials=4",
    "selection.duration=0.5",
]


@pytest.mark.full
@pytest.mark.parametrize("actuator", [IDEAL_ACTUATOR, shipped_actuator()])
def test_an_episode_in_a_world_teaches_what_it_teaches_compiled(actuator):
    settings = resolve()
    config = training_config(settings, PENDULUM.parameters().k)._replace(episodes=1)
    kernel, boxes = compile_learner(settings.learning), settings.boxes.count
    for seed in range(3):
        states = [new_training_state(boxes, 2), new_training_state(boxes, 2)]
        key = np.array((seed, 0))
        setup = Setup(PENDULUM, ARM, settings, actuator, paper.STEP)
        world = PlantSimulation("model", setup, seed=seed, stream=TRAINING_NOISE)
        given = (world.params, world.pendulum, config, kernel)
        compiled, stepped = (new_training_loop(*given, state, key) for state in states)
        train_episodes(compiled, 1)
        train_in_world(stepped, states[1], world.loop(), 1)
        one, other = states
        assert one.totals[STEPS] == other.totals[STEPS] > 0
        assert other.totals[ENDED] == 1
        assert other.totals[IN_USE] == 0
        for ours, theirs in zip(one.tables, other.tables, strict=True):
            assert ours.tobytes() == theirs.tobytes()


def test_training_on_a_twin_differs_from_training_on_the_model():
    settings, world = resolve(overrides=FEW), "twin:nominal"
    whole = train(PENDULUM, ARM, settings, seed=2, world=world)
    assert [point.episodes for point in whole.learning_curve] == [3, 6]

    assert train(PENDULUM, ARM, settings, seed=2).digest != whole.digest


def test_a_world_that_cannot_train_is_refused():
    settings, own = resolve(overrides=FEW), Actuator.assumed("lag", delay=0.01, lag=0.01)
    kinematic = "coppeliasim://localhost"
    with pytest.raises(InputError):
        actuator_in("ideal", settings, None)
    with pytest.raises(InputError):
        actuator_in(kinematic, settings, own)
    assert actuator_in(kinematic, settings, None) == IDEAL_ACTUATOR
    with pytest.raises(SettingsError):
        actuator_in("moon", settings, None)
