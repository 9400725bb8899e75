"""Native vector environments: the bits of single ones, Gymnasium's ways to reset, and bad input."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import equipoise.envs
from equipoise.errors import EquipoiseError, InputError

BALANCE, DISCRETE = equipoise.envs.IDS
SEED = 3


def make(world="ideal", num_envs=5, name=BALANCE, **arguments):
    return gym.make_vec(name, num_envs=num_envs, world=world, **arguments)


def act(observations):
    """Return actions that keep some pendulums up and let others fall: [m/s^2], shape (n, 1)."""
    x, x_dot, phi, phi_dot = observations.T
    u = 2.0 * x + 3.0 * x_dot + 25.0 * phi + 2.0 * phi_dot * np.sign(phi)
    return np.clip(u, -2.0, 2.0)[:, None]


def single_episodes(count, world, **arguments):
    """Return observations and end of each episode of a single environment."""
    env = gym.make(BALANCE, world=world, **arguments)
    episodes = []
    for k in range(count):
        observation, info = env.reset(seed=SEED if k == 0 else None)
        seen, over = [observation], False
        while not over:
            observation, reward, terminated, truncated, info = env.step(act(observation[None])[0])
            over = terminated or truncated
            seen.append(observation)
        episodes.append((np.array(seen), reward, terminated, truncated, info["outcome"]))
    return episodes


@pytest.mark.parametrize(
    ("world", "count"),
    [
        ("ideal", 40),
        ("model", 20),
        pytest.param("twin:nominal", 5, marks=pytest.mark.compiled_only),
    ],
)
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_each_episode_has_the_bits_of_a_single_environments(world, count, mode):
    expected = single_episodes(count, world, duration=0.4)
    envs = make(world, duration=0.4, autoreset_mode=mode)
    observations, _ = envs.reset(seed=SEED)
    episode = list(range(envs.num_envs))
    seen = [[row] for row in observations]
    begun, fresh, compared = envs.num_envs, set(), 0
    while compared < count - envs.num_envs:
        observations, rewards, terminated, truncated, info = envs.step(act(observations))
        ended = terminated | truncated
        for i in range(envs.num_envs):
            if i in fresh:  # reset in this step
                fresh.remove(i)
                assert not ended[i]
                assert rewards[i] == 0.0
                seen[i], episode[i], begun = [observations[i]], begun, begun + 1
                continue
            last = mode is AutoresetMode.SAME_STEP and ended[i]
            seen[i].append(info["final_obs"][i] if last else observations[i])
            if not ended[i]:
                continue
            facts = info["final_info"] if last else info
            end = rewards[i], terminated[i], truncated[i], facts["outcome"][i]
            assert np.array_equal(np.array(seen[i]), expected[episode[i]][0])
            assert end == expected[episode[i]][1:]
            compared += 1
            if last:
                seen[i], episode[i], begun = [observations[i]], begun, begun + 1
            else:
                fresh.add(i)
    assert {row[2:4] for row in expected} == {(True, False), (False, True)}
    envs.close()


def test_without_autoreset_ended_environments_wait_for_a_masked_reset():
    envs = make(autoreset_mode="Disabled", duration=0.02)
    envs.reset(seed=SEED)
    for _ in range(2):
        observations, _, _, truncated, _ = envs.step(np.zeros((5, 1)))
    assert truncated.all()
    with pytest.raises(InputError, match="5 episodes have ended"):
        envs.step(np.zeros((5, 1)))
    some = np.array([True, False, True, False, False])
    again, info = envs.reset(options={"reset_mask": some})
    assert np.array_equal(again[~some], observations[~some])
    assert (again[some] != observations[some]).any(axis=1).all()
    assert info["time"][some].tolist() == [0.0, 0.0]
    with pytest.raises(InputError, match="3 episodes have ended"):
        envs.step(np.zeros((5, 1)))


@pytest.mark.compiled_only
@pytest.mark.parametrize(("world", "count"), [("ideal", 560), ("twin:nominal", 3)])
def test_results_do_not_depend_on_the_threads_and_equal_seeds_give_equal_bits(world, count):
    def run(workers):
        envs = make(world, count, workers=workers)
        first, _ = envs.reset(seed=8)
        rows = [envs.step(np.full((count, 1), 0.5))[0] for _ in range(20)]
        envs.close()
        return np.array([first, *rows])

    alone = run(1)
    assert np.array_equal(run(2), alone)
    assert np.array_equal(run(1), alone)


@pytest.mark.parametrize(("world", "observe"), [("model", "raw"), ("model", "estimated")])
def test_other_observations_are_those_of_a_single_environment(world, observe):
    envs, env = make(world, 2, observe=observe), gym.make(BALANCE, world=world, observe=observe)
    assert np.array_equal(envs.reset(seed=SEED)[0][0], env.reset(seed=SEED)[0])
    for u in (1.0, -2.0, 0.5):
        assert np.array_equal(envs.step(np.full((2, 1), u))[0][0], env.step(np.array([u]))[0])


def test_a_reward_of_ones_own_judges_each_step():
    def reward(state, u, next_state, failed):
        return next_state.phi - state.phi + 10.0 * u + 100.0 * failed

    envs = make(reward=reward)
    before, _ = envs.reset(seed=SEED)
    after, rewards, *_ = envs.step(np.arange(-2.0, 3.0)[:, None])
    np.testing.assert_allclose(rewards, after[:, 2] - before[:, 2] + 10.0 * np.arange(-2.0, 3.0))


def test_the_discrete_one_takes_the_papers_accelerations():
    discrete, envs = make(name=DISCRETE, num_envs=8), make(num_envs=8)
    discrete.reset(seed=SEED)
    envs.reset(seed=SEED)
    u = np.array([-2.0, -1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0])
    assert np.array_equal(discrete.step(np.arange(8))[0], envs.step(u[:, None])[0])
    with pytest.raises(InputError, match="expected whole numbers from 0 to 7"):
        discrete.step(np.full(8, 8))


@pytest.mark.parametrize(
    ("arguments", "saying"),
    [
        ({"num_envs": 0}, "num_envs is 0"),
        ({"autoreset_mode": "Sometimes"}, "expected one of NextStep"),
        ({"render_mode": "rgb_array"}, "draws no pictures"),
        ({"world": "twin:nowhere"}, "no world"),
    ],
)
def test_arguments_that_cannot_be_used_are_refused(arguments, saying):
    with pytest.raises(EquipoiseError, match=saying):
        make(**arguments)


def test_resets_and_actions_that_cannot_be_used_are_refused():
    envs = make()
    with pytest.raises(InputError, match=r"call env\.reset\(\) first"):
        envs.step(np.zeros((5, 1)))
    with pytest.raises(InputError, match="the first reset is one of all"):
        envs.reset(options={"reset_mask": np.zeros(5, bool)})
    envs.reset(seed=SEED)
    for seed, options in (([1, 2, 3, 4, 5], None), (1, {"low": 1}), (1, {"reset_mask": [1]})):
        with pytest.raises(InputError, match="expected"):
            envs.reset(seed=seed, options=options)
    for actions in (np.zeros(4), np.full((5, 1), np.nan), "left"):
        with pytest.raises(InputError, match="finite accelerations"):
            envs.step(actions)
