"""The table of checks of README.md: python checks.py prints it, and a test compares it."""

from typing import Final

import numpy as np

import parts
import stiffness
from clearance import LEAST, base_rotation, clearance
from design import Design
from equipoise.arm.arm import Arm
from equipoise.arm.urdf import read_arm
from equipoise.paper import FREE_SWING_PERIOD, U_MAX
from equipoise.settings import GRAVITY
from mechanism import Mechanism, build

ARMS: Final = {"iiwa7": 7.0, "iiwa14": 14.0, "fr3": 3.0}
"""Arms that the mechanism is for, with their payload [kg], of the makers' data sheets."""
MEDIA_FLANGES: Final = (0.0, 0.035, 0.061)
"""Heights of what may be between an iiwa and the base [m]."""


def torque_fraction(arm: Arm, mechanism: Mechanism) -> float:
    """Return the largest fraction of a joint's torque that the load takes at home [-].

    Weight, and the largest acceleration of a policy along the track.
    """
    load, home = mechanism.load, arm.kinematics(arm.home_free)
    force = load.mass * np.array([U_MAX, 0.0, GRAVITY])
    lever = home.rotation @ base_rotation(arm) @ load.centre
    moment = home.jacobian[:3].T @ force + home.jacobian[3:].T @ np.cross(lever, force)
    limits = np.array([joint.torque for joint in arm.free_joints])
    return float(np.max(np.abs(moment) / limits))


def rows(mechanism: Mechanism) -> list[tuple[str, str, str]]:
    """Return what is checked, its number, and what is asked for."""
    d, m, load = mechanism.design, mechanism, mechanism.load
    arms = {name: read_arm(name) for name in ARMS}
    found: list[tuple[str, str, str]] = [
        (
            f"period, with a rod of {m.rod_length:.0f} mm",
            f"{m.period:.4f} s",
            f"{FREE_SWING_PERIOD} s ± 1 %",
        ),
        ("mass of the pendulum with spindle and hub", f"{1e3 * m.pendulum.mass:.0f} g", ""),
        ("its centre of mass l, inertia I about the spindle",
         f"{1e3 * m.length:.1f} mm, {1e3 * m.inertia:.2f}e-3 kg m²", ""),
        ("mass of the holder", f"{1e3 * m.holder.mass:.0f} g", ""),
    ]  # fmt: skip
    for name, payload in ARMS.items():
        share = load.mass / payload
        torque = torque_fraction(arms[name], m)
        text = f"{share:.1%}, {torque:.1%}".replace("%", " %")
        found.append((f"part of the payload, and of a joint's torque, {name}", text, "20 %, 10 %"))
    found += [
        ("first mode, finite elements", f"{stiffness.modes(m)[0]:.0f} Hz", "30 Hz or more"),
        ("the same as a beam", f"{stiffness.beam(m):.0f} Hz", "30 Hz or more"),
        ("the pendulum on the spindle alone",
         f"{stiffness.spindle(d, m.pendulum.mass):.0f} Hz", "30 Hz or more"),
    ]  # fmt: skip
    for name, arm in arms.items():
        heights = MEDIA_FLANGES if name.startswith("iiwa") else (0.0,)
        each = [clearance(arm, m, height) for height in heights]
        turn, table = min(c.turn.min() for c in each), min(c.table for c in each)
        text = f"{1e3 * turn:.0f} mm, {1e3 * table:.0f} mm"
        asked = f"{1e3 * LEAST:.0f} mm or more"
        found.append((f"pendulum's whole turn to arm, and to table, {name}", text, asked))
    flange = next(s for s in parts.fasteners(d) if s.name.startswith("flange"))
    found.append(("thread of the M6 screws in the flange", f"{-flange.tip:.1f} mm", "6 to 8 mm"))
    speed = (4.0 * m.w2) ** 0.5 * m.reach
    found.append(("speed of the rod's tip after a fall from upright", f"{speed:.1f} m/s", ""))
    return found


def table(mechanism: Mechanism) -> str:
    """Return the table in Markdown."""
    head = "| check | number | asked for |\n| --- | --- | --- |\n"
    return head + "".join(f"| {' | '.join(row)} |\n" for row in rows(mechanism)).replace(
        "|  |", "| |"
    )


if __name__ == "__main__":
    print(table(build(Design())), end="")
