"""Train DQN and SAC of Stable-Baselines3 on the environment, and write them as ONNX files.

The hyperparameters are in `experiments/rl/*.yml`, in the form of RL Zoo, which can train from them
too. Each network is written with its scaling, so that it takes the observation and returns the
acceleration in SI units; `compare.py` runs the files beside the tables::

    python -m pip install '.[rl]'
    python experiments/rl.py --out rl              # dqn.onnx and sac.onnx, a .json beside each
    python experiments/ppo.py --out rl             # ppo.onnx, in one file without this library
    python experiments/compare.py rl/dqn.onnx rl/ppo.onnx rl/sac.onnx

A training uses the world `model` and the paper's reward, as the tables do, and one thread. Both
algorithms learn from single steps, so that they use a single environment; PPO learns from many
episodes at once, those of the vector environment.
"""

import argparse
import sys
import time
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np
import stable_baselines3
import torch
import yaml
from ppo import PACKAGES, SCALE, export, record
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env

import equipoise.envs  # noqa: F401  (registers the environments)
from equipoise import paper

HERE: Final = Path(__file__).parent
ALGORITHMS: Final = ("dqn", "sac")
DIFFERENT: Final = 5
"""Largest number of observations in which they may differ: DQN's two best values may be equal to
rounding, and then either action is right."""


class Scaled(gym.ObservationWrapper):
    """Observe the state in units of `SCALE`."""

    def observation(self, observation: Any) -> Any:
        """Return the scaled observation."""
        return observation / np.array(SCALE)


class ScaledAction(gym.wrappers.RescaleAction):
    """Act between -1 and 1, in units of the largest acceleration."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        """Wrap an environment with a continuous action."""
        super().__init__(env, np.float64(-1.0), np.float64(1.0))


class Network(torch.nn.Module):
    """A trained policy from the observation to u, both in SI units."""

    def __init__(self, model: BaseAlgorithm) -> None:
        """Take over the deterministic policy of a model."""
        super().__init__()
        self.policy = model.policy
        self.discrete = isinstance(model.action_space, gym.spaces.Discrete)
        self.register_buffer("scale", torch.tensor(SCALE, dtype=torch.float32))
        self.register_buffer("actions", torch.tensor(paper.ACTIONS, dtype=torch.float32))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Return u [m/s^2], shape (1, 1), for the observation, shape (1, 4)."""
        scaled = observation / self.scale
        if self.discrete:
            best = self.policy.q_net(scaled).argmax(dim=1)
            return self.actions[best].reshape(1, 1)
        # Without its distribution, which PyTorch cannot export.
        return paper.U_MAX * torch.tanh(self.policy.actor.get_action_dist_params(scaled)[0])


def hyperparameters(algorithm: str) -> tuple[str, dict[str, Any]]:
    """Return the environment of an algorithm and its hyperparameters, in the form of RL Zoo."""
    text = (HERE / "rl" / f"{algorithm}.yml").read_text(encoding="utf-8")
    ((environment, chosen),) = yaml.safe_load(text).items()
    return environment, chosen


def wrapped(names: list[str]) -> Any:
    """Return a function that applies wrappers by name, the first one innermost."""

    def wrap(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        for name in names:
            module, _, kind = name.rpartition(".")
            env = getattr(import_module(module), kind)(env)
        return env

    return wrap


def train(algorithm: str, steps: int | None, seed: int) -> tuple[BaseAlgorithm, float]:
    """Train an algorithm; return its model and the wall time [s]."""
    environment, chosen = hyperparameters(algorithm)
    total = int(chosen.pop("n_timesteps"))
    envs = make_vec_env(
        environment,
        n_envs=chosen.pop("n_envs", 1),
        seed=seed,
        env_kwargs=chosen.pop("env_kwargs", {}),
        wrapper_class=wrapped(chosen.pop("env_wrapper", [])),
    )
    envs.reset()  # compiles the kernels before the clock starts
    make = getattr(stable_baselines3, algorithm.upper())
    model = make(env=envs, seed=seed, device="cpu", **chosen)
    begin = time.perf_counter()
    model.learn(steps or total, progress_bar=False)
    return model, time.perf_counter() - begin


def u_of(model: BaseAlgorithm, observation: np.ndarray) -> float:
    """Return u of a model [m/s^2] for an observation, shape (1, 4)."""
    action = model.predict(observation / np.array(SCALE, np.float32), deterministic=True)[0].item()
    discrete = isinstance(model.action_space, gym.spaces.Discrete)
    return paper.ACTIONS[action] if discrete else paper.U_MAX * action


def main() -> None:
    """Train and export."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("rl"), help="folder to write")
    parser.add_argument("--only", choices=ALGORITHMS, action="append", help="repeatable")
    parser.add_argument("--steps", type=int, help="environment steps; by default those of the file")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.set_num_threads(1)
    for algorithm in args.only or ALGORITHMS:
        path = args.out / f"{algorithm}.onnx"
        if path.exists():
            sys.exit(f"error: {path} exists; give another --out")
        model, wall = train(algorithm, args.steps, args.seed)
        different = export(Network(model).eval(), path, partial(u_of, model), DIFFERENT)
        facts = {
            "algorithm": algorithm,
            "environment": hyperparameters(algorithm)[0],
            "steps": int(model.num_timesteps),
            "seed": args.seed,
            "train_s": wall,
            "different": different,
        }
        record(path, ("stable-baselines3", *PACKAGES), facts)


if __name__ == "__main__":
    main()
