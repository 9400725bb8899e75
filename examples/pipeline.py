"""Identify, train, evaluate and deploy, with the defaults, from a simulated swing.

python examples/pipeline.py
"""

import os

import equipoise as eq


def show(stage: str, fraction: float | None, state: str) -> None:
    """Print the progress of the training on one line."""
    print(f"\r{stage} {fraction or 0:4.0%} {state:40}", end="", flush=True)


cores = len(os.sched_getaffinity(0))
truth = eq.PendulumParameters(w2=64.0, k=6.53, c=0.2)
swing = eq.simulate_swing(truth, theta0=0.7, duration=10.0, rate_hz=500.0, counts_per_rev=8192)

print("identify the pendulum")
pendulum = eq.identify(swing)  # or the name of a recording, "swing.csv"
print(f"train on {cores} cores, for about a minute")
policy = eq.train(pendulum, "iiwa7", workers=cores, show=show)
print("\nevaluate on the twin, beside the baselines")
print(eq.evaluate(policy, world="twin:nominal", workers=cores))
print("run on the twin")
run = eq.simulate_run(policy, world="twin:nominal")
print(run)
policy.save("mine.json")
run.save("mine.mcap")
