"""Climb from the paper's method as printed to the default recipe, one change at a time.

Each rung keeps the changes of the rungs before it. Policies of the same seeds are trained on each
rung, and tested on digital twins with the controller of that rung; on `twin:harsh` its model of the
delay is 20 ms short. Then they balance on `twin:nominal`, and the pendulum is pushed::

    python experiments/ladder.py                                           # half an hour
"""

from math import radians
from typing import Any

import numpy as np
from shared import options, store

import equipoise as eq
from equipoise.control.policy import tick_policy
from equipoise.executors import completed, open_workers
from equipoise.model.grid import TRUNCATED
from equipoise.model.random import TEST
from equipoise.settings import changed
from equipoise.simulation import TrialRecorder, run_trial, setup_of, simulate
from equipoise.simulation.evaluation import Summary, exact_interval

PUSH = radians(60.0)
"""Change of the pendulum's rate by a push [rad/s], to either side in turn."""
PUSHED_AT, PUSHED_UNTIL = 3.0, 8.0
"""Time of the push, and end of the trial [s]."""

CHANGES: dict[str, tuple[str, ...]] = {
    "the literal recipe": (),
    "+ prediction, estimate of the zero": ("controller",),
    "+ training behind the actuator": ("plant",),
    "+ look-ahead": ("boxes",),
    "+ mirrored updates": ("learning.mirrored",),
    "+ failure alone costs": ("learning.reward",),
    "+ averages of tables": ("selection",),
    "+ inclined starts: the default": ("learning",),
}
"""Sections and settings of recipe `robust` that each rung takes up."""


def rungs(overrides: list[str]) -> dict[str, eq.Settings]:
    """Return the settings of each rung, from recipe `paper` to recipe `robust`.

    Args:
        overrides: Single settings of every rung, such as `learning.episodes=1000`.
    """
    settings, default = eq.resolve("paper", overrides=overrides), eq.resolve(overrides=overrides)
    settings_of: dict[str, eq.Settings] = {}
    for name, taken in CHANGES.items():
        changes: dict[str, Any] = {}
        for result in taken:
            section, _, key = result.partition(".")
            group = getattr(default, section)
            keys = [key] if key else type(group).model_fields
            changes |= {f"{section}.{one}": getattr(group, one) for one in keys}
        settings = changed(settings, changes)
        settings_of[name] = settings
    return settings_of


def tested(summaries: list[Summary]) -> dict[str, Any]:
    """Return the results of a rung in one world, from those of its policies."""
    survived, trials = sum(s.survived for s in summaries), sum(s.trials for s in summaries)
    rates = [s.rate for s in summaries]
    return {
        "trials": trials,
        "fraction": survived / trials,
        "interval": exact_interval(survived, trials),
        "worst": min(rates),
        "median_seed": float(np.median(rates)),
        "median": float(np.median([s.median for s in summaries])),
    }


class Push(TrialRecorder):
    """Push of the pendulum at a time of a trial, in place of a recording."""

    def __init__(self, rate: float) -> None:
        """Plan a push that changes the pendulum's rate [rad/s]."""
        self._rate = rate

    def before(self, loop: Any, u: float) -> None:
        """Push before the step that begins at the time of the push."""
        if round(loop.now / loop.params.h) == round(PUSHED_AT / loop.params.h):
            loop.push(self._rate)

    def after(self, loop: Any) -> None:
        """Record nothing."""


def withstood(policy: eq.TabularPolicy, actuator: eq.Actuator | None, pushes: int) -> int:
    """Return the number of pushes after which a policy balances on.

    Args:
        policy: The policy.
        actuator: The controller's model of the arm; None for that of the training.
        pushes: Number of trials, each with one push.
    """
    setup = setup_of(policy, "twin:nominal", actuator=actuator)
    simulation = simulate("twin:nominal", setup, seed=99, stream=TEST)
    loop, trials, acting = simulation.loop(), simulation.draw(pushes), tick_policy(policy)
    ends = [
        run_trial(loop, acting, trials.trial(i), PUSHED_UNTIL, Push(PUSH if i % 2 else -PUSH))
        for i in range(pushes)
    ]
    return sum(end.cause == TRUNCATED for end in ends)


def main() -> None:
    """Train and test each rung on every seed, and print the table."""
    parser = options(__doc__, "set", "workers", "json", trials=20, duration=60.0)
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--worlds", nargs="+", default=["twin:nominal", "twin:harsh"])
    args = parser.parse_args()
    length = {"evaluation.trials": args.trials, "evaluation.duration": args.duration}
    settings_of = {name: changed(rung, length) for name, rung in rungs(args.set).items()}

    def results(task: tuple[str, int]) -> tuple[list[Summary], int]:
        """Train on a rung with a seed; return summaries by world, and the pushes withstood."""
        settings, seed = settings_of[task[0]], task[1]
        policy = eq.train(eq.shipped_pendulum(), eq.iiwa(7), settings, seed=seed)
        # A controller that predicts nothing assumes an arm without delay.
        known = eq.shipped_actuator() if settings.controller.predict else None
        how: dict[str, Any] = {"actuator": known, "seed": seed, "with_baselines": False}
        evaluations = (eq.evaluate(policy, settings, world=w, **how) for w in args.worlds)
        summaries = [evaluation.results.summary() for evaluation in evaluations]
        return summaries, withstood(policy, known, args.trials)

    tasks = [(name, seed) for name in settings_of for seed in range(args.seeds)]
    found: dict[str, list[tuple[list[Summary], int]]] = {name: [] for name in settings_of}
    rows: dict[str, dict[str, Any]] = {}
    with open_workers(args.workers) as workers:
        for i, result in completed(results, tasks, workers):
            name = tasks[i][0]
            found[name].append(result)
            if len(found[name]) < args.seeds:
                continue
            summaries = zip(*(summaries for summaries, _ in found[name]), strict=True)
            by_world = zip(args.worlds, summaries, strict=True)
            row = {world.removeprefix("twin:"): tested(list(result)) for world, result in by_world}
            pushed = sum(balanced for _, balanced in found[name]) / (args.seeds * args.trials)
            rows[name] = {"name": name, "seeds": args.seeds, "pushed": pushed} | row
            fractions = (
                f"{world} {of['fraction']:.1%} ({of['median']:.1f} s)" for world, of in row.items()
            )
            print(f"{name}: {', '.join(fractions)}, pushed {pushed:.1%}", flush=True)
    store(args.json, {"rows": [rows[name] for name in settings_of]})


if __name__ == "__main__":
    main()
