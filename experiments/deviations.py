"""Measure what each deviation from the paper does: train with it taken back, and evaluate.

Prints the table of `docs/deviations.md`. Takes half an hour on two cores; `--seeds` and `--trials`
make it shorter.
"""

import argparse

import numpy as np

from equipoise.executors import available_cores, completed
from equipoise.learning.train import train
from equipoise.model.actuator import shipped_actuator
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.pendulum import Pendulum
from equipoise.settings import Settings, resolve
from equipoise.worlds.evaluation import Summary, evaluate, exact_interval

LAST = "selection.candidates=1"
"""The last averaged table, without a race."""

TAKEN_BACK = {
    "none: the last averaged table": ("robust", [LAST]),
    "with the race of late tables": ("robust", []),
    "linearised pendulum (eq. 7)": ("robust", [LAST, "plant.linearised=true"]),
    "no noise on I, b and e": (
        "robust",
        [
            LAST,
            "plant.inertia_sigma=0",
            "plant.friction_sigma=0",
            "plant.position_error_sigma=0",
            "plant.orientation_error_sigma=0",
        ],
    ),
    "the arm follows at once, the state is known": ("robust", [LAST, "plant.ideal=true"]),
    "delay, lag and zero as identified": (
        "robust",
        [LAST, "plant.delay_spread=0", "plant.lag_spread=0", "plant.zero_error=0"],
    ),
    "the table sees the present x": ("robust", [LAST, "boxes.look_ahead=0"]),
    "gamma = 0.97": ("robust", [LAST, "learning.gamma=0.97"]),
    "5,000 episodes": ("robust", [LAST, "learning.episodes=5000"]),
    "double Q-learning": ("robust", [LAST, "learning.learner=double_q"]),
    "Watkins's Q(0.7)": ("robust", [LAST, "learning.learner=watkins"]),
    "an update in each step": ("robust", [LAST, "learning.hold_action=false"]),
    "constant alpha = 0.1": (
        "robust",
        [LAST, "learning.alpha_initial=0.1", "learning.alpha_decay=0", "learning.alpha_minimum=0"],
    ),
    "constant epsilon = 0.1": (
        "robust",
        [LAST, "learning.epsilon_initial=0.1", "learning.epsilon_until=0"],
    ),
    "no mirrored updates": ("robust", [LAST, "learning.mirrored=false"]),
    "starts near upright only": (
        "robust",
        [LAST, "learning.start_x=0", "learning.start_x_dot=0", "learning.start_phi_dot=0"],
    ),
    "the last table, not its average": ("robust", ["selection.every=0"]),
    "recipe paper": ("paper", []),
}


def main() -> None:
    """Train and evaluate each variant on every seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--trials", type=int, default=200)
    arguments = parser.parse_args()
    # Whatever a policy was trained on, it is tested on the nonlinear plant with its noise, behind
    # the shipped actuator.
    test = resolve(overrides=[f"evaluation.trials={arguments.trials}"])
    pendulum, arm = Pendulum.assumed(70.2, 0.15), iiwa(7)
    print("| reverted | share of 60 s | 95 % | worst, median seed | seeds at 99 % | on the track |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, (recipe, overrides) in TAKEN_BACK.items():
        settings = resolve(recipe, overrides=overrides)

        def result(seed: int, settings: Settings = settings) -> Summary:
            policy = train(pendulum, arm, settings, seed=seed)
            actuator = shipped_actuator()
            evaluation = evaluate(policy, test, actuator=actuator, seed=seed, with_baselines=False)
            return evaluation.results.summary()

        runs = completed(result, range(arguments.seeds), available_cores())
        summaries = [found for _, found in runs]
        survived = sum(s.survived for s in summaries)
        trials = sum(s.trials for s in summaries)
        track = sum(s.outcomes.get("track", 0) for s in summaries)
        low, high = exact_interval(survived, trials)
        rates = [s.rate for s in summaries]
        print(
            f"| {name} | {survived / trials:.4f} | {low:.4f}–{high:.4f} "
            f"| {min(rates):.3f}, {np.median(rates):.3f} | {sum(r >= 0.99 for r in rates)} "
            f"| {f'{track / (trials - survived):.0%}' if survived < trials else 'none failed'} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
