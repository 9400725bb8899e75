"""Digests of what a change of the structure must leave as it is: trainings, trials, bytes, logs.

    python benchmarks/golden.py > before.json
    python benchmarks/golden.py --against before.json

The bits depend on the processor and on the versions of Numba and MuJoCo: compare two trees on one
machine. Takes two minutes on two cores, after compilation.
"""

import argparse
import hashlib
import json
import sys
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the harness of tests/faults

SEEDS = (0, 1, 2)
TRIALS = 20
EPISODES = {"paper": 600, "robust": 300}
MEASURED = ("late", "compute")
"""Columns with times of this computer."""


def digest(*values: object) -> str:
    """Return a digest of arrays and texts."""
    hashed = hashlib.sha256()
    for value in values:
        is_text = isinstance(value, (str, bytes))
        hashed.update(str(value).encode() if is_text else np.ascontiguousarray(value).tobytes())
    return hashed.hexdigest()[:16]


def trainings() -> dict[str, str]:
    """Short trainings of both recipes."""
    from equipoise.control.policy import shipped_policy
    from equipoise.learning.train import train
    from equipoise.settings import resolve

    policy, digests = shipped_policy(), {}
    for recipe, episodes in EPISODES.items():
        changes = [f"learning.episodes={episodes}", "selection.trials=4"]
        settings = resolve(recipe, overrides=changes)
        for seed in SEEDS:
            trained = train(policy.pendulum, policy.arm, settings, seed=seed)
            digests[f"training {recipe} {seed}"] = digest(
                trained.actions, trained.visits, trained.steps
            )
    return digests


def evaluations() -> dict[str, str]:
    """Trials of the shipped policy on plant and twins, with the codes of their ends."""
    from equipoise.control.policy import shipped_policy
    from equipoise.simulation import evaluation

    policy, digests, codes, results = shipped_policy(), {}, {}, evaluation.trial_results

    def recorded(name: str, trials: Any, h: float) -> Any:
        names = ("survived", "angle", "track", "joint limit", "guard")
        codes[name] = [names[min(code, 4)] for code in trials.cause.tolist()]
        return results(name, trials, h)

    evaluation.trial_results = recorded
    parts = {"trials": TRIALS, "duration": 10.0}
    numbers = policy.settings.evaluation.model_copy(update=parts)
    settings = policy.settings.model_copy(update={"evaluation": numbers})
    for world in ("ideal", "model", "twin:nominal", "twin:harsh"):
        for seed in SEEDS:
            done = evaluation.evaluate(policy, settings, world=world, seed=seed)
            outcomes = ((one.survival, *codes[one.name]) for one in (done.results, *done.baselines))
            digests[f"evaluation {world} {seed}"] = digest(*chain.from_iterable(outcomes))
    evaluation.trial_results = results
    return digests


def runs() -> dict[str, str]:
    """Columns of single simulated runs."""
    from equipoise.control.policy import shipped_policy
    from equipoise.rig.simulate import simulate_run

    digests = {}
    for world in ("model", "twin:nominal", "twin:harsh"):
        run = simulate_run(shipped_policy(), world=world, seed=3, duration=5.0)
        columns = [run.ticks[name] for name in ("x", "x_dot", "phi", "phi_dot", "u")]
        digests[f"run {world}"] = digest(*columns, run.stream.q)
    return digests


def virtual_runs() -> dict[str, str]:
    """Bytes to robot and encoder of a whole run in virtual time, and the rows of its log."""
    from equipoise.log.run_log import RunLog
    from tests.faults.harness import FaultHarness, Scenario

    digests = {}
    for seed in SEEDS:
        with TemporaryDirectory() as folder:
            path = Path(folder) / "run.mcap"
            harness = FaultHarness(Scenario(out=path), seed=seed)
            harness.run()
            log = RunLog.load(path)
        for name, tap in (("robot", harness.robot_tap), ("encoder", harness.encoder_tap)):
            digests[f"bytes to the {name} {seed}"] = digest(*(line for _, line in tap.sent))
        for name, table in sorted(log.tables.items()):
            if name != "event":  # its texts may be reworded
                columns = (table[column] for column in table.dtype.names if column not in MEASURED)
                digests[f"log {name} {seed}"] = digest(*columns)
    return digests


PARTS: tuple[Callable[[], dict[str, str]], ...] = (trainings, evaluations, runs, virtual_runs)


def main() -> int:
    """Print all digests, or those that differ from a file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--against", type=Path, help="digests of another tree")
    against = parser.parse_args().against
    digests: dict[str, str] = {}
    for part in PARTS:
        digests |= part()
        print(f"{part.__name__}: done", file=sys.stderr)
    if against is None:
        print(json.dumps(digests, indent=1))
        return 0
    before = json.loads(against.read_text())
    changed = [name for name in {**before, **digests} if before.get(name) != digests.get(name)]
    print("\n".join(changed) or f"all {len(digests)} digests are equal")
    return int(bool(changed))


if __name__ == "__main__":
    sys.exit(main())
