"""The Gymnasium environments: Gymnasium's own checks, and the bits of the trials of `evaluate`."""

import copy
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from equipoise.control.policy import shipped_policy
from equipoise.errors import InputError, OutsideError
from equipoise.model.random import TEST
from equipoise.settings import resolve
from equipoise.simulation import TrialRecorder, run_trial, setup_of, simulate
from equipoise.simulation.evaluation import evaluate

WORLDS = ("ideal", "model", "twin:nominal")
SEED = 3
NAME = "equipoise.envs:equipoise/Balance-v0"
IGNORED = (
    "A Box observation space minimum value is -infinity.",
    "A Box observation space maximum value is infinity.",
    "For Box action spaces, we recommend using a symmetric and normalized space",
)
"""Warnings of `check_env` that Gymnasium's own tests ignore: a velocity has no bound, and an
acceleration a unit."""

pytestmark = pytest.mark.compiled_only


def make(world, **arguments):
    return gym.make(NAME, world=world, **arguments)


def of(policy):
    """Return the arguments that give an environment the task of a policy."""
    return {
        "pendulum": policy.pendulum,
        "arm": policy.arm,
        "actuator": policy.actuator,
        "settings": policy.settings,
    }


@pytest.mark.parametrize(
    ("world", "discrete"), [*((each, False) for each in WORLDS), ("model", True)]
)
def test_gymnasium_finds_nothing_to_complain_of(world, discrete):
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        check_env(make(world, discrete=discrete).unwrapped, skip_render_check=True)
    texts = [str(warning.message) for warning in found]
    assert [text for text in texts if not any(known in text for known in IGNORED)] == []


@pytest.mark.parametrize("world", WORLDS)
def test_a_table_in_the_environment_gives_the_trial_of_evaluate_bit_for_bit(world):
    policy = shipped_policy()
    overrides = ["evaluation.trials=3", "evaluation.duration=1.5"]
    settings = resolve(overrides=overrides)
    results = evaluate(policy, settings, world=world, seed=SEED, with_baselines=False).results
    setup = setup_of(policy, world, settings)
    simulation = simulate(world, setup, seed=SEED, stream=TEST)
    env = make(world, max_episode_steps=150, **of(policy) | {"settings": settings})
    for i in range(3):
        recorder = TrialRecorder()
        run_trial(simulation.loop(), policy, simulation.draw(3).trial(i), 1.5, recorder)
        rows = recorder.rows
        observation, info = env.reset(options={"trial": i, "seed": SEED})
        steps, ended = 0, False
        while not ended:
            assert observation.tobytes() == rows.observation[steps].tobytes()
            assert info["state"].tobytes() == rows.state[steps].tobytes()
            u = policy.act(observation)
            observation, _, terminated, truncated, info = env.step(np.array([u]))
            steps, ended = steps + 1, terminated or truncated
        assert info["time"] == pytest.approx(results.survival[i])
        assert (info["outcome"] or "survived") == results.outcomes[i]


def test_a_time_limit_truncates_and_a_failure_terminates():
    assert make("ideal").spec.max_episode_steps == 6000
    env = make("ideal", max_episode_steps=5)
    env.reset(seed=0)
    ends = [env.step(np.array([0.0]))[2:] for _ in range(5)]
    assert [truncated for _, truncated, _ in ends] == [False] * 4 + [True]
    assert not any(terminated for terminated, _, _ in ends)
    assert ends[-1][2]["outcome"] == ""

    env = make("ideal")
    env.reset(seed=0)
    terminated, rewards = False, []
    while not terminated:
        _, reward, terminated, truncated, info = env.step(np.array([2.0]))
        assert not truncated
        rewards.append(reward)
    assert info["outcome"] == "angle"
    assert rewards == [0.0] * (len(rewards) - 1) + [-1.0]
    with pytest.raises(InputError, match="call env.reset"):
        env.step(np.array([0.0]))


