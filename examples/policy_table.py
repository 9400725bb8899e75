"""Read the table of a policy: what it commands in the middle of the track, flange nearly at rest.

python examples/policy_table.py [policy.json]
"""

import sys

import equipoise as eq
from equipoise import paper

policy = eq.TabularPolicy.load(sys.argv[1]) if len(sys.argv) > 1 else eq.shipped_policy()

# The axes of the table: phi, phi_dot, x, x_dot, each from its lowest interval.
boxes = policy.settings.boxes
u = policy.u_of_box.reshape(boxes.shape)
middle = u[:, :, boxes.shape[2] // 2, boxes.shape[3] // 2]

print(f"{policy.arm.name}, recipe {policy.recipe}: {policy.episodes:,} episodes of training")
print("Acceleration of the flange [m/s^2]; rows to phi [deg], columns to phi_dot [deg/s]")
print(" " * 6 + "".join(f"{end:>7g}" for end in (*boxes.phi_dot_deg, float("inf"))))
for row, end in zip(middle, (*boxes.phi_deg, paper.PHI_LIMIT_DEG), strict=True):
    print(f"{end:>6g}" + "".join(f"{value:7.1f}" for value in row))
