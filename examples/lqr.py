"""Bring LQR as a guest: a policy of four gains, on the twin beside the table.

python examples/lqr.py

LQR knows the pendulum's equation; the table has learned it. Both see what the encoder shows.
"""

from collections.abc import Iterable

import matplotlib.pyplot as plt
import numpy as np

import equipoise as eq
from equipoise.control.linear import lqr_gains

GAINS = np.array(lqr_gains(eq.shipped_pendulum().parameters(), 0.01))
"""Gains of x, x_dot, phi and phi_dot for a time of 0.01 s between two actions."""


def lqr(observation: Iterable[float]) -> float:
    """Return the acceleration of the flange [m/s^2] for x, x_dot, phi and phi_dot."""
    return float(GAINS @ list(observation))


def main() -> None:
    """Run LQR and the table in the same conditions."""
    figure, axes = plt.subplots(2, sharex=True, figsize=(6, 4), layout="constrained")
    for name, policy in (("LQR", lqr), ("table", eq.shipped_policy())):
        run = eq.simulate_run(policy, world="twin:nominal", seed=3, duration=10.0)
        print(f"{name}: {run.outcome} after {run.survival:g} s")
        axes[0].plot(run.time, 1e3 * run.truth.x, label=name)
        axes[1].plot(run.time, np.degrees(run.truth.phi))
    axes[0].set(ylabel="flange x [mm]")
    axes[1].set(ylabel="pendulum φ [deg]", xlabel="time [s]")
    axes[0].legend()
    figure.savefig("lqr.png")


if __name__ == "__main__":
    main()