def test_an_agent_swings_a_hanging_pendulum_up():
    env = make("model", settings=resolve(overrides=["evaluation.start=hanging"]))
    observation, info = env.reset(seed=3)
    assert abs(info["state"][2]) > 3.0
    loop = env.unwrapped._loop
    agent = env.unwrapped.simulation.acting(shipped_policy(), loop)
    agent.reset()
    for _ in range(1500):
        observation, _, terminated, _, info = env.step(np.array([agent.act(observation)]))
        assert not terminated, info
        if loop.balancing:
            break
    assert agent.balancing
    while not terminated:
        _, _, terminated, _, info = env.step(np.array([2.0]))
    assert info["outcome"] == "angle"


def test_a_reward_of_ones_own_sees_the_step():
    seen = []

    def reward(state, u, next_state, failed):
        seen.append((state, u, next_state, failed))
        return -abs(next_state.phi)

    env = make("ideal", reward=reward)
    before, _ = env.reset(seed=1)
    after, value, *_ = env.step(np.array([1.5]))
    ((state, u, next_state, failed),) = seen
    assert (state, next_state) == (tuple(before), tuple(after))
    assert (u, failed) == (1.5, False)
    assert value == -abs(after[2])


def test_eight_actions_are_the_accelerations_of_the_paper():
    one, eight = make("model"), make("model", discrete=True)
    for action, u in enumerate((-2, -1.5, -1, -0.5, 0.5, 1, 1.5, 2)):
        one.reset(seed=2), eight.reset(seed=2)
        assert np.array_equal(one.step(np.array([float(u)]))[0], eight.step(action)[0])


@pytest.mark.parametrize("world", ["ideal", "twin:nominal"])
def test_a_picture_shows_the_rig_and_changes(world):
    env = make(world, render_mode="rgb_array")
    env.reset(seed=0)
    try:
        before = env.render()
    except OutsideError as error:
        pytest.skip(str(error))
    assert (before.shape, before.dtype) == ((480, 640, 3), np.uint8)
    assert before.std() > 10.0
    for _ in range(10):
        env.step(np.array([2.0]))
    assert not np.array_equal(env.render(), before)
    env.close()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_is_a_new_environment_with_the_same_arguments(copied):
    env = make("ideal", discrete=True, arm="iiwa14")
    env.reset(seed=5)
    env.step(3)
    other = copied(env)
    assert other.unwrapped.task.arm.name == "iiwa14"
    assert np.array_equal(other.reset(seed=6)[0], env.reset(seed=6)[0])
    assert np.array_equal(other.step(0)[0], env.step(0)[0])


@pytest.mark.full
def test_environments_run_in_processes_that_import_nothing_before():
    envs = gym.make_vec(NAME, 2, "async", vector_kwargs={"context": "spawn"}, world="ideal")
    alone = make("ideal")
    for i, observation in enumerate(envs.reset(seed=4)[0]):
        assert np.array_equal(observation, alone.reset(seed=4 + i)[0])
    envs.close()


@pytest.mark.parametrize("action", [np.array([np.nan]), [], None, "x", np.zeros(2)])
def test_an_action_that_is_no_number_is_refused(action):
    env = make("ideal").unwrapped
    env.reset(seed=0)
    with pytest.raises(InputError, match="the action is"):
        env.step(action)


@pytest.mark.parametrize("options", [{"phi": 0.0}, {"trial": -1}, {"seed": 3}, {"trial": "x"}])
def test_options_that_replay_no_trial_are_refused(options):
    with pytest.raises(InputError, match="options"):
        make("ideal").reset(options=options)


def test_an_acceleration_beyond_the_papers_is_clipped():
    ends = []
    for u in (100.0, 2.0):
        environment = make("ideal")
        environment.reset(seed=SEED)
        ends.append(environment.step([u])[0])
    np.testing.assert_array_equal(*ends)


@pytest.mark.parametrize("reward", [lambda *_: None, lambda *_: 1 / 0, lambda state: 0.0])
def test_a_reward_that_fails_is_one_sentence(reward):
    environment = make("ideal", reward=reward)
    environment.reset(seed=SEED)
    with pytest.raises(InputError, match="the reward raised .*; correct it"):
        environment.step([0.0])
