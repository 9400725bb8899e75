"""Validation of a setpoint, shared by the robots."""

from collections.abc import Sequence

import numpy as np

from equipoise.devices.interfaces import Array
from equipoise.errors import InputError


def checked(q: Sequence[float] | Array, joints: int) -> Array:
    """Validate a setpoint, and return a copy as an array [rad], shape (joints,).

    Args:
        q: The setpoint [rad].
        joints: Number of joints.

    Raises:
        InputError: The setpoint is not one finite number per joint.
    """
    try:
        setpoint = np.array(q, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"the setpoint {q!r} is not made of numbers; nothing was sent") from None
    if setpoint.shape != (joints,) or not np.isfinite(setpoint).all():
        raise InputError(
            f"the setpoint is {setpoint.tolist()}, expected {joints} finite numbers; "
            "nothing was sent"
        )
    return setpoint
