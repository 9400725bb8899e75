"""Identify a pendulum from a free swing: of your own, or of a simulated one.

python examples/identify_a_swing.py [swing.csv]
"""

import sys
from math import radians

import equipoise as eq

if len(sys.argv) > 1:
    swing = eq.read_swing(sys.argv[1])
else:
    # An encoder of 8192 counts, read 500 times a second; released at 40 degrees.
    truth = eq.PendulumParameters(w2=70.2, k=7.16, c=0.1)
    swing = eq.simulate_swing(
        truth, theta0=radians(40.0), duration=8.0, rate_hz=500.0, counts_per_rev=8192
    )

pendulum = eq.identify(swing)

for name, estimate, unit in (
    ("w2 = m g l / I", pendulum.w2, "1/s^2"),
    ("k  = m l / I  ", pendulum.k, "1/m"),
    ("c  = b / I    ", pendulum.c, "1/s"),
):
    low, high = estimate.interval
    print(f"{name} = {estimate.value:9.5f} {unit:6} (95 %: {low:.5f} to {high:.5f})")
for warning in pendulum.fit.warnings if pendulum.fit else ():
    print("warning:", warning)

pendulum.save("pendulum.json")
