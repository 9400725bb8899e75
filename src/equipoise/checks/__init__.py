"""Checks before a run: is this machine, is this rig fit for it, and does the policy fit the rig?

Each module measures one subject, judges the measurement and names the cure: `host` (the machine and
its settings), `deadlines` (how punctual it is), `link` (round trips to the robot), `encoder` (its
stream of samples), `fit` (policy, arm, posture and room). A threshold stands beside its check and
nowhere else. Nothing here moves an arm.

`equipoise.studies.doctor` and `equipoise.deployment.preflight` choose which checks run.
"""
