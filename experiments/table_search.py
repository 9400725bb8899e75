r"""Search for the best table over a grid: the bound of what a table of these boxes can do.

A box holds many states, so that the next box depends on more than box and action: value iteration
over the boxes (`value_iteration.py`) solves another problem. The search needs no model. It
maximises what the selection of a training maximises, the score of compiled trials, by the
cross-entropy method (Rubinstein 1999): sample tables, keep the best ones, and move the probability
of each action in each box towards theirs,

.. math:: p_s(a) = (1 - \beta) p_s(a) + \beta \frac{\text{elite tables with } a \text{ in } s}
    {\text{elite tables}}

All tables of a generation run the same trials, and each generation new ones. Tables are
mirror-symmetric, as the task is. The search begins at the best of LQR at the centre of each box and
the given tables. In the end these and the tables of the search run common trials, and the best one
is the result::

    python experiments/table_search.py --recipe fine --out best.json
"""

from collections.abc import Sequence
from concurrent.futures import Executor
from itertools import pairwise, product
from math import radians
from pathlib import Path

import numpy as np
from shared import options

import equipoise as eq
from equipoise import paper
from equipoise.control.linear import lqr_gains
from equipoise.executors import open_workers
from equipoise.learning.train import score_tables
from equipoise.settings import BoxSettings
from equipoise.simulation import setup_of

LEVELS = np.array(paper.ACTIONS)
"""Accelerations of the actions [m/s^2], shape (8,), rising."""
OUTER = 1.5
"""Outer end of the intervals without a limit, phi_dot and x_dot, in units of their last inner
end."""
TRIALS = 8
"""Number of trials of each table of a generation."""
ELITE = 1.0 / 6.0
"""Fraction of the best tables of a generation."""
SMOOTHING = 0.3
"""Weight beta of the elite tables in the new probabilities."""
WIDTH = 0.42
"""Standard deviation of the first probabilities about the start, in actions of 0.5 m/s^2: one box
in ten differs."""
SPREAD = 2.0
"""Factor on the variation of the plants: with that of a training nearly no trial of a good table
fails, and the search would trade robustness for a smaller rms(x)."""
VARIED = ("inertia_sigma", "friction_sigma", "delay_spread", "lag_spread", "zero_error")
"""Settings of the plant that `SPREAD` multiplies."""


