"""Run a policy on the digital twin: an arm behind its servo, an encoder with a wrong zero.

python examples/deploy_on_the_twin.py [policy.json]
"""

import sys
from math import degrees

import equipoise as eq

policy = sys.argv[1] if len(sys.argv) > 1 else None  # by default the table that ships
run = eq.simulate_run(policy, world="twin:nominal", seed=1, duration=20.0)

print(f"{run.conditions.world}: survived {run.survival:g} of {run.conditions.duration:g} s")
print(f"ended by: {run.outcome}")
print(f"flange: within {1e3 * abs(run.truth.x).max():.0f} mm of home")  # what a robot cannot tell
print(f"pendulum: within {degrees(abs(run.truth.phi).max()):.1f} deg of upright")
print(
    f"encoder's zero: wrong by {degrees(run.conditions.zero_error or 0.0):+.2f} deg, "
    f"estimated as {degrees(run.ticks.bias[-1]):+.2f} deg"
)

run.save("run.mcap")
