"""What a cluster costs: tasks per second, and the fraction of the workers' time that is no trial.

A scheduler and two workers start on this machine. Tasks without work give the most tasks per
second; tasks of 10, 100 and 1,000 trials of a minute in the world `model` give the overhead::

    python benchmarks/cluster.py
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

from distributed import LocalCluster

import equipoise as eq
from equipoise.executors import completed, open_workers
from equipoise.model.random import TEST
from equipoise.simulation import Simulation, setup_of, simulate

WORKERS = 2
"""Number of worker processes, of one thread each."""
TASKS = {10: 600, 100: 80, 1000: 10}
"""Number of tasks by their trials; some ten seconds each."""
EMPTY = 2000
"""Number of tasks without work."""
DURATION = 60.0
"""Length of a trial [s]."""


def main() -> None:
    """Measure, and print a row for each size of the tasks."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="file of the results")
    args = parser.parse_args()
    policy = eq.shipped_policy()
    simulation = simulate("model", setup_of(policy, "model"), seed=0, stream=TEST)

    def run(work: tuple[Simulation, int]) -> float:
        """Run trials, and return the time that they take [s]."""
        simulation, trials = work
        begin = time.perf_counter()
        rows = simulation.draw(trials)
        simulation.run(policy, rows, duration=DURATION)
        return time.perf_counter() - begin

    cluster = LocalCluster(n_workers=WORKERS, threads_per_worker=1, dashboard_address=None)
    with cluster, open_workers(cluster.scheduler_address) as workers:
        list(completed(run, [(simulation, 100)] * 8 * WORKERS, workers))  # loads the kernels
        begin = time.perf_counter()
        list(completed(abs, range(EMPTY), workers))
        empty = EMPTY / (time.perf_counter() - begin)
        print(f"without work: {empty:.0f} tasks a second", flush=True)
        rows: list[dict[str, Any]] = []
        for trials, tasks in TASKS.items():
            begin = time.perf_counter()
            works = [(simulation, trials)] * tasks
            busy = sum(seconds for _, seconds in completed(run, works, workers))
            wall = time.perf_counter() - begin
            row = {"trials": trials, "tasks_per_s": tasks / wall, "task_s": busy / tasks}
            rows.append(row | {"overhead": 1.0 - busy / (WORKERS * wall)})
            print(rows[-1], flush=True)
    if args.json:
        args.json.write_text(json.dumps({"empty_tasks_per_s": empty, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
