"""A simulated night: series of runs without a hand on the emulated KST rig, with pushes.

Runs go over the wires, with drivers, safety rules and logs, in virtual time. At random moments the
pendulum is pushed, often over. A series that a safety rule has ended is followed by a new one, as
by an operator. Each series is a line of `night.jsonl`; the program goes on there, so that it can be
stopped at any time. The link is as fast as one direct cable: over a slower one the flange's speed
is limited, and a push ends many a series there::

    python experiments/night.py --hours 8 --out night
"""

import argparse
import json
import os
import resource
from collections import Counter
from functools import partial
from math import degrees, inf, radians
from pathlib import Path
from time import perf_counter
from typing import Any, Final

import numpy as np
from shared import options, store

from equipoise.control.policy import shipped_policy
from equipoise.control.ticks import OperatorMessage
from equipoise.files import read_document
from equipoise.log.conditions import RunEnd
from equipoise.log.run_log import RunLog
from equipoise.outcomes import Outcome
from equipoise.rig.config import RigSettings
from equipoise.rig.connection import Rig, connect
from equipoise.rig.request import RunRequest
from equipoise.rig.run import run_virtually
from equipoise.rig.series import run_path, summarise
from equipoise.simulation.evaluation import exact_interval

PUSH: Final = radians(120.0)
"""Largest change of the pendulum's rate by a push [rad/s]: a half of them tips it over."""

WORLD: Final = "reply_age = 0.002\n"
"""Numbers of the twin that differ from nominal."""


class Pusher:
    """Operator who pushes the pendulum once in each balance, at a random moment."""

    def __init__(self, rig: Rig, duration: float, seed: int) -> None:
        """Stand at a rig whose balances last for a duration [s]."""
        self._rig, self._duration = rig, duration
        self._random, self._due, self.pushes = np.random.default_rng([seed, 41]), inf, 0
        rig.clock.attach(self._work)  # pyright: ignore[reportAttributeAccessIssue]

    def notify(self, event: OperatorMessage) -> None:
        """Plan a push for a balance that begins, and none once it ends."""
        self._due = inf
        if event.name == "balancing":
            self._due = self._rig.clock.now() + self._random.uniform(0.0, self._duration)

    def read_input(self) -> list[str]:
        """Type nothing."""
        return []

    def _work(self, now: float) -> None:
        if now >= self._due:
            self._due, self.pushes = inf, self.pushes + 1
            self._rig.bench.push(self._random.uniform(-PUSH, PUSH))


def main() -> None:
    """Run series until the hours are over, and print the sum."""
    parser = options(__doc__, "json", duration=20.0, out=Path("night"))
    parser.add_argument("--hours", type=float, default=1.0, help="of simulated time, in all")
    parser.add_argument("--runs", type=int, default=100, help="runs of a series")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    lines = args.out / "night.jsonl"
    rows = [json.loads(line) for line in lines.read_text().splitlines()] if lines.exists() else []
    while sum(row["simulated_s"] for row in rows) < 3600.0 * args.hours:
        rows.append(series(len(rows), args))
        with lines.open("a") as file:
            file.write(json.dumps(rows[-1]) + "\n")
        print(json.dumps(rows[-1]), flush=True)
    summary = total(rows)
    print(json.dumps(summary, indent=1))
    store(args.json, summary)


def series(number: int, args: argparse.Namespace) -> dict[str, Any]:
    """Run a series, check its logs, and return its numbers."""
    policy, ends = shipped_policy(), list[RunEnd]()
    world = args.out / "world.toml"
    world.write_text(WORLD)
    request = RunRequest(
        policy, policy.actuator, RigSettings(), f"kst://twin:{world}", None, args.duration,
        seed=number, start="hanging", runs=args.runs,
    )  # fmt: skip
    rig, out, began = connect(request), args.out / f"{number}.mcap", perf_counter()
    pusher = Pusher(rig, args.duration, number)
    memory = list[float]()

    def ended(end: RunEnd) -> None:
        ends.append(end)
        memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0)

    ended(run_virtually(request, out, pusher, rig=rig, ended=ended))
    read = partial(run_path, out, runs=args.runs)
    for place in range(max(len(ends) - 99, 1), len(ends) + 1):
        if RunLog.load(read(number=place)).end != ends[place - 1]:
            raise RuntimeError(f"the log of run {place} has another end")
        read(number=place).unlink()
    if len(read_document(out.with_name(f"{number}-series.json"))["body"]["runs"]) != len(ends):
        raise RuntimeError("the summary has another number of runs")
    counted = summarise(ends)
    return {
        "series": number,
        "simulated_s": rig.clock.now(),
        "computed_s": perf_counter() - began,
        "pushes": pusher.pushes,
        "runs": len(ends),
        "survived": counted["survived"],
        "outcomes": {str(name): count for name, count in counted["outcomes"].items()},
        "reason": ends[-1].reason,
        "upright_s": [end.upright for end in ends if end.upright is not None],
        "zero_change_deg": [
            degrees(end.zero_change) for end in ends if end.zero_change is not None
        ],
        "w2": [end.w2 for end in ends if end.w2 is not None],
        "memory_mb": [memory[min(10, len(memory) - 1)], memory[-1]],
        "files": len(os.listdir("/proc/self/fd")),
    }


def total(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the numbers of all series."""
    outcomes = Counter[str]()
    for row in rows:
        outcomes.update(row["outcomes"])
    runs, upright = sum(row["runs"] for row in rows), [t for row in rows for t in row["upright_s"]]
    begun_again = outcomes[Outcome.SURVIVED] + outcomes[Outcome.ANGLE] + outcomes[Outcome.TRACK]
    changes = np.abs([change for row in rows for change in row["zero_change_deg"]])
    return {
        "hours": sum(row["simulated_s"] for row in rows) / 3600.0,
        "series": len(rows),
        "pushes": sum(row["pushes"] for row in rows),
        "runs": {"survived": begun_again, "trials": runs},
        "interval": exact_interval(begun_again, runs),
        "outcomes": dict(outcomes),
        "upright_median_s": float(np.median(upright)),
        "upright_max_s": max(upright),
        "zero_change_max_deg": float(changes.max()),
        "memory_growth_mb": max(last - tenth for tenth, last in (row["memory_mb"] for row in rows)),
        "files": [rows[0]["files"], rows[-1]["files"]],
    }


if __name__ == "__main__":
    main()
