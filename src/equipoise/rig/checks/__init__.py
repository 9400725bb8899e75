"""Checks before a run: fitness of machine and rig, and fit of the policy to the rig.

Each module measures one subject, judges the measurement and names the cure: `host` (the machine and
its settings), `deadlines` (their lateness), `link` (round trips to the robot), `encoder` (its
stream of samples), `fit` (policy, arm, posture and room). A threshold stands beside its check and
nowhere else. Nothing here moves an arm.

`equipoise.rig.doctor` and `equipoise.rig.run` choose which checks run.
"""
