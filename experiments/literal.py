r"""Measure the method of the paper as printed, in simulation and on robots, over many seeds.

The recipe `paper` trains one policy for each seed. Each runs in the paper's own simulation (world
`ideal`) and on digital twins with other transport delays, with and without the shaping law of the
robot's server, with and without a zero error of the encoder.

Which of these robots behaves as the authors' did? Their policy stood for 5 s and ended on the track
at x = -0.22 m, leaning by 3.44 degrees. With the set E of trials that end on the track after 4 to
6 s, leaning by 1.72 to 6.88 degrees, and a uniform prior,

.. math:: p(T) \propto P(E | T)

is the posterior of the delay T. Only policies that survive in simulation count, as the authors'
did.
If 5 s were the longest of m attempts, P(E | T) of a policy is
:math:`(F(6)^m - F(4)^m)\, P(E | 4 < t < 6)`, where F is the distribution of its survival t::

    python experiments/literal.py --out literal.png                        # an hour
"""

import argparse
from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from shared import options, store

import equipoise as eq
from equipoise import paper
from equipoise.executors import completed, open_workers
from equipoise.model.random import TEST
from equipoise.model.worlds import World
from equipoise.outcomes import TRIAL_OUTCOMES, Outcome
from equipoise.simulation import setup_of, simulate
from equipoise.simulation.evaluation import exact_interval

DELAYS = (0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0)
"""Transport delays [ms]."""
SURVIVES = 0.95
"""Fraction of 60 s trials that a policy has to last in simulation to count as balancing there."""
SURVIVAL = (4.0, 6.0)
"""Survival that counts as the paper's 5 s [s]."""
LEAN = (0.5 * abs(paper.PHI_AT_FAILURE_DEG), 2.0 * abs(paper.PHI_AT_FAILURE_DEG))
"""Lean at the end that counts as the paper's 3.44 degrees [deg]."""
KINDS = {
    "shaped_zero": (True, True, "shaping law, zero error"),
    "shaped": (True, False, "shaping law"),
    "unshaped_zero": (False, True, "zero error"),
    "unshaped": (False, False, "neither"),
}
"""Kinds of robots: with the shaping law of its server, with a zero error of the encoder, label."""
READINGS = {"either_side": (1, False), "same_side": (1, True), "best_of_ten": (10, False)}
"""Readings of the paper: number of attempts of which its run is the longest, and whether the lean
at the end has to be to the side of the end; its sign depends on the encoder's."""
TICKS = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 60.0)
"""Ticks of the survival [s]."""


def robot(delay: float, kind: str) -> World:
    """Return a robot: `twin:nominal` with another delay [ms], of a kind, without our safety rules.

    These end a run before the track does.
    """
    shaped, zero, _ = KINDS[kind]
    numbers: dict[str, Any] = {"transport": 1e-3 * delay, "shaped": shaped, "guards": False}
    if not zero:
        numbers["zero_error"] = 0.0
    return World("twin:robot", eq.read_world("twin:nominal").settings.model_copy(update=numbers))


class Ends(NamedTuple):
    """How the trials of one policy in one world ended."""

    survival: np.ndarray
    """Duration of each trial [s], shape (n,)."""
    survived: np.ndarray
    """Whether it ended without a failure, shape (n,)."""
    track: np.ndarray
    """Whether it ended on the track, shape (n,)."""
    lean: np.ndarray
    """Lean at the end towards the side of the end [deg], shape (n,)."""

    def as_the_paper(self, attempts: int, same_side: bool) -> float:
        """Return the probability that the longest of some attempts ends as the paper's run did.

        Args:
            attempts: Number of attempts.
            same_side: Whether the lean has to be to the side of the end.
        """
        lean = self.lean if same_side else np.abs(self.lean)
        low, high = ((self.survival < limit) for limit in SURVIVAL)
        inside = high & ~low
        if not inside.any():
            return 0.0
        leans = (lean > LEAN[0]) & (lean < LEAN[1])
        fraction = np.mean((leans & self.track)[inside])
        return float((high.mean() ** attempts - low.mean() ** attempts) * fraction)


