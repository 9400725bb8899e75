"""Balance on an arm of your own, from its URDF: no line of Equipoise changes.

python examples/arm_from_a_urdf.py [arm.urdf]

The posture at home and the pivot of the pendulum are found, the kinematics generated and compiled.
"""

import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from PIL import Image

import equipoise as eq
from equipoise.film import RigRenderer

URDF = Path(__file__).parents[1] / "tests" / "data" / "elbow6.urdf"
arm = eq.read_urdf(sys.argv[1] if len(sys.argv) > 1 else URDF)


def balance(observation: Iterable[float]) -> float:
    """Return the acceleration of the flange [m/s^2] for x, x_dot, phi and phi_dot."""
    x, x_dot, phi, phi_dot = observation
    return 1.2 * x + 1.8 * x_dot + 24.0 * phi + 3.0 * phi_dot


run = eq.simulate_run(eq.bind_policy(balance, arm=arm), world="twin:nominal", duration=10.0)
print(f"{arm.name}, {len(arm.joints)} joints: {run.outcome} after {run.survival:g} s")

renderer = RigRenderer(arm, 600, 450)
Image.fromarray(renderer.draw(np.array(arm.home), phi=0.0)).save("arm_from_a_urdf.png")
renderer.close()
