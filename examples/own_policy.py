"""Write a policy of your own and evaluate it on the digital twin.

python examples/own_policy.py

The same from the command line, in the folder of this file:

equipoise evaluate own_policy:Damped --world twin:nominal
"""

from collections.abc import Iterable
from math import sqrt

import equipoise as eq

PENDULUM = eq.shipped_pendulum()


class Damped:
    """Pulls the flange below the pendulum, and back to the middle of the track."""

    def __init__(self) -> None:
        p = PENDULUM.parameters()
        self.angle = 2.0 * p.w2 / p.k
        self.rate = 2.0 * sqrt(p.w2) / p.k

    def act(self, observation: Iterable[float]) -> float:
        """Return the acceleration of the flange [m/s^2]."""
        x, x_dot, phi, phi_dot = observation  # [m], [m/s], [rad], [rad/s]
        # A lean of phi moves the flange; this target brings it back.
        lean = -0.1 * x - 0.12 * x_dot
        return self.angle * (phi - lean) + self.rate * phi_dot


def main() -> None:
    """Evaluate it on a few trials: Python runs each in about a second."""
    settings = eq.resolve(overrides=["evaluation.trials=5", "evaluation.duration=10"])
    evaluation = eq.evaluate(Damped, settings, world="twin:nominal")
    summary = evaluation.results.summary()
    print(f"{summary.survived} of {summary.trials} trials survived {evaluation.duration:g} s")
    print("ended by:", summary.outcomes)


if __name__ == "__main__":
    main()