def run(policy: eq.TabularPolicy, world: str | World, trials: int, duration: float) -> Ends:
    """Run trials of a policy; their starts and noise depend on its seed."""
    simulation = simulate(world, setup_of(policy, world), seed=policy.seed, stream=TEST)
    rows = simulation.draw(trials)
    simulation.run(policy, rows, duration=duration)
    outcomes = np.array([TRIAL_OUTCOMES[code] for code in rows.cause.tolist()])
    survived, track = outcomes == Outcome.SURVIVED, outcomes == Outcome.TRACK
    lean = np.degrees(rows.end[:, 2]) * np.sign(rows.end[:, 0])
    return Ends(paper.STEP * rows.steps, survived, track, lean)


def median_interval(values: Sequence[float]) -> tuple[float, float]:
    """Return the 95 % interval of a median, from the order statistics."""
    ordered, n = sorted(values), len(values)
    count = np.random.default_rng(0).binomial(n, 0.5, 100_000)
    low, high = np.quantile(count, (0.025, 0.975))
    return float(ordered[max(int(low) - 1, 0)]), float(ordered[min(int(high), n - 1)])


def summary(policies: Sequence[Ends]) -> dict[str, Any]:
    """Return the distribution over the seeds of a world."""
    medians = [float(np.median(ends.survival)) for ends in policies]
    failed = np.concatenate([~ends.survived for ends in policies])
    track = np.concatenate([ends.track for ends in policies])
    lean = np.concatenate([ends.lean for ends in policies])[track]
    fractions = [float(ends.survived.mean()) for ends in policies]
    low, high = median_interval(medians)
    result: dict[str, Any] = {
        "seeds": len(policies),
        "trials": len(failed),
        "median": round(float(np.median(medians)), 2),
        "median_low": round(low, 2),
        "median_high": round(high, 2),
        "worst": round(min(medians), 2),
        "best": round(max(medians), 2),
        "survived": round(float(np.mean(fractions)), 4),
        "best_tenth": round(float(np.sort(fractions)[-max(len(fractions) // 10, 1) :].min()), 4),
        "track": round(float(track.sum() / max(failed.sum(), 1)), 4),
        "lean": round(float(np.median(lean)), 2) if len(lean) else None,
    }
    for seconds in (5, 60):
        count = sum(median >= seconds for median in medians)
        ends = exact_interval(count, len(medians))
        names = (f"survive_{seconds}", f"survive_{seconds}_low", f"survive_{seconds}_high")
        values = (count / len(medians), *ends)
        result |= {name: round(value, 4) for name, value in zip(names, values, strict=True)}
    return result


def posterior(likelihood: np.ndarray) -> dict[str, Any]:
    """Return median and 95 % interval of the delay under a uniform prior [ms].

    They are None where no trial ended as the paper's run did.
    """
    if not likelihood.any():
        return {"delay": None, "interval": None}
    grid = np.linspace(DELAYS[0], DELAYS[-1], 1601)
    density = np.interp(grid, DELAYS, likelihood)
    cumulative = np.cumsum(density) / density.sum()
    low, middle, high = np.interp((0.025, 0.5, 0.975), cumulative, grid).tolist()
    return {"delay": round(middle, 1), "interval": [round(low, 1), round(high, 1)]}


def inferred(
    ends_by_kind: dict[str, list[list[Ends]]], survivors: Sequence[int]
) -> list[dict[str, Any]]:
    """Return the posterior of the delay for each kind of robot and each reading.

    Args:
        ends_by_kind: Trials of each policy on each robot, by kind and delay.
        survivors: Indices of the policies that survive in simulation.
    """
    rows: list[dict[str, Any]] = []
    for kind, robots in ends_by_kind.items():
        row: dict[str, Any] = {"name": kind, "label": KINDS[kind][2], "policies": len(survivors)}
        for reading, how in READINGS.items():
            likelihood = np.array(
                [np.mean([ends[i].as_the_paper(*how) for i in survivors]) for ends in robots]
            )
            row[reading] = posterior(likelihood) | {
                "probability": round(float(likelihood.max()), 4),
                "likelihood": likelihood.round(5).tolist(),
            }
        rows.append(row)
    return rows


def draw(robots: list[dict[str, Any]], delays: list[dict[str, Any]]) -> Figure:
    """Draw the survival against the delay, and the posterior of the delay."""
    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    for row in delays:
        shaped, zero, label = KINDS[row["name"]]
        look: dict[str, Any] = {"color": "tab:blue" if shaped else "tab:orange", "label": label}
        look["linestyle"] = "-" if zero else "--"
        medians = [ends[row["name"]]["median"] for ends in robots]
        left.plot(DELAYS, medians, marker="o", markersize=3, **look)
        likelihood = row["either_side"]["likelihood"]
        density = np.array(likelihood) / max(np.trapezoid(likelihood, DELAYS), 1e-12)
        right.plot(DELAYS, density, **look)
    left.axhline(paper.SECONDS_BALANCED, color="0.5", linewidth=0.8)
    left.annotate("the paper's robot: 5 s", (40.0, 5.3), ha="right", fontsize=8, color="0.3")
    left.set(yscale="log", xlabel="transport delay [ms]", ylabel="median survival of a seed [s]")
    left.set_yticks(TICKS, [f"{tick:g}" for tick in TICKS])
    left.set_yticks([], minor=True)
    right.set(xlabel="transport delay [ms]", ylabel="density of the authors' delay [1/ms]")
    right.set_ylim(bottom=0.0)
    right.legend(fontsize=8)
    return figure


def main() -> None:
    """Train, run, infer, print the tables, and draw the figure."""
    parser = options(__doc__, "set", "workers", "json", trials=5, duration=60.0, out="literal.png")
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--ideal-trials", type=int, default=200, help="per seed in simulation")
    args = parser.parse_args()
    with open_workers(args.workers) as workers:
        measure(args, workers)


def measure(args: argparse.Namespace, workers: int | Executor) -> None:
    """Do what the command line asks for, on some workers."""
    settings = eq.resolve("paper", overrides=args.set)

    def of_seed(seed: int) -> tuple[eq.TabularPolicy, Ends]:
        policy = eq.train(eq.shipped_pendulum(), eq.iiwa(7), settings, seed=seed)
        return policy, run(policy, "ideal", args.ideal_trials, args.duration)

    trained = dict(completed(of_seed, range(args.seeds), workers))
    policies, ends = zip(*(trained[i] for i in range(args.seeds)), strict=True)
    ideal = summary(ends)
    print(f"simulation: {ideal}", flush=True)

    def everywhere(world: str | World) -> list[Ends]:
        """Run all policies in a world."""
        ran = partial(run, world=world, trials=args.trials, duration=args.duration)
        ended = completed(ran, policies, workers)
        return [ends for _, ends in sorted(ended, key=lambda item: item[0])]

    twin = summary(everywhere("twin:nominal"))
    print(f"twin:nominal: {twin}", flush=True)
    ends_by_kind: dict[str, list[list[Ends]]] = {kind: [] for kind in KINDS}
    robots: list[dict[str, Any]] = []
    for delay in DELAYS:
        row: dict[str, Any] = {"delay": delay}
        for kind in KINDS:
            ends_by_kind[kind].append(everywhere(robot(delay, kind)))
            row[kind] = summary(ends_by_kind[kind][-1])
            print(f"{delay:g} ms, {KINDS[kind][2]}: {row[kind]['median']} s", flush=True)
        robots.append(row)
    survivors = [i for i, trained in enumerate(ends) if trained.survived.mean() >= SURVIVES]
    delays = inferred(ends_by_kind, survivors or range(args.seeds))
    for row in delays:
        for reading in READINGS:
            print(f"{row['label']}, {reading}: {row[reading]}")
    draw(robots, delays).savefig(args.out, dpi=150)
    found = {"ideal": ideal, "twin": twin, "robots": robots, "delays": delays}
    store(args.json, found | {"survivors": len(survivors)})


if __name__ == "__main__":
    main()
