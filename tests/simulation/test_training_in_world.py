"""Training in a world that Python steps: the compiled training, an episode at a time."""

import pytest

from equipoise import Pendulum, iiwa, paper
from equipoise.errors import InputError, SettingsError
from equipoise.learning import episodes
from equipoise.learning.episodes import learn
from equipoise.learning.train import actuator_in, train
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator, shipped_actuator
from equipoise.settings import LearningSettings, SelectionSettings, Settings
from equipoise.simulation import Setup
from equipoise.simulation.ideal import PlantSimulation

ARM, PENDULUM = iiwa(7), Pendulum.assumed(70.2, 0.15)
FEW = Settings(
    learning=LearningSettings(episodes=6, episode_duration=0.5),
    selection=SelectionSettings(every=3, trials=4, duration=0.5),
)


@pytest.mark.full
@pytest.mark.parametrize("actuator", [IDEAL_ACTUATOR, shipped_actuator()])
def test_an_episode_in_a_world_teaches_what_it_teaches_compiled(actuator, monkeypatch):
    monkeypatch.setattr(
        episodes, "simulate", lambda _, *setup, **key: PlantSimulation("model", *setup, **key)
    )
    settings = Settings(learning=LearningSettings(episodes=1))
    setup = Setup(PENDULUM, ARM, settings, actuator, paper.STEP)
    for seed in range(3):
        (compiled,), (stepped,) = (learn(setup, world, seed, 1) for world in ("model", "own:Plant"))
        assert compiled[0] == stepped[0]
        assert (compiled[0].episodes, compiled[0].steps > 0) == (1, True)
        for ours, theirs in zip(compiled[1], stepped[1], strict=True):
            assert ours.tobytes() == theirs.tobytes()


def test_training_on_a_twin_differs_from_training_on_the_model():
    whole = train(PENDULUM, ARM, FEW, seed=2, world="twin:nominal")
    assert [point.episodes for point in whole.learning_curve] == [3, 6]
    assert train(PENDULUM, ARM, FEW, seed=2).digest != whole.digest


def test_a_world_that_cannot_train_is_refused():
    own = Actuator.assumed("lag", delay=0.01, lag=0.01)
    kinematic = "coppeliasim://localhost"
    with pytest.raises(InputError):
        actuator_in("ideal", FEW, None)
    with pytest.raises(InputError):
        actuator_in(kinematic, FEW, own)
    assert actuator_in(kinematic, FEW, None) == IDEAL_ACTUATOR
    with pytest.raises(SettingsError):
        actuator_in("moon", FEW, None)
