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


@pytest.mark.parametrize(("world", "count"), [("ideal", 40), ("model", 20)])
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


@pytest.mark.compiled_only
def test_results_do_not_depend_on_the_threads_and_equal_seeds_give_equal_bits():
    count = 560

    def run(workers):
        envs = make("ideal", count, workers=workers)
        first, _ = envs.reset(seed=8)
        rows = [envs.step(np.full((count, 1), 0.5))[0] for _ in range(20)]
        envs.close()
        return np.array([first, *rows])

    alone = run(1)
    assert np.array_equal(run(2), alone)
    assert np.array_equal(run(1), alone)


def test_estimates_are_those_of_a_single_environment():
    given = {"world": "model", "observe": "estimated"}
    envs, env = make(num_envs=2, **given), gym.make(BALANCE, **given)
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
    with pytest.raises(InputError, match="actions"):
        discrete.step(np.full(8, 8))


@pytest.mark.parametrize(
    "arguments",
    [
        {"num_envs": 0},
        {"autoreset_mode": "Disabled"},
        {"render_mode": "rgb_array"},
        {"world": "twin:nowhere"},
        {"world": "twin:nominal"},
    ],
)
def test_arguments_that_cannot_be_used_are_refused(arguments):
    with pytest.raises(EquipoiseError):
        make(**arguments)


def test_resets_and_actions_that_cannot_be_used_are_refused():
    envs = make()
    with pytest.raises(InputError):
        envs.step(np.zeros((5, 1)))
    envs.reset(seed=SEED)
    for seed, options in (([1, 2, 3, 4, 5], None), (1, {"low": 1})):
        with pytest.raises(InputError):
            envs.reset(seed=seed, options=options)
    for actions in (np.zeros(4), np.full((5, 1), np.nan), "left"):
        with pytest.raises(InputError):
            envs.step(actions)
