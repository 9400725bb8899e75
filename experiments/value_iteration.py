r"""Value iteration over the boxes, with probabilities counted in simulated episodes.

The boxes are taken for the states of a Markov decision process: N(s, a, s') counts how often action
a in box s led to box s' after one step, in episodes of the environment behind the actuator.
The table solves

.. math:: Q(s, a) = \sum_{s'} \frac{N(s, a, s')}{N(s, a)} \gamma \max_b Q(s', b)

with Q = -1 after a failure, the paper's reward, and for pairs that never occurred. Since a box
holds many states, the next box depends on more than s and a: the counts depend on the policy that
chose the actions. They are therefore added up over several rounds, each with the policy that the
counts before it give, and with random actions among its own. The best table of all rounds in
common trials is the result::

    python experiments/value_iteration.py --out solved.json
"""

from pathlib import Path

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from shared import options

import equipoise as eq
import equipoise.envs
from equipoise import paper
from equipoise.executors import available_cores
from equipoise.learning.train import score_tables
from equipoise.model.grid import box_indices, make_grid
from equipoise.simulation import setup_of

LEVELS = np.array(paper.ACTIONS)
"""Accelerations of the actions [m/s^2], shape (8,), rising."""
FAILED = -1.0
"""Value after a failure: the paper's reward."""
EXPLORATION = 0.3
"""Probability of a random action in the rounds after the first one, which is all random."""
TOLERANCE = 1e-10
"""Largest change of a value in the last sweep over the boxes."""


def solve(N: np.ndarray, gamma: float) -> np.ndarray:
    """Solve for the values of all actions.

    The task is mirror-symmetric, and each count also counts for its mirror image.

    Args:
        N: Number of transitions from each box by each action to each box, shape
            (boxes, 8, boxes + 1); the last one is a failure.
        gamma: Discount of a step [-].

    Returns:
        Q, shape (boxes, 8).
    """
    both = N.astype(float)
    both[:, :, :-1] += N[::-1, ::-1, -2::-1]
    both[:, :, -1] += N[::-1, ::-1, -1]
    times = both.sum(axis=2)
    p = both / np.maximum(times, 1.0)[:, :, None]
    values = np.zeros(len(N))
    while True:
        Q = np.where(times > 0.0, gamma * p[:, :, :-1] @ values + FAILED * p[:, :, -1], FAILED)
        best = Q.max(axis=1)
        if np.max(np.abs(best - values)) < TOLERANCE:
            return Q
        values = best


def solve_table(
    policy: eq.TabularPolicy,
    *,
    rounds: int = 6,
    loops: int = 64,
    ticks: int = 2000,
    workers: int = 1,
) -> eq.TabularPolicy:
    """Count transitions between boxes, and solve for the table.

    Args:
        policy: A policy of the same task, which gives pendulum, arm, actuator and settings.
        rounds: Number of rounds.
        loops: Number of closed loops side by side.
        ticks: Number of steps of each loop in a round.
        workers: Number of threads of the trials; the result does not depend on it.
    """
    settings, count = policy.settings, policy.settings.boxes.count
    boxes = make_grid(settings.boxes, policy.pendulum.parameters().k)
    envs = gym.make_vec(
        "equipoise/Balance-v0",
        discrete=True,
        num_envs=loops,
        autoreset_mode=AutoresetMode.SAME_STEP,
        max_episode_steps=round(settings.learning.episode_duration / paper.STEP),
        pendulum=policy.pendulum,
        arm=policy.arm,
        actuator=policy.actuator,
        settings=settings,
    )
    N = np.zeros((count, len(LEVELS), count + 1), np.int64)
    table, tables, rng = np.zeros(count, np.int64), [], np.random.default_rng(0)
    for number in range(rounds):
        box = box_indices(envs.reset(seed=number)[0], boxes)
        for _ in range(ticks):
            action = table[box]
            explores = rng.random(loops) < (EXPLORATION if number else 1.0)
            action[explores] = rng.integers(0, len(LEVELS), np.count_nonzero(explores))
            observed, _, failed, truncated, _ = envs.step(action)
            after = box_indices(observed, boxes)
            # A truncated episode has been reset, and its next box is not its own.
            seen = ~truncated
            np.add.at(N, (box[seen], action[seen], np.where(failed, count, after)[seen]), 1)
            box = after
        tables.append(solve(N, settings.learning.gamma))
        table = tables[-1].argmax(axis=1)
    envs.close()
    candidates = [(0, LEVELS[Q.argmax(axis=1)]) for Q in tables]
    setup = setup_of(policy, "model", settings)
    results = score_tables(setup, candidates, seed=0, workers=workers)
    best = tables[max(range(rounds), key=lambda i: results[i].score)]
    visits = tuple(map(tuple, N.sum(axis=2).tolist()))
    Q = tuple(map(tuple, best.tolist()))
    return policy.model_copy(update={"Q": Q, "visits": visits, "checkpoints": (), "test": None})


def main() -> None:
    """Solve for the shipped task, and write the table."""
    parser = options(__doc__, out=Path("value-iteration.json"))
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--loops", type=int, default=64, help="closed loops side by side")
    parser.add_argument("--ticks", type=int, default=2000, help="steps of each loop in a round")
    args = parser.parse_args()
    workers = available_cores()
    size = {"rounds": args.rounds, "loops": args.loops, "ticks": args.ticks}
    solved = solve_table(eq.shipped_policy(), workers=workers, **size)
    summary = eq.evaluate(solved, with_baselines=False, workers=workers).results.summary()
    print(f"{summary.survived} of {summary.trials} trials survived")
    solved.save(args.out, command="value_iteration")


if __name__ == "__main__":
    main()
