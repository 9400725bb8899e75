"""Compare the releases of nine pendulums with their recoverable sets, for the twins' delays.

Prints the table of `docs/how-to/your-own-pendulum.md`. Takes a minute.
"""

import argparse
from math import degrees

import numpy as np

from equipoise.artefacts import Estimate
from equipoise.checks.recoverable import (
    ReleaseLimit,
    diverging_angle,
    fall,
    largest_recovery,
    make_recovery_params,
    release_limit,
)
from equipoise.model.actuator import Actuator, shipped_actuator
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.sim_configs import read_world
from equipoise.settings import GRAVITY, resolve

W2 = (25.0, 70.0, 140.0)
"""Gravity over inertia [1/s^2]: rods of 59, 21 and 11 cm."""
FRICTIONS = ((0.01, 0.05), (0.1, 0.5), (0.6, 2.0))
"""Viscous friction [1/s] and dry friction over inertia [1/s^2]; recorded pivots have 0.05 to 0.6
and 0.01 to 2.1."""
WORLDS = ("twin:nominal", "twin:harsh")
LONGEST = 0.2
"""Longest transport delay that is tried [s]."""
STEP = 0.001
"""Resolution of the longest transport delay [s]."""


def with_delay(delay: float) -> Actuator:
    """Return the shipped actuator with another transport delay [s]."""
    return shipped_actuator().model_copy(update={"delay": Estimate.around(delay, 0.0, "assumed")})


def main() -> None:
    """Print a row for each pendulum."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--set", action="append", default=[], help="a setting; repeatable")
    settings, arm = resolve(overrides=parser.parse_args().set), iiwa(7)

    def limit(pendulum: PendulumParameters, delay: float) -> ReleaseLimit:
        return release_limit(pendulum, arm, settings, with_delay(delay))

    print(
        "| w2, c, dry friction | necessary | sufficient | worst, nominal | harsh | longest delay |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    for w2 in W2:
        for c, coulomb in FRICTIONS:
            pendulum = PendulumParameters(w2, w2 / GRAVITY, c, coulomb)
            found = [limit(pendulum, read_world(name).settings.transport) for name in WORLDS]
            params = make_recovery_params(pendulum, arm, settings, shipped_actuator())
            e = settings.evaluation
            release = fall(params, np.array([[0.0, 0.0, e.phi_high, e.phi_dot_high]]))[0]
            known = largest_recovery(params, release)[0] * diverging_angle(*release[2:], pendulum)
            low, high = read_world(WORLDS[0]).settings.transport, LONGEST
            while high - low > STEP:
                middle = 0.5 * (low + high)
                one = limit(pendulum, middle)
                low, high = (middle, high) if one.share == 1.0 else (low, middle)
            worst = [f"{degrees(one.worst):.1f}°, {one.worst / one.limit:.0%}" for one in found]
            limits = [f"{degrees(angle):.1f}°" for angle in (found[0].limit, known)]
            row = [f"{w2:g}, {c:g}, {coulomb:g}", *limits, *worst, f"{1e3 * low:.0f} ms"]
            print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
