"""Train DQN, PPO and SAC of Stable-Baselines3 on the environment, and write them as ONNX files.

The hyperparameters are in `experiments/rl/*.yml`, in the form of RL Zoo, which can train from them
too. Each network is written with its scaling, so that it takes the observation and returns the
acceleration in SI units; `compare.py` runs the files beside the tables::

    python -m pip install '.[rl]'
    python experiments/rl.py --out rl                     # dqn.onnx, ppo.onnx, sac.onnx, rl.json
    python experiments/compare.py rl/dqn.onnx rl/ppo.onnx rl/sac.onnx

A training uses the world `model` and the paper's reward, as the tables do, and one thread.
"""

import argparse
import json
import math
import os
import sys
import time
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np
import onnx
import onnxruntime
import stable_baselines3
import torch
import yaml
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env

import equipoise.envs  # noqa: F401  (registers the environments)
from equipoise import paper
from equipoise.files import write_atomically

HERE: Final = Path(__file__).parent
ALGORITHMS: Final = ("dqn", "ppo", "sac")
SCALE: Final = (paper.X_LIMIT, 0.5, paper.PHI_LIMIT, 1.0)
"""Units of the network's input: the limits of x [m] and phi [rad], 0.5 m/s, and 1 rad/s."""
PACKAGES: Final = ("stable-baselines3", "torch", "onnx", "onnxruntime", "gymnasium", "numpy")
SAMPLES: Final = 1000
"""Number of observations on which an exported network is compared with its policy."""
TOLERANCE: Final = 1e-4
"""Difference of u between network and policy that counts [m/s^2]: both compute in single
precision."""
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
        if hasattr(self.policy, "actor"):
            # Without its distribution, which PyTorch cannot export.
            action = torch.tanh(self.policy.actor.get_action_dist_params(scaled)[0])
        else:
            features = self.policy.mlp_extractor.forward_actor(scaled)
            action = self.policy.action_net(features)
        return paper.U_MAX * torch.clamp(action, -1.0, 1.0)


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


def export(model: BaseAlgorithm, path: Path) -> int:
    """Write a policy as ONNX; return the number of observations in which the file differs."""
    network = Network(model).eval()
    torch.onnx.export(network, (torch.zeros(1, 4),), str(path), external_data=False)
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    name = session.get_inputs()[0].name
    rng, different = np.random.default_rng(0), 0
    for _ in range(SAMPLES):
        row = (rng.uniform(-1.0, 1.0, (1, 4)) * SCALE).astype(np.float32)
        computed = np.asarray(session.run(None, {name: row})[0]).item()
        action = model.predict(row / np.array(SCALE, np.float32), deterministic=True)[0].item()
        wanted = paper.ACTIONS[action] if network.discrete else paper.U_MAX * action
        different += abs(computed - wanted) > TOLERANCE
    return different


def parameters(path: Path) -> int:
    """Return the number of parameters of an exported network."""
    return sum(math.prod(tensor.dims) for tensor in onnx.load(str(path)).graph.initializer)


def main() -> int:
    """Train and export; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("rl"), help="folder to write")
    parser.add_argument("--only", choices=ALGORITHMS, action="append", help="repeatable")
    parser.add_argument("--steps", type=int, help="environment steps; by default those of the file")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    for algorithm in args.only or ALGORITHMS:
        path, record = (args.out / f"{algorithm}.{end}" for end in ("onnx", "json"))
        if path.exists() or record.exists():
            print(f"error: {path} or {record} exists; give another --out", file=sys.stderr)
            return 2
        model, wall = train(algorithm, args.steps, args.seed)
        different = export(model, path)
        if different > DIFFERENT:
            print(
                f"error: {path} differs from its policy in {different} of {SAMPLES} observations, "
                f"expected at most {DIFFERENT}; check the exporter's messages",
                file=sys.stderr,
            )
            return 1
        facts = {
            "algorithm": algorithm,
            "environment": hyperparameters(algorithm)[0],
            "steps": int(model.num_timesteps),
            "seed": args.seed,
            "train_s": wall,
            "parameters": parameters(path),
            "different": different,
            "versions": {name: version(name) for name in PACKAGES},
            "cores": len(os.sched_getaffinity(0)),
        }
        write_atomically(record, json.dumps(facts, indent=1) + "\n")
        print(f"{algorithm}: {facts['steps']:,} steps in {wall:.0f} s, wrote {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
