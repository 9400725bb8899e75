"""Read the table of a policy: what it commands in the middle of the track, flange nearly at rest.

python examples/policy_table.py [policy.json]
"""

import sys
from pathlib import Path

import equipoise as eq

policy = eq.TabularPolicy.load(Path(sys.argv[1])) if len(sys.argv) > 1 else eq.shipped_policy()

# The axes of the table: phi, phi_dot, x, x_dot, each from its lowest interval.
u = policy.u_of_box.reshape(6, 5, 3, 3)

print(f"{policy.arm.name}, recipe {policy.recipe}: {policy.episodes:,} episodes of training")
print("Acceleration of the flange [m/s^2]; rows phi [deg], columns phi_dot [deg/s]")
print(" " * 10 + "".join(f"{interval:>11}" for interval in policy.boxes.phi_dot_deg))
for row, interval in zip(u[:, :, 1, 1], policy.boxes.phi_deg, strict=True):
    print(f"{interval:>10}" + "".join(f"{value:11.1f}" for value in row))
