"""Arms that tests change."""

import numpy as np


def without_masses(arm):
    """Return an arm of which no link has a known mass."""
    joints = tuple(joint.model_copy(update={"link": None}) for joint in arm.joints)
    return arm.model_copy(update={"joints": joints})


def with_step(arm, number, length):
    """Return an arm with another step [m], to a joint or, after all of them, to flange or pivot."""
    steps = [*(joint.xyz for joint in arm.joints), arm.flange_xyz, arm.pivot]
    direction = np.array(steps[number - 1]) / np.linalg.norm(steps[number - 1])
    steps[number - 1] = tuple((length * direction).tolist())
    *places, flange, pivot = steps
    pairs = zip(arm.joints, places, strict=True)
    joints = tuple(joint.model_copy(update={"xyz": xyz}) for joint, xyz in pairs)
    return arm.model_copy(update={"joints": joints, "flange_xyz": flange, "pivot": pivot})
