"""Separate the gap between training plant and twin into its effects.

A policy runs on the digital twin with its cures and without each. A table that was trained as the
paper describes, with an ideal arm and a known state, runs for comparison. All runs are trials with
the same starts and random numbers:

1. Survival against the transport delay, and against a constant error of the encoder's zero.
2. The step from the training plant to the twin, effect by effect, for the paper's table. A *clean*
   twin has every effect switched off. Each effect is added there alone, and removed alone from the
   full twin. Effects do not add up, so that both lists are needed.
3. All named worlds: assumptions about the robot's servo, which KUKA does not publish.

The cures use the actuator that an identification on the changed twin would find, except for the
controller `training actuator`. Every difference is a result on our twin, not a measurement of the
authors' robot::

    python experiments/gap.py POLICY --out gap.png
    python experiments/gap.py --quick
"""

import argparse
from collections.abc import Sequence
from concurrent.futures import Executor
from math import degrees, radians
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import t as student
from shared import options, store

import equipoise as eq
from equipoise.executors import open_workers
from equipoise.model.worlds import CLEAN, EFFECTS, WORLDS, TwinSettings, World
from equipoise.settings import changed
from equipoise.simulation.twin.servo_model import equivalent_actuator

DELAYS = (0.0, 0.005, 0.010, 0.020, 0.030)
"""Transport delays [s]."""
ZEROS = tuple(map(radians, (0.0, 0.25, 0.5, 0.75, 1.0)))
"""Constant errors of the encoder's zero [rad]."""
LINES = {
    "cured": {"color": "tab:blue", "marker": "o", "linewidth": 3.0},
    "training actuator": {"color": "tab:cyan", "marker": "s", "linestyle": "--"},
    "no prediction": {"color": "tab:orange", "marker": "^", "linestyle": "-."},
    "no bias estimate": {"color": "tab:green", "marker": "D", "linestyle": ":"},
    "paper": {"color": "tab:red", "marker": "v"},
    "paper, clean twin": {"color": "black", "marker": "x", "linestyle": "--"},
}
"""Line of each controller."""
WITHOUT = {"no prediction": ("predict",), "no bias estimate": ("estimate_bias",)}
"""Cures that a controller leaves out; the paper's has neither."""


class Mean(NamedTuple):
    """Mean survival, or mean difference, with half its 95 % interval (Student's) [s]."""

    mean: float
    half: float

    def __str__(self) -> str:
        """Return mean and interval as text."""
        return f"{self.mean:.1f} ± {self.half:.1f} s"

    def row(self) -> dict[str, Any]:
        """Return mean and interval for the file of results."""
        return {"mean": self.mean, "interval": [self.mean - self.half, self.mean + self.half]}


def mean_of(seconds: Sequence[float]) -> Mean:
    """Return the mean of some trials with its interval."""
    quantile = float(student.ppf(0.975, len(seconds) - 1))
    half = quantile * np.std(seconds, ddof=1) / np.sqrt(len(seconds))
    return Mean(float(np.mean(seconds)), float(half))


class Study(NamedTuple):
    """Policies and trials of the study."""

    policy: eq.TabularPolicy
    """The policy with its cures."""
    paper: eq.TabularPolicy
    """The table that was trained as the paper describes."""
    twin: World
    """The twin."""
    evaluation: dict[str, float]
    """Number and length of the trials of each point."""
    workers: int | Executor
    """Number of threads of the trials, or a cluster."""

    def survival(self, controller: str, world: TwinSettings | None) -> tuple[float, ...]:
        """Return the survival of each trial of a controller [s].

        Args:
            controller: A key of `LINES`.
            world: Numbers of the twin; None for the training plant.
        """
        is_paper = controller.startswith("paper")
        table = self.paper if is_paper else self.policy
        absent = ("predict", "estimate_bias") if is_paper else WITHOUT.get(controller, ())
        changes = self.evaluation | {f"controller.{name}": False for name in absent}
        settings = changed(table.settings, changes)
        known = None
        if world is not None and not is_paper and controller != "training actuator":
            known = identified_on(self.policy.actuator, self.twin.settings, world)
        there = "model" if world is None else World(self.twin.name, world)
        args = {"with_baselines": False, "workers": self.workers}
        result = eq.evaluate(table, settings, world=there, actuator=known, **args)
        return result.results.survival


