"""Validation of a setpoint, shared by the robots."""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from equipoise.errors import InputError
from equipoise.rig.interfaces import Array


def checked(q: Sequence[float] | Array, joints: int) -> Array:
    """Validate a setpoint, and return a copy as an array [rad], shape (joints,).

    Args:
        q: The setpoint [rad].
        joints: Number of joints.

    Raises:
        InputError: The setpoint is not one finite number per joint.
    """
    with suppress(TypeError, ValueError, OverflowError):
        setpoint = np.array(q, np.float64)
        if setpoint.shape == (joints,) and np.isfinite(setpoint).all():
            return setpoint
    raise InputError(
        f"a setpoint is {joints} finite numbers, one for each joint, not {str(q)[:120]}; "
        "nothing was sent"
    )
