"""Where arm and pendulum were at chosen moments of a run."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.errors import ArmError, ArtefactError
from equipoise.model.arms.arm import Arm
from equipoise.runlog import RunLog

Floats = npt.NDArray[np.float64]


class Moments(NamedTuple):
    """What a picture shows and what is written beside it."""

    time: Floats
    """Since the release [s], shape (n,)."""
    x: Floats
    """Displacement of the flange [m], shape (n,)."""
    phi: Floats
    """Angle of the pendulum from upright [rad], shape (n,)."""
    q: Floats
    """All joints [rad], shape (n, joints)."""

    def captions(self) -> list[tuple[str, str, str]]:
        """Return time, displacement and angle of each, in words."""
        return [
            (f"t = {time:.2f} s", f"x = {signed(x, 3)} m", f"φ = {signed(phi_deg, 1)}°")
            for time, x, phi_deg in zip(self.time, self.x, np.rad2deg(self.phi), strict=True)
        ]


def moments(run: RunLog, arm: Arm, times: Sequence[float] | Floats) -> Moments:
    """Return the run at `times` [s], from straight lines between its ticks.

    The truth is shown where it is known, else what the policy saw and commanded.

    Raises:
        ArmError: Another arm ran.
        ArtefactError: No policy ran.
    """
    names = tuple(joint.name for joint in arm.joints)
    if (run.conditions.arm, run.conditions.joints) != (arm.name, names):
        raise ArmError(
            f"the run is one of {run.conditions.arm}, not of {arm.name}; give the arm that ran"
        )
    if not len(run.time):
        raise ArtefactError("the run has no ticks, nothing to show; give one in which a policy ran")
    shown = run.truth if len(run.truth.q) else run
    at = np.asarray(times, np.float64)
    x, phi, *joints = (np.interp(at, run.time, v) for v in (shown.x, shown.phi, *shown.q.T))
    return Moments(at, x, phi, np.column_stack(joints))


def signed(value: float, digits: int) -> str:
    """Return a number as it is printed, with its sign, unless it is zero."""
    text = f"{value:+.{digits}f}"
    return text.replace("-", "\N{MINUS SIGN}") if float(text) else text[1:]
