"""What runs on a rig buy a policy that was trained in simulation: the paper's future work.

A rig whose response differs from that of the training is a digital twin behind the emulated KST
server and its drivers, in virtual time. A series of runs from hanging, without a hand, records
what happens there. Policies are then evaluated on the same twin, in trials that start by hand:

`shipped`
    The shipped policy, with the actuator of its training.
`identified`
    The same table, with the actuator that the rig's own excitation identifies
    (`deploy --identify`).
`trained for the arm`
    Tables of five seeds, trained for that actuator.
`trained again`
    Tables of five seeds, trained for what `refine` finds in the first twenty runs.
`goes on`
    Equation (1) goes on with the transitions of the runs, block after block, from the shipped
    Q and its visits; the runs of a block use the table of the block before.

::

    python experiments/on_robot.py --runs 100 --json on_robot.json --out on_robot.png
"""

import argparse
import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from shared import in_processes, options, proportion, store

import equipoise as eq
from equipoise.errors import RecordingError
from equipoise.identification.actuator import identify_actuator
from equipoise.identification.refine import inspect
from equipoise.learning.q_learning import (
    Tables,
    Transition,
    UpdateParams,
    new_tables,
    q_learning,
)
from equipoise.log.conditions import RunEnd
from equipoise.log.run_log import RunLog
from equipoise.model.worlds import read_world
from equipoise.outcomes import Outcome
from equipoise.paper import ACTIONS
from equipoise.rig.config import RigSettings
from equipoise.rig.request import RunRequest
from equipoise.rig.run import run_virtually
from equipoise.rig.series import run_path
from equipoise.settings import Settings, changed

WORLDS: Final = {
    "harsh": "",
    "unknown servo": "transport = 0.022\ncycle = 0.010\nlag = 0.014\ncoulomb = 0.2\n",
}
"""Twins by name: that of the project, or the content of a file."""
BLOCK: Final = 20
"""Number of runs with one table."""
SEEDS: Final = 5
"""Number of trainings for the refined model."""


def main() -> None:
    """Record the series, evaluate the policies, and draw the figure."""
    parser = options(__doc__, "json", "out", trials=500, duration=10.0)
    parser.add_argument("--runs", type=int, default=100, help="runs on each rig")
    args = parser.parse_args()
    studies = in_processes(partial(study, args=args), WORLDS)
    results = dict(zip(WORLDS, studies, strict=True))
    print(json.dumps(results, indent=1))
    store(args.json, results)
    if args.out:
        draw(results).savefig(args.out, dpi=150)


def study(name: str, args: argparse.Namespace) -> dict[str, Any]:
    """Return the results on one rig."""
    policy = eq.TabularPolicy.model_validate(eq.shipped_policy())
    with TemporaryDirectory() as folder:
        world = f"twin:{name}"
        if numbers := WORLDS[name]:
            file = Path(folder) / "world.toml"
            file.write_text(numbers)
            world = f"twin:{file}"
        rig = RigSettings(counts_per_rev=read_world(world).settings.counts_per_rev)
        request = RunRequest(
            policy, policy.actuator, rig, f"kst://{world}", None, args.duration, start="hanging"
        )
        rows = [evaluated("shipped", policy, policy.actuator, world, args)]
        actuator = run_virtually(
            replace(request, identify=identify_actuator, duration=1.0), None
        ).identified
        if actuator is None:
            raise RuntimeError("the excitation has not identified the arm")
        rows.append(evaluated("identified", policy, actuator, world, args))
        of_arm = policy.pendulum, actuator
        rows.append(trained("trained for the arm", policy, *of_arm, world, args))
        table, ends = policy, list[RunEnd]()
        tables = new_tables(len(policy.Q), 0)
        tables.Q[:], tables.visits[:] = policy.table, policy.visits
        while len(ends) < args.runs:
            block, records = series(replace(request, policy=table, seed=len(ends)), Path(folder))
            ends += block
            learn(tables, records, policy.settings)
            table = with_table(policy, tables.Q)
            if len(ends) == BLOCK:
                rows.append(trained_again(policy, records, world, args))
            if len(ends) in (BLOCK, 5 * BLOCK, 25 * BLOCK):
                label = f"goes on, {len(ends)} runs"
                rows.append(evaluated(label, table, policy.actuator, world, args))
        survived = sum(end.outcome is Outcome.SURVIVED for end in ends)
        return {"rows": rows, "runs": {"survived": survived, "trials": len(ends)}}


