"""Identify the servo of an FR3, train for it, and balance on it, with `franky-sim` in lockstep.

Each log is ten seconds of motion over the stream of velocities; its seed draws the posture at the
begin. A policy is trained for the first log's actuator with each seed, and evaluated on
`twin:fr3` with seeds that trained nothing. The first one then runs over the protocol::

    python experiments/franka.py --logs 10 --runs 20 --duration 60 --out build/fr3
"""

import argparse
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from shared import in_processes, options, store

import equipoise as eq
from equipoise.executors import available_cores
from equipoise.identification.actuator import identify_actuator
from equipoise.model.actuator import Actuator
from equipoise.outcomes import Outcome
from equipoise.rig.config import RigSettings
from equipoise.rig.request import RunRequest
from equipoise.rig.run import run_virtually
from equipoise.settings import changed

WORLD = "twin:fr3"
RIG = RigSettings(arm="fr3")
UNSEEN = 1000
"""Difference of an evaluation's seed from that of its training."""


def main() -> None:
    """Print each log, policy and run, and write the results."""
    parser = options(__doc__, "json", trials=300, duration=60.0, out=Path("franka"))
    parser.add_argument("--logs", type=int, default=10)
    parser.add_argument("--seeds", type=int, default=5, help="number of trainings")
    parser.add_argument("--runs", type=int, default=20)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    # The identification does not depend on the policy of its run.
    policy = eq.shipped_policy().model_copy(update={"arm": RIG.described_arm})
    request = RunRequest(
        policy, policy.actuator, RIG, f"franka://{WORLD}", None, args.duration, identify=identify
    )
    logs = in_processes(identified, [replace(request, seed=s) for s in range(args.logs)])
    actuators = [log for log in logs if log is not None]
    for actuator in actuators:
        print(actuator.summary, flush=True)
    actuators[0].save(args.out / "actuator.json", command="experiments/franka.py", inputs={})
    policies, trials = trained(actuators[0], args)
    policies[0].save(args.out / "policy.json")
    request = replace(request, policy=policies[0], actuator=policies[0].actuator, identify=None)
    ends = Counter(in_processes(outcome, [replace(request, seed=s) for s in range(args.runs)]))
    print(dict(ends))
    results = {
        "servo_ms": servo(actuators),
        "trials": trials,
        "runs": {"survived": ends[Outcome.SURVIVED], "trials": args.runs},
    }
    print(json.dumps(results))
    store(args.json, results)


def identify(sent: Any, measured: Any) -> Actuator:
    """Identify an arm as a delay and a lag, which the fitted kinds differ in little."""
    return identify_actuator(sent, measured, kind="lag")


def identified(request: RunRequest) -> Actuator | None:
    """Return the actuator that a run identifies."""
    return run_virtually(request, None).identified


def outcome(request: RunRequest) -> Outcome:
    """Return how a run ended."""
    end = run_virtually(request, None)
    print(request.seed, end.outcome, end.reason, flush=True)
    return end.outcome


def trained(actuator: Actuator, args: argparse.Namespace) -> tuple[list[Any], dict[str, Any]]:
    """Return a policy for each seed, and how many of their trials survived."""
    cores = available_cores()
    length = {"evaluation.trials": args.trials, "evaluation.duration": args.duration}
    policies, rates = list[Any](), list[float]()
    for seed in range(args.seeds):
        policy = eq.train(None, RIG.described_arm, actuator=actuator, seed=seed, workers=cores)
        settings = changed(policy.settings, length)
        evaluation = eq.evaluate(
            policy, settings, world=WORLD, seed=seed + UNSEEN, with_baselines=False, workers=cores
        )
        rates.append(evaluation.results.summary().rate)
        policies.append(policy)
        print(seed, rates[-1], flush=True)
    survived, trials = round(sum(rates) * args.trials), args.seeds * args.trials
    return policies, {"survived": survived, "trials": trials, "worst": min(rates)}


def servo(actuators: list[Actuator]) -> dict[str, Any]:
    """Return mean and standard deviation of the delay, its mean half width, and lags [ms]."""
    delays = 1e3 * np.array([(a.delay.value, a.delay.low, a.delay.high) for a in actuators])
    lags = 1e3 * np.mean([[lag.value for lag in actuator.lags] for actuator in actuators], axis=0)
    return {
        "logs": len(actuators),
        "delay": {"mean": delays[:, 0].mean(), "sd": delays[:, 0].std()},
        "half_width": float(np.mean(delays[:, 2] - delays[:, 1]) / 2.0),
        "lags": [lags.min(), lags.max()],
        "rms_mrad": 1e3 * float(np.mean([a.fit.rms for a in actuators if a.fit])),
    }


if __name__ == "__main__":
    main()
