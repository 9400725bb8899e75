"""Bring model-predictive control as a guest: it plans half a second ahead, within the table's |u|.

python examples/mpc.py

In each tick it finds the accelerations that keep pendulum and flange near their targets, sends the
first one, and plans anew.
"""

from collections.abc import Iterable
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import lsq_linear
from scipy.signal import cont2discrete

import equipoise as eq
from equipoise import paper
from equipoise.control.linear import state_space

PERIOD, EACH, PARTS, LIMIT = 0.01, 5, 10, max(paper.ACTIONS)
"""Time between two ticks [s], ticks of a part, parts of the plan, and the largest |u| [m/s^2]."""
WEIGHTS = np.sqrt([20.0, 1.0, 30.0, 1.0])
"""Weights of x, x_dot, phi and phi_dot [1/m, s/m, 1/rad, s/rad]."""
EFFORT = 0.2
"""Weight of u [s^2/m]."""


def prediction() -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted future states as free @ state + forced @ plan."""
    model = (*state_space(eq.shipped_pendulum().parameters()), np.eye(4), 0)
    sampled: Any = cont2discrete(model, EACH * PERIOD)
    A, B = sampled[:2]
    powers = [np.linalg.matrix_power(A, i) for i in range(PARTS + 1)]
    forced = np.zeros((PARTS, 4, PARTS))
    for i in range(PARTS):
        for j in range(i + 1):
            forced[i, :, j] = (powers[i - j] @ B)[:, 0]
    weights = np.diag(WEIGHTS)
    free = np.concatenate([weights @ power for power in powers[1:]])
    return free, np.concatenate([weights @ rows for rows in forced])


FREE, FORCED = prediction()
SYSTEM = np.vstack([FORCED, EFFORT * np.eye(PARTS)])
ZEROS = np.zeros(PARTS)


def mpc(observation: Iterable[float]) -> float:
    """Return the acceleration of the flange [m/s^2] for x, x_dot, phi and phi_dot."""
    wanted = np.concatenate([-FREE @ list(observation), ZEROS])
    return float(lsq_linear(SYSTEM, wanted, (-LIMIT, LIMIT)).x[0])


def main() -> None:
    """Run it on the twin."""
    run = eq.simulate_run(mpc, world="twin:nominal", seed=3, duration=10.0)
    print(f"MPC: {run.outcome} after {run.survival:g} s")
    figure, axes = plt.subplots(2, sharex=True, figsize=(6, 4), layout="constrained")
    axes[0].plot(run.time, np.degrees(run.truth.phi))
    axes[0].set(ylabel="pendulum φ [deg]")
    axes[1].plot(run.time, run.ticks.u)
    axes[1].set(ylabel="command u [m/s²]", xlabel="time [s]")
    figure.savefig("mpc.png")


if __name__ == "__main__":
    main()
