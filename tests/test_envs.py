"""The Gymnasium environments: Gymnasium's own checks, and the bits of the trials of `evaluate`.

The vector environment must equal Gymnasium's own vector form of the single one.
"""

import copy
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from equipoise import evaluate, iiwa, resolve, shipped_policy
from equipoise.errors import InputError, OutsideError
from equipoise.learning.rewards import centred
from equipoise.model.random import TEST
from equipoise.simulation import TrialRecorder, run_trial, setup_of, simulate

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


def make(world, **arguments):
    return gym.make(NAME, world=world, **arguments)


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
    task = {name: getattr(policy, name) for name in ("pendulum", "arm", "actuator")}
    env = make(world, max_episode_steps=150, settings=settings, **task)
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


def test_an_agent_swings_a_hanging_pendulum_up_which_falls_once_it_has_stood_in_a_lane_too():
    settings = resolve(overrides=["evaluation.start=hanging"])
    env, envs = make("model", settings=settings), gym.make_vec(NAME, 1, settings=settings)
    observation, info = env.reset(seed=SEED)
    envs.reset(seed=SEED)
    assert abs(info["state"][2]) > 3.0
    loop = env.unwrapped._loop
    agent = env.unwrapped.simulation.acting(shipped_policy(), loop)
    agent.reset()
    terminated = False
    while not terminated:
        u = 2.0 if loop.balancing else agent.act(observation)
        observation, _, terminated, _, info = env.step(np.array([u]))
        observations, _, failed, _, infos = envs.step([[u]])
        assert np.array_equal(observations[0], observation)
        assert failed[0] == terminated
    assert agent.balancing
    assert info["outcome"] == infos["outcome"][0] == "angle"


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


# Many at once

LANES = {"ideal": 3, "model": 19, "twin:nominal": 2}
"""Number of lanes by world: on the plant more than a block, and less."""


def assert_same(ours, theirs):
    """Compare results of the two forms bit for bit; an info where it has a value."""
    if not isinstance(ours, dict):
        np.testing.assert_array_equal(ours, theirs)
        return
    assert ours.keys() == theirs.keys()
    for key in ours:
        if key.startswith("_"):
            np.testing.assert_array_equal(ours[key], theirs[key])
        elif isinstance(ours[key], dict):
            assert_same(ours[key], theirs[key])
        else:
            rows = np.flatnonzero(theirs[f"_{key}"])
            assert [str(ours[key][i]) for i in rows] == [str(theirs[key][i]) for i in rows]
            assert ours[key].dtype == theirs[key].dtype
            assert ours[key].shape == theirs[key].shape


def alike(world, lanes, mode, **arguments):
    """Return the two vector forms, after a reset."""
    sync = {"vector_kwargs": {"autoreset_mode": mode}}
    ours = gym.make_vec(NAME, lanes, world=world, autoreset_mode=mode, **arguments)
    theirs = gym.make_vec(NAME, lanes, "sync", world=world, **sync, **arguments)
    assert ours.metadata["autoreset_mode"] is mode
    for space in ("action_space", "single_action_space", "observation_space"):
        assert getattr(ours, space) == getattr(theirs, space)
    for seed in (None, SEED) if lanes == 3 else (SEED,):
        ours.reset(), theirs.reset()
        for one, other in zip(ours.reset(seed=seed), theirs.reset(seed=seed), strict=True):
            if seed is not None:
                assert_same(one, other)
    return ours, theirs


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_each_lane_has_the_bits_of_a_single_environment_in_all_its_episodes(world, mode):
    lanes = LANES[world]
    ours, theirs = alike(world, lanes, mode, max_episode_steps=30)
    rng, ends = np.random.default_rng(0), np.zeros(2)
    x, x_dot, phi, phi_dot = ours.reset()[0].T
    theirs.reset()
    for _ in range(100):
        u = 2.0 * x + 3.0 * x_dot + 25.0 * phi + 2.0 * phi_dot
        u[::2] = rng.uniform(-4.0, 4.0, len(u[::2]))  # beyond the limit, too
        results = ours.step(u[:, None])
        for one, other in zip(results, theirs.step(u[:, None]), strict=True):
            assert_same(one, other)
        x, x_dot, phi, phi_dot = results[0].T
        ends += results[2].sum(), results[3].sum()
    assert (ends >= 2).all()  # failures and truncations
    ours.reset(), theirs.reset()  # the next episode of each, in the midst of one
    assert_same(ours.step(u[:, None])[0], theirs.step(u[:, None])[0])
    ours.close(), theirs.close()