def lqr_table(settings: BoxSettings, pendulum: eq.PendulumParameters) -> np.ndarray:
    """Return the table of LQR, snapped to the actions, at the centre of each box.

    Args:
        settings: The boxes.
        pendulum: Nominal parameters.

    Returns:
        Acceleration of each box [m/s^2], shape (boxes,), mirror-symmetric.
    """

    def centres(ends: Sequence[float], limit: float) -> list[float]:
        return [0.5 * (low + high) for low, high in pairwise((-limit, *ends, limit))]

    gains = lqr_gains(pendulum, paper.STEP)
    rates, speeds = settings.phi_dot_deg, settings.x_dot
    axes = (
        [radians(angle) for angle in centres(settings.phi_deg, paper.PHI_LIMIT_DEG)],
        [radians(rate) for rate in centres(rates, OUTER * rates[-1])],
        centres(settings.x, paper.X_LIMIT),
        centres(speeds, OUTER * speeds[-1]),
    )
    half: list[int] = []
    for phi, phi_dot, ahead, x_dot in list(product(*axes))[: settings.count // 2]:
        x = ahead - settings.look_ahead * (x_dot + phi_dot / pendulum.k)
        u = float(np.dot(gains, (x, x_dot, phi, phi_dot)))
        half.append(int(np.argmin(np.abs(LEVELS - u))))
    return LEVELS[mirrored_table(np.array(half))]


def mirrored_table(half: np.ndarray) -> np.ndarray:
    """Return the actions of all boxes from those of the lower half, shape (boxes,)."""
    return np.concatenate((half, len(LEVELS) - 1 - half[::-1]))


def search_table(
    policy: eq.TabularPolicy,
    starts: Sequence[np.ndarray] = (),
    *,
    generations: int = 40,
    tables: int = 128,
    workers: int | Executor = 1,
) -> eq.TabularPolicy:
    """Search for the best table of a grid.

    Args:
        policy: A policy of the same task, which gives pendulum, arm, actuator and settings.
        starts: Tables to begin with, accelerations of each box [m/s^2], shape (boxes,).
        generations: Number of generations.
        tables: Number of tables of a generation.
        workers: Number of threads, or an executor; the result does not depend on it.

    Returns:
        The policy with the best table: Q is 1 for the action of a box, and 0 for the others.
    """
    plant = policy.settings.plant
    wide = plant.model_copy(update={name: SPREAD * getattr(plant, name) for name in VARIED})

    def ordered(candidates: Sequence[np.ndarray], seed: int, **rule: float) -> list[int]:
        """Return the indices of the candidates, the best first."""
        selection = policy.settings.selection.model_copy(update=rule)
        settings = policy.settings.model_copy(update={"plant": wide, "selection": selection})
        setup = setup_of(policy, "model", settings)
        tables = [(0, table) for table in candidates]
        results = score_tables(setup, tables, seed=seed, workers=workers)
        return sorted(range(len(results)), key=lambda i: -results[i].score)

    begun = [lqr_table(policy.settings.boxes, policy.pendulum.parameters()), *starts]
    half = np.searchsorted(LEVELS, begun[ordered(begun, 0)[0]])[: len(begun[0]) // 2]
    p = np.exp(-0.5 * ((np.arange(len(LEVELS)) - half[:, None]) / WIDTH) ** 2)
    p /= p.sum(axis=1, keepdims=True)
    rng = np.random.default_rng(0)
    modes: list[np.ndarray] = []
    for generation in range(1, generations + 1):
        chances = rng.random((tables, len(p), 1))
        halves = np.minimum((chances > p.cumsum(axis=1)).sum(axis=2), len(LEVELS) - 1)
        halves[0] = p.argmax(axis=1)
        order = ordered([LEVELS[mirrored_table(one)] for one in halves], generation, trials=TRIALS)
        elite = halves[order[: max(1, round(ELITE * tables))]]
        fraction = (elite[:, :, None] == np.arange(len(LEVELS))).mean(axis=0)
        p = (1.0 - SMOOTHING) * p + SMOOTHING * fraction
        modes.append(LEVELS[mirrored_table(p.argmax(axis=1))])
    candidates = [*begun, *modes]
    best = candidates[ordered(candidates, 0)[0]]
    Q = (best[:, None] == LEVELS).astype(float).tolist()
    return policy.model_copy(update={"Q": tuple(map(tuple, Q)), "checkpoints": (), "test": None})


def main() -> None:
    """Search from a short training, and write the table."""
    parser = options(__doc__, "set", "workers", out=Path("best-table.json"))
    parser.add_argument("--recipe", default="robust", help="robust or fine")
    parser.add_argument("--generations", type=int, default=40)
    parser.add_argument("--tables", type=int, default=128, help="tables of a generation")
    args = parser.parse_args()
    settings = eq.resolve(args.recipe, overrides=args.set)
    size = {"generations": args.generations, "tables": args.tables}
    with open_workers(args.workers) as workers:
        learned = eq.train(eq.shipped_pendulum(), eq.iiwa(7), settings, workers=workers)
        searched = search_table(learned, [learned.u_of_box], workers=workers, **size)
        for name, policy in (("learned", learned), ("searched", searched)):
            summary = eq.evaluate(policy, with_baselines=False, workers=workers).results.summary()
            print(f"{name}: {summary.survived} of {summary.trials} trials survived")
    searched.save(args.out, command="table_search")


if __name__ == "__main__":
    main()
