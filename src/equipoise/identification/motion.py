"""Identification of an actuator from the excitation of a run, before the pendulum is lifted."""

from hashlib import sha256

import numpy as np
import numpy.typing as npt

from equipoise.artefacts import DIGEST_PREFIX
from equipoise.identification.actuator import identify_actuator
from equipoise.model.actuator import Actuator

Array = npt.NDArray[np.float64]


def identify_motion(sent: Array, measured: Array) -> Actuator:
    """Identify the actuator of an arm from a motion of all joints.

    The inertia of the last rotor is not fitted: the motion is half as large as that of a log of
    `deploy --excite`, and the policy's controller does not use it.

    Args:
        sent: Time [s] and setpoint of the free joints [rad], shape (m, 7).
        measured: Time [s] and measured free joints [rad], shape (p, 7).

    Returns:
        The actuator; the source of its fit is the digest of the two arrays.

    Raises:
        RecordingError: The motion cannot be used, see `identify_actuator`.
    """
    source = DIGEST_PREFIX + sha256(sent.tobytes() + measured.tobytes()).hexdigest()
    parts = (sent[:, 0], sent[:, 1:], measured[:, 0], measured[:, 1:])
    return identify_actuator(*map(np.ascontiguousarray, parts), source=source)
