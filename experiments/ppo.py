"""Train a network by proximal policy optimisation (PPO), in one file, and write it as ONNX.

The method of Schulman et al., 2017 (arXiv:1707.06347), with generalised advantage estimation
(arXiv:1506.02438), on the vector environment in the world `model` with the paper's reward::

    python -m pip install '.[rl]'
    python experiments/ppo.py --out rl             # rl/ppo.onnx, rl/ppo.json
    equipoise evaluate rl/ppo.onnx --world twin:nominal

The file takes the observation and returns the acceleration, both in SI units.
"""

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np
import onnx
import onnxruntime
import torch
from torch import nn

from equipoise import paper
from equipoise.files import write_atomically

SCALE: Final = (paper.X_LIMIT, 0.5, paper.PHI_LIMIT, 1.0)
"""Units of the network's input: the limits of x [m] and phi [rad], 0.5 m/s, and 1 rad/s."""
NAME: Final = "equipoise.envs:equipoise/Balance-v0"
PACKAGES: Final = ("torch", "onnx", "onnxruntime", "gymnasium", "numpy")
LANES: Final = 64
TICKS: Final = 128
"""Number of steps of each lane between two updates."""
EPOCHS: Final = 8
"""Number of passes over the steps in an update."""
BATCH: Final = 1024
"""Number of steps for a gradient."""
RATE: Final = 1e-3
"""Learning rate at the beginning; it falls to zero."""
GAMMA: Final = 0.99
"""Discount per step."""
LAMBDA: Final = 0.95
"""Decay of the advantage estimator."""
CLIP: Final = 0.2
"""Largest change of a probability ratio that an update rewards."""
SAMPLES: Final = 1000
"""Number of observations on which an exported network is compared with its policy."""
TOLERANCE: Final = 1e-4
"""Difference of u that counts [m/s^2]: both compute in single precision."""


def perceptron(outputs: int, gain: float) -> nn.Sequential:
    """Return a network with two hidden layers, and orthogonal weights at the beginning."""
    sizes = (len(SCALE), 64, 64, outputs)
    layers: list[nn.Module] = []
    for i, scale in enumerate((2**0.5, 2**0.5, gain)):
        layer = nn.Linear(sizes[i], sizes[i + 1])
        nn.init.orthogonal_(layer.weight, scale)
        nn.init.zeros_(layer.bias)
        layers += [layer, nn.Tanh()]
    return nn.Sequential(*layers[:-1])


