"""Options and results that several experiments share."""

import argparse
import json
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from equipoise.executors import available_cores
from equipoise.simulation.evaluation import exact_interval

OPTIONS: dict[str, dict[str, Any]] = {
    "trials": {"type": int, "help": "trials of each policy"},
    "duration": {"type": float, "help": "length of a trial [s]"},
    "set": {"action": "append", "default": [], "metavar": "NAME=VALUE", "help": "a setting"},
    "workers": {"help": "threads, or a Dask scheduler, tcp://HOST:8786"},
    "out": {"type": Path, "help": "figure, file or folder to write"},
    "json": {"type": Path, "help": "file of the results"},
}


def options(doc: str | None, *names: str, **defaults: Any) -> argparse.ArgumentParser:
    """Return a parser with some of the options.

    Args:
        doc: Docstring of the script.
        names: Options without a default.
        defaults: Options with their defaults.
    """
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    for name in (*names, *defaults):
        parser.add_argument(f"--{name}", **OPTIONS[name])
    parser.set_defaults(**defaults)
    return parser


def store(file: Path | None, values: dict[str, Any]) -> None:
    """Write results to the file of `--json`, if it was given."""
    if file:
        file.write_text(json.dumps(values, indent=1))


def proportion(survived: int, trials: int) -> dict[str, Any]:
    """Return a result with its fraction and its exact 95 % interval."""
    rate, interval = survived / trials, exact_interval(survived, trials)
    return {"survived": survived, "trials": trials, "rate": rate, "interval": interval}


def in_processes(work: Callable[[Any], Any], tasks: Iterable[Any]) -> list[Any]:
    """Return the results of tasks, each in a process of its own."""
    spawn = get_context("spawn")
    with ProcessPoolExecutor(available_cores(), spawn, max_tasks_per_child=1) as pool:
        return list(pool.map(work, tasks))
