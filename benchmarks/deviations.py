"""Measure what each deviation from the paper does: train with it taken back, and evaluate.

Prints the table of `docs/deviations.md`. Takes the better part of an hour on two cores; `--seeds`
and `--trials` make it shorter.
"""

import argparse

import numpy as np
from scipy.stats import binomtest

from equipoise.evaluation import evaluate
from equipoise.model.actuator import shipped_actuator
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.pendulum import Pendulum
from equipoise.settings import resolve
from equipoise.simulation import available_cores
from equipoise.training import train

TAKEN_BACK = {
    "recipe robust, as it is": ("robust", []),
    "linearised pendulum (eq. 7)": ("robust", ["plant.linearised=true"]),
    "no noise on I, b and e": (
        "robust",
        [
            "plant.inertia_sigma=0",
            "plant.friction_sigma=0",
            "plant.position_error_sigma=0",
            "plant.orientation_error_sigma=0",
        ],
    ),
    "the arm follows at once, the state is known": ("robust", ["plant.ideal=true"]),
    "delay, lag and zero as identified": (
        "robust",
        ["plant.delay_spread=0", "plant.lag_spread=0", "plant.zero_error=0"],
    ),
    "only a failure costs": ("robust", ["learning.reward=paper"]),
    "only a failure costs, gamma = 0.97": (
        "robust",
        ["learning.reward=paper", "learning.gamma=0.97"],
    ),
    "an update in each step": ("robust", ["learning.hold_action=false"]),
    "constant alpha = 0.1": (
        "robust",
        ["learning.alpha_initial=0.1", "learning.alpha_decay=0", "learning.alpha_minimum=0"],
    ),
    "constant epsilon = 0.1": (
        "robust",
        ["learning.epsilon_initial=0.1", "learning.epsilon_until=0"],
    ),
    "no mirrored updates": ("robust", ["learning.mirrored=false"]),
    "starts near upright only": (
        "robust",
        ["learning.start_x=0", "learning.start_x_dot=0", "learning.start_phi_dot=0"],
    ),
    "the last table, not the selected one": ("robust", ["selection.every=0"]),
    "recipe paper": ("paper", []),
}


def main() -> None:
    """Train and evaluate each variant on every seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--trials", type=int, default=1000)
    arguments = parser.parse_args()
    # Whatever a policy was trained on, it is tested on the nonlinear plant with its noise, behind
    # the shipped actuator.
    test = resolve(overrides=[f"evaluation.trials={arguments.trials}"])
    pendulum, arm, workers = Pendulum.assumed(70.2, 0.15), iiwa(7), available_cores()
    print("| taken back | pooled share of 60 s | 95 % | worst and best seed | median [s] | track |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, (recipe, overrides) in TAKEN_BACK.items():
        settings = resolve(recipe, overrides=overrides)
        summaries = []
        for seed in range(arguments.seeds):
            policy = train(pendulum, arm, settings, seed=seed, workers=workers)
            evaluation = evaluate(
                policy,
                test,
                actuator=shipped_actuator(),
                seed=seed,
                with_baselines=False,
                workers=workers,
            )
            summaries.append(evaluation.results.summary())
        survived = sum(s.survived for s in summaries)
        trials = sum(s.trials for s in summaries)
        failed = max(1, trials - survived)
        track = sum(s.causes.get("track", 0) for s in summaries) / failed
        low, high = binomtest(survived, trials).proportion_ci(method="exact")
        rates = [s.rate for s in summaries]
        print(
            f"| {name} | {survived / trials:.4f} | {low:.4f} to {high:.4f} "
            f"| {min(rates):.3f}, {max(rates):.3f} "
            f"| {np.median([s.median for s in summaries]):.1f} | {track:.0%} of failures |",
            flush=True,
        )


if __name__ == "__main__":
    main()
