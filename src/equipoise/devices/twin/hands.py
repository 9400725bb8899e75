"""The operator's hands at a bench, by what a run asks for.

The names are those of the pilot's events; with `equipoise.devices.operator.EmulatedOperator` they
make an operator who reads the screen::

    hands = Hands(bench)
    operator = EmulatedOperator(clock, hands.acts)
"""

from collections.abc import Callable, Mapping
from typing import Final

from equipoise.devices.twin.bench import Bench
from equipoise.devices.twin.hand import Manner, Side

STEADY: Final = 1.0
"""A pendulum is kept hanging for so long before it is let go [s]."""


class Hands:
    """Hands that steady, press, lift, and let go once they may."""

    def __init__(self, bench: Bench, *, side: Side | None = None, clumsy: float = 0.0) -> None:
        """Stand at a bench, idle.

        Args:
            bench: The bench; how the hands do things is drawn from its seed.
            side: From where the pendulum is lifted; either if not given.
            clumsy: Chance that it is let go with a push or a drag.
        """
        self._bench, self._clumsy = bench, clumsy
        self._side: Side | None = side
        self._due: float | None = None
        self._may = False
        self.manner: Manner | None = None
        """How the pendulum was lifted last; none before it was."""
        self.released: float | None = None
        """When it was let go after that [s]; none before."""
        self.acts: Mapping[str, Callable[[], None]] = {
            "hang": self.steady,
            "reference": bench.press,
            "lift": self.lift,
            "armed": self.may_let_go,
            "disarmed": self.hold_on,
        }
        """What is done, by the name of the event that asks for it."""
        bench.watch(self._let_go_when_due)

    def steady(self) -> None:
        """Bring the pendulum to where it hangs, and let go."""
        self._bench.steady()
        self._due, self._may = self._bench.hand.arrives() + STEADY, True

    def lift(self) -> None:
        """Lift the pendulum, and hold it for as long as one likes, and until one may let go."""
        self.manner = self._bench.lift(side=self._side, clumsy=self._clumsy)
        self._due, self._may = self._bench.hand.arrives() + self.manner.holding, False
        self.released = None

    def may_let_go(self) -> None:
        """Let go when one feels like it."""
        self._may = True

    def hold_on(self) -> None:
        """Hold until one may let go, and lift the pendulum again if it is gone."""
        self._may = False
        if not self._bench.hand.holds:
            self.lift()

    def _let_go_when_due(self) -> None:
        bench = self._bench
        if self._may and self._due is not None and bench.now >= self._due:
            bench.let_go()
            self._due, self.released = None, bench.now