def identified_on(actuator: eq.Actuator, twin: TwinSettings, other: TwinSettings) -> eq.Actuator:
    """Return the actuator that an identification would find on a changed twin."""
    before, after = equivalent_actuator(twin), equivalent_actuator(other)

    def moved(estimate: eq.Estimate, by: float = 0.0, times: float = 1.0) -> eq.Estimate:
        ends = {name: times * getattr(estimate, name) + by for name in ("low", "value", "high")}
        return estimate.model_copy(update=ends).not_negative()

    lag = after.lags[0].value - before.lags[0].value
    return actuator.model_copy(
        update={
            "kind": actuator.kind if after.kind == before.kind else after.kind,
            "delay": moved(actuator.delay, after.delay.value - before.delay.value),
            "lags": tuple(moved(each, lag) for each in actuator.lags),
            "cycle": moved(actuator.cycle, times=after.cycle.value / before.cycle.value),
        }
    )


def curves(study: Study, number: str, values: Sequence[float]) -> dict[str, list[Mean]]:
    """Return the survival of each controller against one number of the twin."""
    full = study.twin.settings
    points_of: dict[str, list[Mean]] = {}
    for controller in LINES:
        base = full.model_copy(update=CLEAN) if controller.endswith("clean twin") else full
        if number == "zero_offset":
            base = base.model_copy(update={"zero_error": 0.0})
        points = [base.model_copy(update={number: value}) for value in values]
        points_of[controller] = [mean_of(study.survival(controller, each)) for each in points]
        print(f"{number}, {controller}: {', '.join(map(str, points_of[controller]))}", flush=True)
    return points_of


class Effects(NamedTuple):
    """Survival of the paper's table on its plant, and what each effect of a robot changes."""

    plant: Mean
    """Survival on the plant of its training."""
    clean: Mean
    """Survival on the clean twin."""
    full: Mean
    """Survival on the full twin."""
    changes: dict[str, tuple[Mean, Mean]]
    """Change by each effect: added alone to the clean twin, removed from the full one."""


def effects(study: Study) -> Effects:
    """Return what each effect changes: added alone to the clean twin, removed from the full one."""
    full = study.twin.settings
    clean = full.model_copy(update=CLEAN)
    plant = mean_of(study.survival("paper", None))
    at_best, as_is = study.survival("paper", clean), study.survival("paper", full)
    print(f"paper: {plant} on its plant, {mean_of(at_best)} clean, {mean_of(as_is)} full twin")
    changes: dict[str, tuple[Mean, Mean]] = {}
    for name, off in EFFECTS.items():
        on = {number: getattr(full, number) for number in off}
        alone = study.survival("paper", clean.model_copy(update=on))
        removed = study.survival("paper", full.model_copy(update=off))
        changes[name] = (
            mean_of(np.subtract(alone, at_best)),
            mean_of(np.subtract(removed, as_is)),
        )
        print(f"{name}: alone {changes[name][0]}, removed {changes[name][1]}", flush=True)
    return Effects(plant, mean_of(at_best), mean_of(as_is), changes)


def survived(survival: Sequence[float], args: argparse.Namespace) -> dict[str, int]:
    """Return how many of the trials survived."""
    return {"survived": sum(t >= args.duration for t in survival), "trials": len(survival)}


