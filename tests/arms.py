"""Arms that tests change."""


def without_masses(arm):
    """Return an arm of which no link has a known mass."""
    joints = tuple(joint.model_copy(update={"link": None}) for joint in arm.joints)
    return arm.model_copy(update={"joints": joints})
