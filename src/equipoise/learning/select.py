"""Selection of a policy among candidates by a race, and the test of the selected policy.

All candidates run the same trials: common random numbers make differences between them larger than
those between trials. A race (Maron & Moore 1994, "Hoeffding races") runs the trials in growing
blocks and drops a candidate once it is significantly worse than the leader. The bound is an exact
sign test over the trials in which one of the two lasts longer, as in the rank tests of Birattari et
al. 2002, "A racing algorithm for configuring metaheuristics": durations of trials have long tails,
for which bounds on a mean (Mnih et al. 2008, "Empirical Bernstein stopping") need many more trials.
A limited number of trials per round leaves the better candidates (Karnin et al. 2013, "Almost
optimal exploration in multi-armed bandits": successive halving).

The best of many results is biased. The share that a policy states is therefore measured in trials
that chose nothing, with a confidence sequence (Robbins 1970): its bounds hold at all times at once,
so that the test may stop as soon as they answer the question.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from math import log
from typing import Any, Final

import numpy as np
from scipy.optimize import brentq
from scipy.special import bdtrc, betaln, xlog1py, xlogy

from equipoise import paper
from equipoise.arrays import Array, IntArray
from equipoise.control.grid import TRUNCATED, make_grid
from equipoise.control.policy import Checkpoint, PolicyKernel, TargetTest, table_kernel
from equipoise.model.random import SELECTION
from equipoise.model.worlds import MODEL
from equipoise.outcomes import TRIAL_OUTCOMES, Outcome
from equipoise.worlds.ideal import PlantSimulation
from equipoise.worlds.interface import Setup

Running = Callable[[int, int], None]
"""Callback for finished trials, and the number of trials that are expected."""

FIRST_BLOCK: Final = 4
"""Number of trials of each candidate in the first round; each round doubles them."""
ERROR: Final = 0.05
"""Probability that a command accepts any policy whose share is below the target."""
PRIORS: Final = ((0.9, 100.0, 0.3), (0.1, 0.5, 0.5))
"""Weights and parameters of the beta distributions of the confidence sequence. With the first one,
of mean 0.997, a target of 0.99 needs the fewest trials; the second one narrows the intervals of low
shares. The bounds hold for all shares and all targets."""
TEST_BLOCK: Final = 64
"""Number of trials between two looks at the bounds of a test."""
RMS_X_WEIGHT: Final = 0.2
"""Weight of rms(x) in the score = mean duration / duration - weight * rms(x) / 0.22 m. Trials end
at the track. Over 40 policies the rank correlation of rms(x) in 24 trials with the failures in 96
trials of five minutes was 0.85; that of the share that lasted was 0.81."""


def kernel_of_tables(setup: Setup, u_of_box: Array) -> PolicyKernel:
    """Return the policy of several tables, from their accelerations one after the other."""
    return table_kernel(u_of_box, make_grid(setup.settings.boxes, setup.pendulum.parameters().k))


def race(
    setup: Setup,
    candidates: Sequence[tuple[int, Array]],
    *,
    seed: int,
    workers: int = 1,
    running: Running = lambda _, __: None,
) -> list[tuple[int, Checkpoint]]:
    """Race candidates on common trials; return their indices and results, the best first.

    Args:
        setup: Pendulum, arm, settings and actuator.
        candidates: Number of training episodes of each, and its accelerations [m/s^2], shape
            (boxes,); at least one.
        seed: Master seed of the trials.
        workers: Number of threads; the result does not depend on it.
        running: Called before each round, and at the end.
    """
    rule, count = setup.settings.selection, len(candidates)
    simulation = PlantSimulation(
        MODEL, setup._replace(spread=rule.spread), seed=seed, stream=SELECTION
    )
    policy = kernel_of_tables(setup, np.concatenate([table for _, table in candidates]))
    most, finished = FIRST_BLOCK * 2 ** (rule.rounds - 1), 0
    shape = count, most
    steps, sum_x2, cause = np.zeros(shape, np.int64), np.zeros(shape), np.zeros(shape, np.int64)
    results: dict[int, Checkpoint] = {}
    alive, first = list(range(count)), 0
    while alive:
        last = max(2 * first, FIRST_BLOCK)
        rounds_left = (most // last).bit_length() - 1
        block, later = len(alive) * (last - first), rounds_left * rule.round_trials
        running(finished, finished + block + later)
        trials = simulation.draw(last - first, first).of_tables(alive)
        rows = range(len(trials.table))
        simulation.run(policy, trials, rows, duration=rule.duration, workers=workers)
        at = trials.table, trials.number
        steps[at], sum_x2[at], cause[at] = trials.steps, trials.sum_x2, trials.cause
        finished += block
        for i in alive:
            survived = int(np.sum(cause[i, :last] == TRUNCATED))
            results[i] = _scored(
                setup, candidates[i][0], survived, steps[i, :last], sum_x2[i, :last]
            )
        alive.sort(key=lambda i: (-results[i].score, i))
        # All sign tests together drop the best candidate with a probability of 5 % at most.
        kept = not_worse(steps[alive, :last], 0.05 / (count * rule.rounds))
        alive = [i for i, keep in zip(alive, kept, strict=True) if keep]
        alive = alive[: max(rule.round_trials // last, 1)]
        if len(alive) == 1 or last == most:
            break
        first = last
    running(finished, finished)
    order = sorted(results, key=lambda i: (-results[i].trials, -results[i].score, i))
    return [(i, results[i]) for i in order]


def not_worse(steps: IntArray, error: float) -> list[bool]:
    """Return which candidates the trials do not show to be worse than the first one.

    If a candidate were as good as the first, each of the two would last longer in half of the
    trials in which their durations differ. The tail of that binomial distribution is the error of
    dropping the candidate.

    Args:
        steps: Durations of common trials [steps], shape (candidates, trials); the leader first.
        error: Probability of dropping a candidate that is as good as the leader.
    """
    shorter = np.sum(steps < steps[0], axis=1)
    longer = np.sum(steps > steps[0], axis=1)
    tail = bdtrc(shorter - 1, shorter + longer, 0.5)
    return (tail > error).tolist()


def _scored(setup: Setup, episodes: int, lasted: int, steps: IntArray, sum_x2: Array) -> Checkpoint:
    """Return the results and the score of a table from its trials.

    Args:
        setup: Inputs of the trials.
        episodes: Number of training episodes before the table.
        lasted: Number of trials without a failure.
        steps: Number of steps of each trial, shape (n,).
        sum_x2: Sum of x^2 over the steps of each trial [m^2], shape (n,).
    """
    mean_duration = float(np.mean(steps)) * setup.h
    rms_x = float(np.sqrt(np.sum(sum_x2) / np.sum(steps)))
    of_duration = mean_duration / setup.settings.selection.duration
    return Checkpoint(
        episodes=episodes,
        trials=len(steps),
        survived=lasted,
        mean_duration=mean_duration,
        rms_x=rms_x,
        score=of_duration - RMS_X_WEIGHT * rms_x / paper.X_LIMIT,
    )


def measure_share(
    simulation: PlantSimulation,
    u_of_box: Array,
    *,
    target: float,
    error: float = ERROR,
    workers: int = 1,
    running: Running = lambda _, __: None,
) -> TargetTest:
    """Measure the share of trials that a selected policy lasts, until the target is decided.

    The trials are those of an evaluation of the policy on the plant of its training; their seeds
    chose nothing. The test ends when the interval lies on one side of the target, or when failures
    have put the target out of reach of the remaining trials.

    Args:
        simulation: Simulation of the trials.
        u_of_box: Acceleration of each box [m/s^2], shape (boxes,).
        target: Required share [-].
        error: Probability that the interval does not contain the share.
        workers: Number of threads; the result does not depend on it.
        running: Called before each look at the bounds, with the number of trials after which the
            target would be met, and at the end.
    """
    rule = simulation.setup.settings.selection
    policy = kernel_of_tables(simulation.setup, u_of_box)
    count, failed, causes = 0, 0, Counter[Outcome]()
    low, high = 0.0, 1.0
    while count == 0 or (low < target <= high and count < rule.test_trials):
        expected = trials_to_meet(target, error, count, failed, rule.test_trials)
        if expected is None and failed:
            break
        running(count, expected or rule.test_trials)
        trials = simulation.draw(min(TEST_BLOCK, rule.test_trials - count), count)
        rows = range(len(trials.steps))
        simulation.run(policy, trials, rows, duration=rule.duration, workers=workers)
        causes.update(TRIAL_OUTCOMES[code] for code in trials.cause.tolist())
        count += len(rows)
        failed = count - causes[Outcome.LASTED]
        low, high = confidence_sequence(count - failed, failed, error)
    running(count, count)
    return TargetTest(
        target=target,
        met=low >= target,
        duration=rule.duration,
        trials=count,
        survived=count - failed,
        interval=(low, high),
        causes=dict(causes),
    )


def trials_to_meet(target: float, error: float, count: int, failed: int, most: int) -> int | None:
    """Return the number of trials after which a target is met if no further trial fails.

    Args:
        target: Required share [-].
        error: Error of the confidence sequence.
        count: Number of trials up to now.
        failed: Number of them that failed.
        most: Maximum number of trials.

    Returns:
        The number, a multiple of `TEST_BLOCK` or `most`; None if the target is out of reach.
    """
    looks = [*range(count + TEST_BLOCK, most, TEST_BLOCK), most]
    enough = (n for n in looks if confidence_sequence(n - failed, failed, error)[0] >= target)
    return next(enough, None)


def confidence_sequence(lasted: int, failed: int, error: float) -> tuple[float, float]:
    r"""Return bounds of a share that hold after every trial at once.

    With weights by `PRIORS`, the mean likelihood of all shares over that of the true share p,

    .. math:: M_n(p) = \sum_i w_i \frac{B(a_i + s, b_i + f)}{B(a_i, b_i) \, p^s (1 - p)^f}

    is a martingale of mean 1, so that it ever exceeds 1 / error with a probability below the error
    (Ville's inequality). The bounds enclose all p whose M_n is smaller (Robbins 1970, "Statistical
    methods related to the law of the iterated logarithm"; Howard et al. 2021).

    Args:
        lasted: Number of trials that lasted, s.
        failed: Number of trials that failed, f.
        error: Probability that the bounds ever exclude the share.
    """
    means = [betaln(a + lasted, b + failed) - betaln(a, b) + log(w) for w, a, b in PRIORS]
    limit = float(np.logaddexp.reduce(means)) + log(error)

    def excess(share: float) -> float:
        return float(limit - xlogy(lasted, share) - xlog1py(failed, -share))

    n = lasted + failed
    if n == 0:
        return 0.0, 1.0

    def root(below: float, above: float) -> float:
        solve: Any = brentq  # SciPy's type allows a second result
        return float(solve(excess, below, above, xtol=1e-9))

    mean, least, most = lasted / n, 1e-12, 1.0 - 1e-12
    low = root(least, mean) if lasted and excess(least) > 0.0 else 0.0
    high = root(mean, most) if failed and excess(most) > 0.0 else 1.0
    return low, high
