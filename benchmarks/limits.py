"""Compare the releases of nine pendulums with their recoverable sets, for the twins' delays.

Prints the table of `docs/how-to/your-own-pendulum.md`. The last column is the share of trials that
LQR lasts on the plant of the training, with its noise and variation. Takes about three minutes.
"""

import argparse
from math import degrees, radians

from equipoise.artefacts import Estimate
from equipoise.control.bound_policy import load_policy
from equipoise.executors import available_cores
from equipoise.model.actuator import Actuator, shipped_actuator
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.pendulum import Pendulum
from equipoise.model.worlds import read_world
from equipoise.settings import resolve
from equipoise.worlds.evaluation import evaluate
from equipoise.worlds.reachability import ReleaseLimit, release_limit

W2 = (25.0, 70.0, 140.0)
"""Gravity over inertia [1/s^2]: rods of 59, 21 and 11 cm."""
FRICTIONS_DEG = ((0.01, 0.1), (0.1, 0.3), (0.6, 1.0))
"""Viscous friction [1/s], and dry friction over gravity, the angle at which it holds a hanging
pendulum beside the vertical [deg]. Recorded pivots have 0.05 to 0.6 1/s and 0.1 to 1 deg."""
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
    parser.add_argument("--trials", type=int, default=200, help="trials of LQR")
    parser.add_argument("--set", action="append", default=[], help="a setting; repeatable")
    options = parser.parse_args()
    settings = resolve(overrides=[f"evaluation.trials={options.trials}", *options.set])
    arm = iiwa(7)
    delays = [read_world(name).settings.transport for name in WORLDS]
    print("| w2, c, dry friction | limit | worst, nominal | harsh | delay | LQR |")
    print("| --- | --- | --- | --- | --- | --- |")
    for w2 in W2:
        for c, angle in FRICTIONS_DEG:
            coulomb = Estimate.around(w2 * radians(angle), 0.0, "assumed")
            pendulum = Pendulum.assumed(w2, c).model_copy(update={"coulomb": coulomb})

            def limit(delay: float, own: Pendulum = pendulum) -> ReleaseLimit:
                return release_limit(own.parameters(), arm, settings, with_delay(delay))

            found = [limit(delay) for delay in delays]
            low, high = delays[0], LONGEST
            while high - low > STEP:
                middle = 0.5 * (low + high)
                low, high = (middle, high) if limit(middle).share == 1.0 else (low, middle)
            lasted: list[str] = []
            for delay in delays:
                given = {"pendulum": pendulum, "arm": arm, "settings": settings}
                policy = load_policy("lqr", actuator=with_delay(delay), **given)
                trials = evaluate(policy, with_baselines=False, workers=available_cores())
                lasted.append(f"{trials.results.summary().survived}")
            worst = [f"{degrees(one.worst):.1f}°, {one.worst / one.limit:.0%}" for one in found]
            limit_deg = f"{degrees(found[0].limit):.1f}°"
            row = [f"{w2:g}, {c:g}, {coulomb.value:.2g}", limit_deg, *worst, f"{1e3 * low:.0f} ms"]
            print(f"| {' | '.join(row)} | {', '.join(lasted)} |", flush=True)


if __name__ == "__main__":
    main()
