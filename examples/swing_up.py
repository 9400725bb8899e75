"""Swing a hanging pendulum up, and balance it, in one run on the twin.

python examples/swing_up.py
"""

import equipoise as eq
from equipoise.report.figures import swing_up

settings = eq.resolve(overrides=["evaluation.start=hanging"])
run = eq.simulate_run(world="twin:nominal", duration=10.0, settings=settings)
print(f"from hanging: {run.outcome}")
swing_up(run).savefig("swing_up.png")