def results(
    delay: dict[str, list[Mean]],
    zero: dict[str, list[Mean]],
    changes_by_effect: Effects,
    worlds: dict[str, Any],
) -> dict[str, Any]:
    """Return all results for a file, by the names that the documents use."""

    def named(curve: dict[str, list[Mean]], at: Sequence[str]) -> dict[str, Any]:
        rows = {name: [mean.row() for mean in means] for name, means in curve.items()}
        return {name: dict(zip(at, each, strict=True)) for name, each in rows.items()}

    return {
        "delay": named(delay, [f"{1e3 * each:.0f}ms" for each in DELAYS]),
        "zero": named(zero, [f"{100 * degrees(each):.0f}" for each in ZEROS]),
        "plant": changes_by_effect.plant.row(),
        "clean": changes_by_effect.clean.row(),
        "full": changes_by_effect.full.row(),
        "effects": [
            {"name": name, "alone": alone.row(), "removed": removed.row()}
            for name, (alone, removed) in changes_by_effect.changes.items()
        ],
        "worlds": worlds,
    }


def draw(
    delay: dict[str, list[Mean]],
    zero: dict[str, list[Mean]],
    of_effects: dict[str, tuple[Mean, Mean]],
) -> Figure:
    """Draw both curves, and the effects below them."""
    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    axes = figure.subplots(2, 2, sharey="row")
    panels = ((axes[0, 0], delay, 1e3 * np.array(DELAYS), "transport delay [ms]"),)
    panels += ((axes[0, 1], zero, np.degrees(ZEROS), "error of the encoder's zero [deg]"),)
    for panel, curve, x, label in panels:
        for controller, points in curve.items():
            middle, half = np.transpose(points)
            panel.errorbar(
                x[: len(middle)], middle, yerr=half, label=controller, **LINES[controller]
            )
        panel.set(xlabel=label, yscale="log")
    axes[0, 0].set_ylabel("mean survival [s]")
    axes[0, 0].legend(fontsize=8)
    names = list(of_effects)
    for panel, column, label in ((axes[1, 0], 0, "added alone"), (axes[1, 1], 1, "removed alone")):
        middle, half = np.transpose([of_effects[name][column] for name in names])
        panel.errorbar(middle, range(len(names)), xerr=half, fmt="o", color="tab:red", capsize=2)
        panel.axvline(0.0, color="0.6", linewidth=0.8)
        panel.set(xlabel=f"change of the mean survival, {label} [s]")
    axes[1, 0].set_yticks(range(len(names)), names)
    axes[1, 0].invert_yaxis()
    return figure


def main() -> None:
    """Run the study, print its points, and draw the figure."""
    parser = options(__doc__, "set", "workers", "json", trials=40, duration=60.0, out="gap.png")
    parser.add_argument("policy", nargs="?", help="a table; by default the shipped one")
    parser.add_argument("--world", default="twin:nominal")
    parser.add_argument("--quick", action="store_true", help="8 trials of 20 s, without worlds")
    args = parser.parse_args()
    with open_workers(args.workers) as workers:
        measure(args, workers)


def measure(args: argparse.Namespace, workers: int | Executor) -> None:
    """Do what the command line asks for, on some workers."""
    policy = eq.TabularPolicy.load(args.policy) if args.policy else eq.shipped_policy()
    settings = eq.resolve("paper", overrides=args.set)
    paper = eq.train(policy.pendulum, policy.arm, settings, workers=workers)
    trials, duration = args.trials, args.duration
    if args.quick:
        trials, duration = min(trials, 8), min(duration, 20.0)
    length = {"evaluation.trials": trials, "evaluation.duration": duration}
    study = Study(policy, paper, eq.read_world(args.world), length, workers)
    delay, zero = curves(study, "transport", DELAYS), curves(study, "zero_offset", ZEROS)
    paper_effects = effects(study)
    draw(delay, zero, paper_effects.changes).savefig(args.out, dpi=150)
    worlds: dict[str, Any] = {}
    for name in () if args.quick else WORLDS:
        world = eq.read_world(f"twin:{name}").settings
        known, training = (study.survival(who, world) for who in ("cured", "training actuator"))
        worlds[name] = {
            "known": survived(known, args),
            "training": survived(training, args),
            "training_mean": float(np.mean(training)),
        }
        print(name, worlds[name], flush=True)
    store(args.json, results(delay, zero, paper_effects, worlds))


if __name__ == "__main__":
    main()
