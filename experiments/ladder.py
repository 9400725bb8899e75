"""Climb from the paper's method as printed to the default recipe, one change at a time.

Each rung keeps the changes of the rungs before it. Policies of the same seeds are trained on each
rung, and tested on digital twins with the controller of that rung; on `twin:harsh` its model of the
delay is 20 ms short::

    python experiments/ladder.py                                           # an hour
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

import equipoise as eq
from equipoise.executors import available_cores, completed
from equipoise.settings import changed
from equipoise.worlds.evaluation import Summary, exact_interval

CHANGES: dict[str, tuple[str, ...]] = {
    "the literal recipe": (),
    "+ prediction, estimate of the zero": ("controller",),
    "+ training behind the actuator": ("plant",),
    "+ look-ahead": ("boxes",),
    "+ held actions": ("learning.hold_action",),
    "+ mirrored updates": ("learning.mirrored",),
    "+ reward, discount": ("learning.reward", "learning.gamma"),
    "+ learning rate": tuple(f"learning.alpha_{x}" for x in ("initial", "decay", "minimum")),
    "+ exploration, starts": ("learning",),
    "+ averages of tables": ("selection.averaging",),
    "+ race on varied plants: the default": ("selection",),
}
"""Sections and settings of recipe `robust` that each rung takes up."""


def rungs(overrides: list[str]) -> dict[str, eq.Settings]:
    """Return the settings of each rung, from recipe `paper` to recipe `robust`.

    Args:
        overrides: Single settings of every rung, such as `learning.episodes=1000`.
    """
    settings, default = eq.resolve("paper", overrides=overrides), eq.resolve(overrides=overrides)
    found: dict[str, eq.Settings] = {}
    for name, taken in CHANGES.items():
        changes: dict[str, Any] = {}
        for each in taken:
            section, _, key = each.partition(".")
            group = getattr(default, section)
            keys = [key] if key else type(group).model_fields
            changes |= {f"{section}.{one}": getattr(group, one) for one in keys}
        settings = changed(settings, changes)
        found[name] = settings
    return found


def tested(found: list[Summary]) -> dict[str, Any]:
    """Return the results of a rung in one world, from those of its policies."""
    survived, trials = sum(s.survived for s in found), sum(s.trials for s in found)
    rates = [s.rate for s in found]
    return {
        "trials": trials,
        "share": survived / trials,
        "interval": exact_interval(survived, trials),
        "worst": min(rates),
        "median_seed": float(np.median(rates)),
        "median": float(np.median([s.median for s in found])),
    }


def main() -> None:
    """Train and test each rung on every seed, and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--trials", type=int, default=20, help="trials of each policy")
    parser.add_argument("--duration", type=float, default=60.0, help="length of a trial [s]")
    parser.add_argument("--worlds", nargs="+", default=["twin:nominal", "twin:harsh"])
    parser.add_argument("--set", action="append", default=[], help="a setting of every rung")
    parser.add_argument("--json", type=Path, help="file for the results")
    given = parser.parse_args()
    pendulum, arm = eq.shipped_pendulum(), eq.iiwa(7)
    length = {"evaluation.trials": given.trials, "evaluation.duration": given.duration}
    rows: list[dict[str, Any]] = []
    for name, rung in rungs(given.set).items():
        settings = changed(rung, length)
        # A controller that predicts nothing assumes an arm without delay.
        known = eq.shipped_actuator() if settings.controller.predict else None

        def results(
            seed: int, settings: eq.Settings = settings, known: eq.Actuator | None = known
        ) -> list[Summary]:
            policy = eq.train(pendulum, arm, settings, seed=seed)
            how: dict[str, Any] = {"actuator": known, "seed": seed, "with_baselines": False}
            evaluations = (eq.evaluate(policy, settings, world=w, **how) for w in given.worlds)
            return [evaluation.results.summary() for evaluation in evaluations]

        found = [each for _, each in completed(results, range(given.seeds), available_cores())]
        by_world = zip(given.worlds, zip(*found, strict=True), strict=True)
        row = {world.removeprefix("twin:"): tested(list(each)) for world, each in by_world}
        rows.append({"name": name, "seeds": given.seeds} | row)
        shares = (f"{world} {of['share']:.1%} ({of['median']:.1f} s)" for world, of in row.items())
        print(f"{name}: {', '.join(shares)}", flush=True)
    if given.json:
        given.json.write_text(json.dumps({"rows": rows}, indent=1))


if __name__ == "__main__":
    main()