class Policy(nn.Module):
    """The policy: a normal distribution of u, and its mean as the exported network."""

    def __init__(self) -> None:
        """Begin with a mean near zero, and a standard deviation of the largest acceleration."""
        super().__init__()
        self.mean = perceptron(1, 0.01)
        self.log_deviation = nn.Parameter(torch.zeros(1))
        self.register_buffer("scale", torch.tensor(SCALE, dtype=torch.float32))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Return u [m/s^2], shape (n, 1), for observations, shape (n, 4)."""
        return paper.U_MAX * torch.clamp(self.mean(observation / self.scale), -1.0, 1.0)

    def distribution(self, scaled: torch.Tensor) -> torch.distributions.Normal:
        """Return the distribution of u in units of the largest acceleration, shape (n,)."""
        return torch.distributions.Normal(self.mean(scaled)[..., 0], self.log_deviation.exp())


def train(steps: int, seed: int) -> tuple[Policy, int, float]:
    """Train a policy; return it, the number of steps and the wall time [s]."""
    torch.manual_seed(seed)
    envs = gym.make_vec(NAME, LANES, world="model", max_episode_steps=1000)
    policy, critic = Policy(), perceptron(1, 1.0)
    optimiser = torch.optim.Adam([*policy.parameters(), *critic.parameters()], RATE, eps=1e-5)
    seen = torch.zeros(TICKS + 1, LANES, len(SCALE))
    actions, log_p, rewards, failed = torch.zeros(4, TICKS, LANES)
    over = torch.zeros(TICKS + 1, LANES)  # whether the episode of a lane ended a step ago
    updates = -(-steps // (TICKS * LANES))

    def scaled(observations: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(observations / SCALE).float()

    seen[-1] = scaled(envs.reset(seed=seed)[0])
    begin = time.perf_counter()
    for update in range(updates):
        optimiser.param_groups[0]["lr"] = RATE * (1.0 - update / updates)
        seen[0], over[0] = seen[-1], over[-1]
        with torch.no_grad():
            for t in range(TICKS):
                chosen = policy.distribution(seen[t])
                actions[t] = chosen.sample()
                log_p[t] = chosen.log_prob(actions[t])
                u = paper.U_MAX * actions[t, :, None]
                observed, reward, fell, late, _ = envs.step(u.numpy())
                seen[t + 1], rewards[t] = scaled(observed), torch.from_numpy(reward)
                failed[t], over[t + 1] = torch.from_numpy(fell), torch.from_numpy(fell | late)
            values = critic(seen)[..., 0]
            advantages = rewards + GAMMA * values[1:] * (1.0 - failed) - values[:-1]
            for t in reversed(range(TICKS - 1)):
                advantages[t] += GAMMA * LAMBDA * (1.0 - over[t + 1]) * advantages[t + 1]
            targets = advantages + values[:-1]
        # A lane whose episode is over begins the next one, whatever its action: no step to learn.
        real = over[:-1] == 0.0
        data = [part[real] for part in (seen[:-1], actions, log_p, advantages, targets)]
        for _ in range(EPOCHS):
            for rows in torch.randperm(len(data[0])).split(BATCH):
                states, acts, before, gains, wanted = (part[rows] for part in data)
                gains = (gains - gains.mean()) / (gains.std() + 1e-8)
                ratio = (policy.distribution(states).log_prob(acts) - before).exp()
                clipped = ratio.clamp(1.0 - CLIP, 1.0 + CLIP)
                loss = -torch.minimum(ratio * gains, clipped * gains).mean()
                loss = loss + 0.5 * (critic(states)[:, 0] - wanted).square().mean()
                optimiser.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(optimiser.param_groups[0]["params"], 0.5)
                optimiser.step()
        if (update + 1) % 10 == 0:
            often = f"{failed.sum():,.0f} of {real.sum():,} steps failed"
            print(f"update {update + 1} of {updates}: {often}", file=sys.stderr)
    envs.close()
    return policy.eval(), updates * TICKS * LANES, time.perf_counter() - begin


def export(network: nn.Module, path: Path, wanted: Callable[[Any], Any], allowed: int = 0) -> int:
    """Write a network as ONNX; return in how many of `SAMPLES` observations it differs.

    Args:
        network: From observations, shape (1, 4), to u [m/s^2], shape (1, 1).
        path: The file.
        wanted: Returns u of the policy for an observation, shape (1, 4).
        allowed: Largest number of observations in which it may differ.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.onnx.export(network, (torch.zeros(1, 4),), str(path), external_data=False)
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    name, rng, different = session.get_inputs()[0].name, np.random.default_rng(0), 0
    for _ in range(SAMPLES):
        row = (rng.uniform(-1.0, 1.0, (1, 4)) * SCALE).astype(np.float32)
        u = np.asarray(session.run(None, {name: row})[0]).item()
        different += abs(u - float(wanted(row))) > TOLERANCE
    if different > allowed:
        sys.exit(
            f"error: {path} differs from its policy in {different} of {SAMPLES} observations, "
            f"expected at most {allowed}; check the exporter's messages"
        )
    return different


def record(path: Path, packages: tuple[str, ...], facts: dict[str, Any]) -> None:
    """Write beside an exported network how it was trained."""
    weights = onnx.load(str(path)).graph.initializer
    facts |= {
        "parameters": sum(math.prod(tensor.dims) for tensor in weights),
        "versions": {name: version(name) for name in packages},
        "cores": len(os.sched_getaffinity(0)),
    }
    write_atomically(path.with_suffix(".json"), json.dumps(facts, indent=1) + "\n")
    print(f"{facts['steps']:,} steps in {facts['train_s']:.0f} s, wrote {path}")


def main() -> None:
    """Train and export."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("rl"), help="folder to write")
    parser.add_argument("--steps", type=int, default=300_000, help="steps of all lanes together")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    path = args.out / "ppo.onnx"
    if path.exists():
        sys.exit(f"error: {path} exists; give another --out")
    torch.set_num_threads(1)
    policy, steps, wall = train(args.steps, args.seed)
    different = export(policy, path, lambda row: policy(torch.from_numpy(row)).detach())
    facts = {"algorithm": "ppo", "environment": NAME, "steps": steps, "seed": args.seed}
    record(path, PACKAGES, facts | {"train_s": wall, "different": different})


if __name__ == "__main__":
    main()