def test_more_lanes_than_one_thread_takes_are_equal_to_few():
    few, many = (gym.make_vec(NAME, lanes, world="ideal") for lanes in (5, 600))
    few.reset(seed=SEED + 595), many.reset(seed=SEED)
    for _ in range(60):
        ours, theirs = few.step(np.full((5, 1), 0.5)), many.step(np.full((600, 1), 0.5))
        for one, other in zip(ours[:4], theirs[:4], strict=True):
            np.testing.assert_array_equal(one, other[-5:])  # of another thread
    many.close()


def test_lanes_give_the_time_of_a_stop_within_a_tick():
    arm = iiwa(7)
    slow = [joint.model_copy(update={"velocity": 0.05 * joint.velocity}) for joint in arm.joints]
    arm = arm.model_copy(update={"joints": tuple(slow)})
    ours, theirs = alike("twin:nominal", 2, AutoresetMode.NEXT_STEP, arm=arm)
    for _ in range(3):
        results = ours.step(np.full((2, 1), 2.0)), theirs.step(np.full((2, 1), 2.0))
        assert_same(results[0][4], results[1][4])
    assert results[0][4]["time"].tolist() == [0.025, 0.025]


def test_lanes_swing_up_and_take_discrete_actions_and_own_rewards_as_single_ones_do():
    def reward(state, u, next_state, failed):
        if u < -1.9:
            raise ValueError("too hard")
        return next_state.phi - state.phi + 10.0 * u + 100.0 * failed

    hanging = resolve(overrides=["evaluation.start=hanging"])
    for arguments in ({"reward": centred}, {"settings": hanging}, {"reward": reward}):
        ours, theirs = alike("ideal", 3, AutoresetMode.NEXT_STEP, discrete=True, **arguments)
        rng = np.random.default_rng(1)
        for _ in range(60):
            actions = rng.integers(1, 8, 3)
            for one, other in zip(ours.step(actions), theirs.step(actions), strict=True):
                assert_same(one, other)
    with pytest.raises(InputError, match="the reward raised ValueError.*too hard"):
        ours.step(np.zeros(3, int))


def test_gymnasiums_wrappers_take_the_vector_environment():
    envs = gym.make_vec(NAME, 4, world="ideal", max_episode_steps=20)
    assert envs.spec.kwargs["vectorization_mode"] == "vector_entry_point"
    rescaled = gym.wrappers.vector.RescaleAction(envs, -1.0, 1.0)
    wrapped = gym.wrappers.vector.RecordEpisodeStatistics(rescaled)
    wrapped.reset(seed=SEED)
    for _ in range(20):
        _, _, failed, late, info = wrapped.step(wrapped.action_space.sample())
    assert (failed | late).any()
    assert info["episode"]["l"].max() <= 20


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ({"num_envs": 0}, "num_envs is 0; expected"),
        ({"max_episode_steps": 0}, "max_episode_steps is 0; expected"),
        ({"autoreset_mode": AutoresetMode.DISABLED}, "autoreset_mode is .*; expected"),
        ({"render_mode": "rgb_array"}, "render_mode is 'rgb_array'; expected"),
        ({"reward": lambda *_: None}, "cannot be compiled"),
        ({"reward": print}, "expected a function"),
    ],
)
def test_lanes_that_cannot_be_are_one_sentence(arguments, error):
    with pytest.raises(InputError, match=error):
        gym.make_vec(NAME, **arguments)


def test_steps_and_resets_that_lanes_cannot_take_are_one_sentence():
    envs = gym.make_vec(NAME, 2, world="ideal")
    with pytest.raises(InputError, match="no episodes are running"):
        envs.step(np.zeros((2, 1)))
    with pytest.raises(InputError, match="options"):
        envs.reset(options={"trial": 1})
    envs.reset(seed=SEED)
    for actions in (np.zeros(3), np.full((2, 1), np.inf), "left", None):
        with pytest.raises(InputError, match="the action is"):
            envs.step(actions)
    discrete = gym.make_vec(NAME, 2, world="ideal", discrete=True)
    discrete.reset()
    with pytest.raises(InputError, match="the action is"):
        discrete.step(np.array([0, 8]))
