r"""Search over settings for the policy that survives most often, by Optuna.

Each trial trains with other settings on several seeds and tests the policies; its value is the
fraction of all tests that survived. The tests vary the plant as the common settings (`--set`) say,
so that all trials are tested alike even where they train on different variations. The best trial of
many is best by chance, too: the finalists train and are tested again on seeds that the search has
not seen. With `--storage` a sweep continues, and several processes share it. SQLite is for one
machine: it locks a file, which network drives do not do reliably. Several machines share a server,
PostgreSQL or Optuna's gRPC proxy. With `--workers` the seeds of a trial run on a cluster::

    python experiments/sweep.py --vary learning.gamma=0.9:0.999 --storage sqlite:///sweep.sqlite3
    python experiments/sweep.py --vary learning.gamma=0.9:0.999 --storage grpc://HOST:13000
    python experiments/sweep.py --vary learning.alpha_minimum=0.001:0.1:log \
        --vary 'boxes.x=[[-0.07, 0.07], [-0.1, 0.1]]'
"""

import argparse
import json
from concurrent.futures import Executor
from typing import Any

import numpy as np
import optuna
from matplotlib.figure import Figure
from shared import options, store

import equipoise as eq
from equipoise.executors import completed, open_workers
from equipoise.settings import changed

SEEDS = 1000
"""First seed of the search; the finalists have the seeds from twice that number on."""
STORAGE_HELP = (
    "database of Optuna: sqlite:///FILE for one machine, as it locks a file; for several a server, "
    "postgresql://HOST/NAME, or grpc://HOST:13000, Optuna's proxy"
)
"""Help text of `--storage`."""


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
            integers = all(end.lstrip("-").isdecimal() for end in (low, high))
            suggest, kind = (trial.suggest_int, int) if integers else (trial.suggest_float, float)
            value = suggest(name, kind(low), kind(high), log=log == ["log"])
        overrides.append(f"{name}={value}")
    return overrides


def fraction_survived(
    overrides: list[str], seeds: range, args: argparse.Namespace, workers: int | Executor
) -> float:
    """Train with settings on each seed, and return the fraction of all tests that survived.

    Raises:
        EquipoiseError: The settings are invalid, or cannot be trained.
    """
    common = eq.resolve(args.recipe, overrides=args.set)
    settings = eq.resolve(args.recipe, overrides=[*args.set, *overrides])
    length = {"evaluation.trials": args.tests, "evaluation.duration": args.duration}
    tested = changed(settings.model_copy(update={"plant": common.plant}), length)

    def fraction(seed: int) -> float:
        policy = eq.train(eq.shipped_pendulum(), eq.iiwa(7), settings, seed=seed)
        result = eq.evaluate(policy, tested, world=args.world, seed=seed, with_baselines=False)
        return result.results.summary().rate

    return float(np.mean([result for _, result in sorted(completed(fraction, seeds, workers))]))


def storage_of(address: str | None) -> optuna.storages.BaseStorage | str | None:
    """Return the storage of `--storage`: an address of a database, or `grpc://HOST:PORT`."""
    if address is None or not address.startswith("grpc://"):
        return address
    host, _, port = address.removeprefix("grpc://").partition(":")
    return optuna.storages.GrpcStorageProxy(host=host, port=int(port or 13000))


def draw(study: optuna.Study) -> Figure:
    """Draw the fraction of tests that survived against each setting."""
    trials = study.get_trials(states=[optuna.trial.TrialState.COMPLETE])
    names = sorted(trials[0].params)
    figure = Figure(figsize=(3.5 * len(names), 3.5), layout="constrained")
    panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for panel, name in zip(panels, names, strict=True):
        values = [trial.params[name] for trial in trials]
        fractions = 100.0 * np.array([trial.value for trial in trials])
        panel.scatter(values, fractions, c=range(len(trials)), cmap="viridis", s=15)
        if getattr(trials[0].distributions[name], "log", False):
            panel.set_xscale("log")
        panel.set_xlabel(name)
        panel.tick_params("x", rotation=45)
    panels[0].set_ylabel("tests that survived [%]")
    return figure


def main() -> None:
    """Run the sweep, print the best trials, and draw the figure."""
    names = ("set", "workers", "json")
    parser = options(__doc__, *names, trials=40, duration=60.0, out="sweep.png")
    form = "NAME=LOW:HIGH[:log], or NAME=[...] with choices in JSON"
    parser.add_argument("--vary", action="append", required=True, metavar="RANGE", help=form)
    parser.add_argument("--recipe", default="robust")
    parser.add_argument("--seeds", type=int, default=1, help="trainings of each trial")
    parser.add_argument("--finalists", type=int, default=5, help="trials that are trained again")
    parser.add_argument("--final-seeds", type=int, default=10, help="trainings of each finalist")
    parser.add_argument("--world", default="model", help="world of the tests")
    parser.add_argument("--tests", type=int, default=200, help="tests of each policy")
    parser.add_argument("--storage", help=STORAGE_HELP)
    args = parser.parse_args()
    with open_workers(args.workers) as workers:
        search(args, workers)


def search(args: argparse.Namespace, workers: int | Executor) -> None:
    """Do what the command line asks for, on some workers."""
    ranges = dict(text.split("=", 1) for text in args.vary)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(
        direction="maximize",
        study_name="sweep",
        # Processes that share a storage must not try the same values.
        sampler=optuna.samplers.TPESampler(
            seed=None if args.storage else 0, constant_liar=bool(args.storage)
        ),
        storage=storage_of(args.storage),
        load_if_exists=True,
    )

    def value(trial: optuna.Trial) -> float:
        overrides = suggested(trial, ranges)
        try:
            return fraction_survived(overrides, range(SEEDS, SEEDS + args.seeds), args, workers)
        except eq.EquipoiseError as error:
            raise optuna.TrialPruned(str(error)) from None

    study.optimize(
        value,
        n_trials=max(args.trials - len(study.trials), 0),
        callbacks=[optuna.study.MaxTrialsCallback(args.trials, states=None)],
    )
    done = study.get_trials(states=[optuna.trial.TrialState.COMPLETE])
    if not done:
        raise SystemExit("no trial has valid settings; check --vary and --set")
    fresh = range(2 * SEEDS, 2 * SEEDS + args.final_seeds)
    finalists: list[dict[str, Any]] = []
    for trial in sorted(done, key=lambda trial: -trial.value)[: args.finalists]:
        final = fraction_survived(
            [f"{name}={value}" for name, value in trial.params.items()], fresh, args, workers
        )
        row = {"name": trial.number, "searched": trial.value, "final": final}
        finalists.append(row | {"settings": trial.params})
        print(f"{trial.value:7.2%}, final {final:7.2%}  {trial.number}  {trial.params}", flush=True)
    length = {name: getattr(args, name) for name in ("trials", "seeds", "tests", "final_seeds")}
    store(args.json, length | {"finalists": finalists})
    draw(study).savefig(args.out, dpi=150)


if __name__ == "__main__":
    main()
