"""The operator's hands at a bench, by what a run asks for.

The names are those of the pilot's events; `equipoise.devices.operator.EmulatedOperator` reads them
on the screen, and uses these hands a reaction time later::

    operator = EmulatedOperator(clock, hands(bench))
"""

from collections.abc import Callable
from typing import Final

from equipoise.devices.twin.simulated_rig import SimulatedRig

NUDGE: Final = 0.1
"""Change of the rate of a pendulum that is nudged because it stands by itself [rad/s]."""


def operator_actions(bench: SimulatedRig, *, clumsy: float = 0.0) -> dict[str, Callable[[], None]]:
    """Return what hands do, by the name of the event that asks for it.

    Args:
        bench: The bench; how the hands do things is drawn from its seed.
        clumsy: Chance that the pendulum is let go with a push or a drag.
    """

    def lift() -> None:
        bench.lift(clumsy=clumsy)

    def reference() -> None:
        bench.let_go()
        bench.press()

    def nudge() -> None:
        bench.let_go()
        bench.push(NUDGE)

    return {
        "hang": bench.steady,
        "reference": reference,
        "lift": lift,
        "armed": bench.let_go,
        "nudge": nudge,
        "disarmed": lift,
    }
