"""Steps per second of the vector environments, beside Gymnasium's own CartPole, in one run.

- `ideal`, `model`, `twin:nominal`: `gymnasium.make_vec("equipoise/Balance-v0", world=...)` on one
  core, the kinematics of the arm included.
- `ideal kernel`, `model kernel`: the batched kernel of the same world, without Gymnasium's
  interface: no rewards, ends of episodes or infos.
- `CartPole`: Gymnasium's native NumPy environment, `CartPoleVectorEnv`, which has no arm.

All take their turn in each round, and the best round counts. LQR balances the arms, and a PD law
the cart, so that few episodes end::

    python benchmarks/environments.py            # a table
    python benchmarks/environments.py --json     # steps_per_second, by name and width
"""

import argparse
import json
import time
from collections.abc import Callable

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control.cartpole import CartPoleVectorEnv
from rich.console import Console
from rich.table import Table

import equipoise.envs  # noqa: F401  (registers the environments)
from equipoise.control.baselines import lqr_gains
from equipoise.control.policy import shipped_policy
from equipoise.worlds import setup_of, simulate
from equipoise.worlds.fleet import Fleet

Step = Callable[[], object]
WIDTHS = (16, 64, 1024)
ROUNDS = 20
SECONDS = 0.05
"""Least length of a round [s]."""
STEPS = 20
"""Number of steps between two looks at the clock."""


def environment(world: str, width: int) -> Step:
    """Return a step of the vector environment of a world, balanced by LQR."""
    policy = shipped_policy()
    envs = gym.make_vec("equipoise/Balance-v0", num_envs=width, world=world, workers=1)
    observations, _ = envs.reset(seed=0)
    gains = np.array(lqr_gains(policy.pendulum.parameters(), policy.h))

    def step() -> None:
        nonlocal observations
        observations = envs.step(np.clip(observations @ gains, -2.0, 2.0)[:, None])[0]

    return step


def kernel(world: str, width: int) -> Step:
    """Return a step of the batched kernel of a world."""
    policy = shipped_policy()
    simulation = simulate(world, setup_of(policy, world), seed=0, stream=0)
    fleet = Fleet(simulation, width, 1)
    fleet.reset(np.arange(width), simulation.draw(width))
    observations, gains = (
        fleet.values.predicted,
        np.array(lqr_gains(policy.pendulum.parameters(), policy.h)),
    )

    def step() -> None:
        fleet.step(np.clip(observations @ gains, -2.0, 2.0))

    return step


def cart_pole(width: int) -> Step:
    """Return a step of Gymnasium's CartPole, balanced by a PD law."""
    envs = CartPoleVectorEnv(num_envs=width)
    observations, _ = envs.reset(seed=0)

    def step() -> None:
        nonlocal observations
        observations = envs.step((observations[:, 2] + observations[:, 3] > 0).astype(np.int64))[0]

    return step


def seconds_per_step(step: Step) -> float:
    """Return the mean time of a step over one round [s]."""
    begin, steps = time.perf_counter(), 0
    while (elapsed := time.perf_counter() - begin) < SECONDS:
        for _ in range(STEPS):
            step()
        steps += STEPS
    return elapsed / steps


def measure(width: int) -> dict[str, float]:
    """Return the steps per second of each, by name."""
    contestants = {
        "CartPole": cart_pole(width),
        **{f"{world} kernel": kernel(world, width) for world in ("ideal", "model")},
        **{world: environment(world, width) for world in ("ideal", "model", "twin:nominal")},
    }
    for step in contestants.values():
        step()  # compiles
    best = dict.fromkeys(contestants, np.inf)
    for _ in range(ROUNDS):
        for name, step in contestants.items():
            best[name] = min(best[name], seconds_per_step(step))
    return {name: width / seconds for name, seconds in best.items()}


def main() -> None:
    """Measure at all widths, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--widths", type=int, nargs="+", default=WIDTHS, metavar="N")
    options = parser.parse_args()
    rates = {width: measure(width) for width in options.widths}
    if options.json:
        print(json.dumps({"steps_per_second": rates}))
        return
    table = Table("steps per second", *(f"{width:,}" for width in rates))
    for name in next(iter(rates.values())):
        table.add_row(name, *(f"{rates[width][name]:,.0f}" for width in rates))
    Console().print(table)


if __name__ == "__main__":
    main()
