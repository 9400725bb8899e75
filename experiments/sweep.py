r"""Search over settings for the policy that lasts best, by Optuna.

Each trial trains one learner with other settings and tests its policy. The tests vary the plant as
the common settings (`--set`) say, so that all trials are tested alike even where they train on
different variations. With `--storage` a sweep continues, on any number of machines::

    python experiments/sweep.py --vary learning.gamma=0.9:0.999 --storage sqlite:///sweep.sqlite3
    python experiments/sweep.py --vary learning.alpha_minimum=0.001:0.1:log \
        --vary 'boxes.x=[[-0.07, 0.07], [-0.1, 0.1]]'
"""

import argparse
import json
from typing import Any

import numpy as np
import optuna
from matplotlib.figure import Figure

import equipoise as eq
from equipoise.executors import available_cores


def suggested(trial: optuna.Trial, ranges: dict[str, str]) -> list[str]:
    """Return the overrides of a trial.

    Args:
        trial: The trial, which draws the values.
        ranges: `LOW:HIGH`, `LOW:HIGH:log` or a JSON list of choices, by the names of the settings.
    """
    overrides: list[str] = []
    for name, text in ranges.items():
        if text.startswith("["):
            choices = [json.dumps(choice) for choice in json.loads(text)]
            value = trial.suggest_categorical(name, choices)
        else:
            low, high, *log = text.split(":")
            whole = all(end.lstrip("-").isdecimal() for end in (low, high))
            suggest, kind = (trial.suggest_int, int) if whole else (trial.suggest_float, float)
            value = suggest(name, kind(low), kind(high), log=log == ["log"])
        overrides.append(f"{name}={value}")
    return overrides


def share_lasted(trial: optuna.Trial, ranges: dict[str, str], given: argparse.Namespace) -> float:
    """Train with the settings of a trial, and return the share of its tests that lasted."""
    common = eq.resolve(given.recipe, overrides=given.set)
    try:
        settings = eq.resolve(given.recipe, overrides=[*given.set, *suggested(trial, ranges)])
        policy = eq.train(eq.shipped_pendulum(), eq.iiwa(7), settings, learner=trial.number)
    except eq.EquipoiseError as error:
        raise optuna.TrialPruned(str(error)) from None
    length: dict[str, Any] = {"trials": given.tests, "duration": given.duration}
    evaluation = common.evaluation.model_copy(update=length)
    tested = settings.model_copy(update={"plant": common.plant, "evaluation": evaluation})
    found = eq.evaluate(policy, tested, world=given.world, with_baselines=False)
    return found.results.summary().rate


def draw(study: optuna.Study) -> Figure:
    """Draw the share of tests that lasted against each setting."""
    trials = study.get_trials(states=[optuna.trial.TrialState.COMPLETE])
    names = sorted(trials[0].params)
    figure = Figure(figsize=(3.5 * len(names), 3.5), layout="constrained")
    panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for panel, name in zip(panels, names, strict=True):
        values = [trial.params[name] for trial in trials]
        shares = 100.0 * np.array([trial.value for trial in trials])
        panel.scatter(values, shares, c=range(len(trials)), cmap="viridis", s=15)
        if getattr(trials[0].distributions[name], "log", False):
            panel.set_xscale("log")
        panel.set_xlabel(name)
        panel.tick_params("x", rotation=45)
    panels[0].set_ylabel("tests that lasted [%]")
    return figure


def main() -> None:
    """Run the sweep, print the best trials, and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    form = "NAME=LOW:HIGH[:log], or NAME=[...] with choices in JSON"
    parser.add_argument("--vary", action="append", required=True, metavar="RANGE", help=form)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--recipe", default="robust")
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--world", default="model", help="world of the tests")
    parser.add_argument("--tests", type=int, default=200, help="tests of each policy")
    parser.add_argument("--duration", type=float, default=60.0, help="length of a test [s]")
    parser.add_argument("--storage", help="database of Optuna, e.g. sqlite:///sweep.sqlite3")
    parser.add_argument("--out", default="sweep.png", help="figure")
    given = parser.parse_args()
    ranges = dict(text.split("=", 1) for text in given.vary)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(
        direction="maximize", study_name="sweep", storage=given.storage, load_if_exists=True
    )
    left = max(given.trials - len(study.trials), 0)
    study.optimize(
        lambda trial: share_lasted(trial, ranges, given), n_trials=left, n_jobs=available_cores()
    )
    done = study.get_trials(states=[optuna.trial.TrialState.COMPLETE])
    if not done:
        raise SystemExit("no trial has valid settings; check --vary and --set")
    for trial in sorted(done, key=lambda trial: -trial.value)[:10]:
        print(f"{trial.value:7.2%}  trial {trial.number}  {trial.params}")
    draw(study).savefig(given.out, dpi=150)


if __name__ == "__main__":
    main()
