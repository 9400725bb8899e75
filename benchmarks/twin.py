"""How long policies stand in a world, each trained alone for one seed.

On a twin 10 s of excitation are recorded and identified, a policy is trained with that actuator
for each seed, and evaluated on the same twin; in the world `model` the actuator is the shipped
one::

    python benchmarks/twin.py --world twin:nominal --seeds 10 --trials 200 --out runs

Policies and evaluations are kept in the folder, and made only where they are missing: a second
world can evaluate the same policies.
"""

import argparse
import json
from concurrent.futures import Executor
from pathlib import Path
from statistics import median

from equipoise.arm.iiwa import iiwa
from equipoise.control.policy import TabularPolicy
from equipoise.executors import completed, open_workers
from equipoise.identification.actuator import identify_run
from equipoise.learning.train import ATTEMPTS, train_to_target
from equipoise.model.actuator import Actuator, shipped_actuator
from equipoise.model.pendulum import shipped_pendulum
from equipoise.model.worlds import IDEAL, MODEL
from equipoise.rig.simulate import excite
from equipoise.settings import resolve
from equipoise.simulation.evaluation import Evaluation, evaluate, exact_interval


def main() -> None:
    """Run what the command line asks for, and print one line of JSON for each seed and for all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--world", default="twin:nominal")
    parser.add_argument("--arm", type=int, choices=(7, 14), default=7)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--attempts", type=int, default=ATTEMPTS, help="maximum for each seed")
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--duration", type=float, default=60.0)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--json", type=Path, help="file of the results")
    parser.add_argument("--workers", help="threads, or a Dask scheduler, tcp://HOST:8786")
    args = parser.parse_args()
    with open_workers(args.workers) as workers:
        measure(args, workers)


def measure(args: argparse.Namespace, workers: int | Executor) -> None:
    """Do what the command line asks for, on some workers."""
    arm = iiwa(args.arm)
    settings = resolve(
        overrides=[
            f"evaluation.trials={args.trials}",
            f"evaluation.duration={args.duration}",
            *args.set,
        ]
    )
    pendulum, world = shipped_pendulum(), args.world
    file, actuator = args.out / "actuator.json", shipped_actuator()
    if file.exists():
        actuator = Actuator.load(file)
    elif world not in (MODEL, IDEAL):
        actuator = identify_run(excite(arm, args.world, pendulum, seed=0))
        actuator.save(file, command="identify")

    def of_seed(task: tuple[int, TabularPolicy | None]) -> tuple[TabularPolicy, Evaluation]:
        """Train a seed, if its policy is missing, and evaluate the policy."""
        seed, policy = task
        if policy is None:
            how = {"attempts": args.attempts, "actuator": actuator, "seed": seed}
            policy = train_to_target(pendulum, arm, settings, **how)
        return policy, evaluate(policy, settings, world=world, with_baselines=False)

    lengths = f"{args.trials}x{args.duration:g}s"
    seeds = range(args.seeds)
    policies = [args.out / f"policy-{seed}.json" for seed in seeds]
    names = [f"evaluation-{world.replace(':', '-')}-{lengths}-{seed}.json" for seed in seeds]
    evaluations = [args.out / name for name in names]
    tasks = [
        (seed, TabularPolicy.load(policies[seed]) if policies[seed].exists() else None)
        for seed in seeds
        if not evaluations[seed].exists()
    ]
    for i, (policy, evaluation) in completed(of_seed, tasks, workers):
        seed, known = tasks[i]
        if known is None:
            inputs = {"actuator": actuator.digest}
            policy.save(policies[seed], command="train", inputs=inputs)
        evaluation.save(evaluations[seed], command="evaluate", inputs={"policy": policy.digest})
        print(f"seed {seed}: {evaluation}", flush=True)
    rows: list[dict] = []
    for seed in seeds:
        summary = Evaluation.load(evaluations[seed]).results.summary()
        row = {
            "seed": seed,
            "survived": summary.survived,
            "trials": summary.trials,
            "median_s": summary.median,
        }
        rows.append(row)
        test = TabularPolicy.load(policies[seed]).test
        own_test = None if test is None else test.model_dump(mode="json")
        print(json.dumps(row | {"causes": summary.outcomes, "own_test": own_test}), flush=True)
    survived, trials = sum(row["survived"] for row in rows), args.seeds * args.trials
    total = {
        "world": args.world,
        "arm": arm.name,
        "seeds": args.seeds,
        "survived": survived,
        "trials": trials,
        "interval": exact_interval(survived, trials),
        "median_s": median(row["median_s"] for row in rows),
        "seeds_at_99_percent": sum(row["survived"] >= 0.99 * row["trials"] for row in rows),
        "worst": min(rows, key=lambda row: row["survived"]),
    }
    print(json.dumps(total))
    if args.json:
        args.json.write_text(json.dumps(total | {"by_seed": rows}))


if __name__ == "__main__":
    main()