def series(request: RunRequest, folder: Path) -> tuple[list[RunEnd], list[RunLog]]:
    """Return the ends of a block of runs, and the logs of those that balanced.

    A series that ends early is begun again, as an operator would.
    """
    ends, logs = list[RunEnd](), list[RunLog]()
    while len(ends) < BLOCK:
        left = BLOCK - len(ends)
        block, out = list[RunEnd](), folder / f"block-{request.seed}-{len(ends)}.mcap"
        wanted = replace(request, runs=left, seed=1000 * request.seed + len(ends))
        block.append(run_virtually(wanted, out, ended=block.append))
        for number, end in enumerate(block, start=1):
            path = run_path(out, number, left)
            if end.survival:
                logs.append(RunLog.load(path, damaged=True))
            path.unlink()
        ends += block
        print(request.robot, request.seed, [str(end.outcome) for end in block], flush=True)
    return ends, logs


def learn(tables: Tables, logs: list[RunLog], settings: Settings) -> None:
    """Update the tables by equation (1) with every transition of some runs."""
    learning, index = settings.learning, {u: i for i, u in enumerate(ACTIONS)}
    params = UpdateParams(
        learning.gamma,
        learning.alpha_initial,
        learning.alpha_decay,
        learning.alpha_minimum,
        learning.mirrored,
    )
    for log in logs:
        boxes, actions = log.ticks.box.tolist(), [index[u] for u in log.ticks.u.tolist()]
        steps = list(zip(boxes, actions, boxes[1:], strict=False))
        fell = log.ending.outcome in (Outcome.ANGLE, Outcome.TRACK)
        steps += [(boxes[-1], actions[-1], 0)] if fell else []
        for k, (box, action, box_next) in enumerate(steps):
            failed = fell and k == len(steps) - 1
            reward = -1.0 if failed else 0.0  # `failure`, that of the shipped policy
            step = Transition(box, action, reward, box_next, failed, failed, 0.0, 0.0, 0)
            q_learning(tables, step, params)


def trained(
    name: str,
    policy: eq.TabularPolicy,
    pendulum: eq.Pendulum,
    actuator: eq.Actuator,
    world: str,
    args: argparse.Namespace,
) -> dict[str, Any]:
    """Return the sum of the results of several seeds, trained for a pendulum and an actuator."""
    rows = [
        evaluated(f"{name}, seed {seed}", table, actuator, world, args)
        for seed in range(SEEDS)
        for table in [eq.train(pendulum, policy.arm, actuator=actuator, seed=seed)]
    ]
    survived, trials = (sum(row[part] for row in rows) for part in ("survived", "trials"))
    return {"name": name} | proportion(survived, trials)


def trained_again(
    policy: eq.TabularPolicy, logs: list[RunLog], world: str, args: argparse.Namespace
) -> dict[str, Any] | None:
    """Return the results of tables trained for what runs identify; None where they do not."""
    try:
        found = inspect(policy, *logs)
    except RecordingError as error:
        print(world, error, flush=True)
        return None
    print(world, found.moves, len(found.warnings), flush=True)
    return trained("trained again", policy, found.pendulum, found.actuator, world, args)


def with_table(policy: eq.TabularPolicy, Q: Any) -> eq.TabularPolicy:
    """Return a policy with other values."""
    return policy.model_copy(update={"Q": tuple(map(tuple, Q.tolist()))})


def evaluated(
    name: str, policy: eq.TabularPolicy, actuator: Any, world: str, args: argparse.Namespace
) -> dict[str, Any]:
    """Return survived trials of a policy with an actuator in its controller, by hand."""
    settings = changed(policy.settings, {"evaluation.trials": args.trials})
    evaluation = eq.evaluate(
        policy, settings, world=world, actuator=actuator, seed=77, with_baselines=False
    )
    summary = evaluation.results.summary()
    print(world, name, summary.survived, summary.trials, flush=True)
    return {"name": name} | proportion(summary.survived, summary.trials)


def draw(results: dict[str, Any]) -> Figure:
    """Return the figure: survival of each policy on each rig."""
    figure = Figure(figsize=(7.2, 3.2 * len(results)), layout="constrained")
    axes = np.atleast_1d(figure.subplots(len(results), sharex=True))
    for ax, (name, result) in zip(axes, results.items(), strict=True):
        rows = [row for row in result["rows"][::-1] if row is not None]
        rates = np.array([row["rate"] for row in rows])
        ends = np.array([row["interval"] for row in rows]).T
        ax.errorbar(rates, range(len(rows)), xerr=np.abs(ends - rates), fmt="o", capsize=3)
        ax.set_yticks(range(len(rows)), [row["name"] for row in rows])
        ax.set_title(f"twin {name}", loc="left")
        ax.set_xlim(-0.02, 1.02)
        ax.grid(axis="x", alpha=0.3)
    axes[-1].set_xlabel("trials of 60 s survived, with 95 % intervals")
    return figure


if __name__ == "__main__":
    main()
