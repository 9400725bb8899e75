"""Run a sweep and a population on a local Ray cluster of two nodes that loses parts of itself.

Writes a study, runs it in threads as the reference, then on the cluster: one worker is killed, and
the driver twice; each time the same command continues. Then `train --learners N` on both, and empty
tasks, which measure what the driver, the object store and the storage take for each task::

    python -m pip install '.[ray,sweep]'
    python benchmarks/cluster.py --out cluster          # cluster.json and all files

The machine's load decides all times; the comparison of bits does not depend on it.
"""

import argparse
import functools
import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Final

import ray
from ray.cluster_utils import Cluster

from equipoise.artefacts import write_whole
from equipoise.cluster import RayExecutor
from equipoise.control.policy import TabularPolicy
from equipoise.studies import sweep as study
from equipoise.studies.sweep_results import Sweep, SweepTrial, read_study

STUDY: Final = """trials = {trials}
seed = 7
sampler = "tpe"
objective = "duration"
tests = 20
duration = 60.0

[settings]
learning.episodes = 300
selection.every = 20
selection.candidates = 4
selection.rounds = 2
selection.round_trials = 32
selection.duration = 5.0

[parameters]
learning.gamma = {{ low = 0.9, high = 0.999 }}
learning.alpha_minimum = {{ low = 0.001, high = 0.1, log = true }}
boxes.x = {{ choices = [[-0.07, 0.07], [-0.1, 0.1], [-0.14, -0.07, 0.07, 0.14]] }}
"""
LEARNING: Final = (
    *("learning.episodes=300", "selection.every=20", "selection.candidates=4"),
    *("selection.rounds=2", "selection.round_trials=32", "selection.duration=5"),
    "selection.test_trials=320",
)
EMPTY: Final = 2000
"""Number of empty tasks."""


def command(*words: object) -> list[str]:
    """Return a command of Equipoise."""
    return [sys.executable, "-m", "equipoise", *map(str, words)]


def finished(storage: Path) -> int:
    """Return the number of trials in the storage of a sweep."""
    if not storage.exists():
        return 0
    try:
        with sqlite3.connect(f"file:{storage}?mode=ro", uri=True, timeout=10.0) as database:
            return database.execute("select count(*) from trials").fetchone()[0]
    except sqlite3.OperationalError:
        return 0  # not laid out yet


def workers() -> list[int]:
    """Return the processes of Ray that run a task of Equipoise."""
    found: list[int] = []
    for folder in Path("/proc").iterdir():
        try:
            line = (folder / "cmdline").read_bytes()
        except OSError:
            continue
        if line.startswith(b"ray::_call"):
            found.append(int(folder.name))
    return found


def wait_for(driver: subprocess.Popen[bytes], storage: Path, count: int) -> None:
    """Wait until a sweep has stored a number of trials."""
    while finished(storage) < count:
        if driver.poll() is not None:
            raise SystemExit(f"the driver ended with {driver.returncode} before trial {count}")
        time.sleep(0.2)


def disturbed(address: str, source: Path, out: Path, trials: int) -> dict[str, Any]:
    """Run a sweep on the cluster; kill a worker once and the driver twice, and continue."""
    storage, events = study.storage_path(out), list[dict[str, Any]]()
    run = command("sweep", source, "--ray", address, "--out", out)
    for share, what in ((0.2, "worker"), (0.4, "driver"), (0.7, "driver"), (1.0, "")):
        if not events or events[-1]["killed"] == "driver":
            driver = subprocess.Popen(run, stdout=subprocess.DEVNULL)
        if not what:
            break
        wait_for(driver, storage, round(share * trials))
        while what == "worker" and not workers():
            time.sleep(0.01)  # between two batches no task runs
        process = workers()[0] if what == "worker" else driver.pid
        os.kill(process, signal.SIGKILL)
        if what == "driver":
            driver.wait()
        events.append({"killed": what, "stored": finished(storage)})
    if driver.wait() not in (0, 1):
        raise SystemExit(f"the last driver ended with {driver.returncode}")
    return {"events": events, "stored": finished(storage)}


def population(address: str | None, learners: int, out: Path) -> TabularPolicy:
    """Train a population in threads or on the cluster; return its policy."""
    where = ("--workers", 2) if address is None else ("--ray", address)
    words: list[object] = [word for each in LEARNING for word in ("--set", each)]
    words += ["--target", 0.9]
    run = command("train", "--learners", learners, "--all", *where, *words, "--out", out)
    subprocess.run(run, stdout=subprocess.DEVNULL, check=False)
    return TabularPolicy.load(out)


def timed(work: Any) -> float:
    """Return the time of some work [s]."""
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def empty_tasks(executor: RayExecutor, folder: Path) -> dict[str, float]:
    """Measure the cost of a task without work [s]: submission, answers of two sizes, storage."""
    function = functools.partial(bytes)
    answers = {
        "task_s": 0,  # an empty answer
        "task_with_trials_s": 24 * 2048,  # steps, causes and sums of 2,048 trials
        "task_with_policy_s": 100_000,  # a policy with its curve
    }
    found = {
        name: timed(lambda size=size: list(executor.completed(function, [size] * EMPTY))) / EMPTY
        for name, size in answers.items()
    }
    source = folder / "empty.toml"
    source.write_text(STUDY.format(trials=EMPTY))
    read = read_study(source)
    parameters = {"learning.gamma": 0.95, "learning.alpha_minimum": 0.01, "boxes.x": [-0.1, 0.1]}
    results = [
        SweepTrial(index=i, parameters=parameters, tests=20, survived=10, duration=9.0)
        for i in range(EMPTY // 10)
    ]
    with study.Storage(folder / "empty.sqlite3", read, "empty") as storage:
        spent = timed(lambda: [storage.add(result) for result in results])
    return found | {"storage_s": spent / len(results)}


def main() -> int:
    """Run all; return the exit code: 1 if anything differs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("cluster"), help="folder to write")
    parser.add_argument("--trials", type=int, default=200, help="trials of the sweep")
    parser.add_argument("--learners", type=int, default=200, help="learners of the population")
    given = parser.parse_args()
    given.out.mkdir(parents=True)
    source = given.out / "study.toml"
    source.write_text(STUDY.format(trials=given.trials))
    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
    )
    cluster.add_node(num_cpus=1)
    address = cluster.address
    threads, rays = given.out / "threads.json", given.out / "ray.json"
    record: dict[str, Any] = {"ray": ray.__version__, "trials": given.trials}
    run = command("sweep", source, "--workers", 2, "--out", threads)
    record["threads_s"] = timed(lambda: subprocess.run(run, stdout=subprocess.DEVNULL, check=False))
    record |= disturbed(address, source, rays, given.trials)
    one, other = Sweep.load(threads), Sweep.load(rays)
    record["distinct"] = len({trial.index for trial in other.trials})
    record["same_best"] = one.ranking[0] == other.ranking[0]
    record["same_bits"] = one.digest == other.digest
    record["learners"] = given.learners
    policies = [
        population(where, given.learners, given.out / f"{name}.json")
        for name, where in (("here", None), ("there", address))
    ]
    record["same_policy"] = policies[0].digest == policies[1].digest
    record["policy"] = policies[0].digest
    record |= empty_tasks(RayExecutor(address), given.out)
    write_whole(given.out / "cluster.json", json.dumps(record, indent=1) + "\n")
    print(json.dumps(record, indent=1))
    same = all(record[name] for name in ("same_best", "same_bits", "same_policy"))
    return 0 if same and record["distinct"] == given.trials else 1


if __name__ == "__main__":
    sys.exit(main())
