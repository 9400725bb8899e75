"""What every robot asks of a setpoint before it is sent."""

from collections.abc import Sequence

import numpy as np

from equipoise.devices.interfaces import Array
from equipoise.errors import InputError


def checked(q: Sequence[float] | Array, joints: int) -> Array:
    """Return a setpoint as an array of its own [rad], shape (joints,).

    Args:
        q: The setpoint [rad].
        joints: How many joints there are.

    Raises:
        InputError: It is not one finite number per joint.
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
