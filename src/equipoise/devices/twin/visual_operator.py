"""The operator at a bench, who sees arm and pendulum and no screen.

What a run asks for follows from what can be seen. The script:

1. The arm rests at home and the pendulum hangs still: press the button, and again from time to
   time. A pendulum that swings there is stopped by hand first.
2. The arm moves away from there: that is the self-test. When it has rested for as long as that may
   take, lift the pendulum, from either side, hold it upright, let go.
3. The arm moves: it balances; keep hands off. Once the pendulum has fallen and the arm rests, take
   hold of it, let it hang, and begin again. Where neither moves, the pendulum stands by its dry
   friction: nudge it.
4. The arm does not move: lift the pendulum once more; then begin again.
"""

from collections.abc import Callable
from enum import Enum
from math import cos, radians
from typing import Final

import numpy as np

from equipoise.devices.twin.operator_actions import NUDGE
from equipoise.devices.twin.physics import TICK
from equipoise.devices.twin.simulated_rig import SimulatedRig

LOOKS: Final = 10
"""Milliseconds between two looks."""
NEAR_HOME: Final = radians(1.0)
"""The arm is at home where no joint is further from it [rad]."""
MOVED: Final = 0.010
"""What an eye notices of the flange's motion [m]."""
RESTS: Final = 0.005
"""Flange speed below which the arm seems to rest [m/s]."""
STILL: Final = radians(0.3)
"""Within so much of hanging the pendulum seems to hang ... [rad]"""
STILL_RATE: Final = radians(2.0)
"""... and still if it is no faster [rad/s]."""
CALM: Final = 3.0
"""For so long all has to rest before the button is pressed [s]: a resting count takes 2 s."""
AGAIN: Final = 5.0
"""After so long the button is pressed again if nothing has moved [s]."""
SWINGING: Final = 4.0
"""A pendulum that still swings after so long is stopped by hand [s]."""
SWUNG_OUT: Final = 8.0
"""A self-test is over when the arm has rested for so long [s]: it watches the swing for 4 s."""
STEADY: Final = 1.0
"""A pendulum is kept hanging for so long before it is let go [s]."""
STANDS: Final = 3.0
"""A pendulum that has not fallen for so long, above an arm that rests, stands by itself [s]: a fall
takes less than 2 s from where friction just lets it go."""
FALLEN: Final = radians(45.0)
"""Beyond this the pendulum has fallen [rad]."""
LAID_DOWN: Final = 2.0
"""It is left alone for so long then [s]."""
LIFTS: Final = 2
"""So many times the pendulum is lifted for an arm that does not move."""


class OperatorActivity(Enum):
    """What the operator is at."""

    WAITING = "waits for the arm to rest at home"
    STEADYING = "stops the pendulum"
    PRESSED = "waits for the self-test"
    TESTED = "waits until the self-test is over"
    LIFTING = "lifts the pendulum"
    HOLDING = "holds it"
    RELEASED = "has let go"
    FALLEN = "leaves the fallen pendulum alone"


class VisualOperator:
    """An operator who acts on what can be seen; `look` runs each millisecond (`Bench.watch`)."""

    def __init__(
        self,
        bench: SimulatedRig,
        *,
        clumsy: float = 0.0,
        swung_out: float = SWUNG_OUT,
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Stand at a bench, idle.

        Args:
            bench: The bench; what the hands do there is drawn from its seed.
            clumsy: Chance that the pendulum is let go with a push or a drag.
            swung_out: How long an arm has to rest after its self-test [s].
            say: Is told each act in words.
        """
        self._bench = bench
        self._clumsy = clumsy
        self._swung_out = swung_out
        self._say = say
        self._home = bench.twin.kernel.home
        self._since = self._rested = self._calm = bench.now
        self._from = 0.0
        self._holding = 0.0
        self._lifts = 0
        self._looks = 0
        self._pressed = self._was_home = False
        self.doing = OperatorActivity.WAITING
        """What the operator is at."""

    def look(self) -> None:
        """See what there is, and do what it asks for."""
        self._looks += 1
        if self._looks % LOOKS:
            return
        bench, now, truth = self._bench, self._bench.now, self._bench.truth()
        if abs(truth.x_dot) > RESTS:
            self._rested = now
        if not self._hangs_still(truth.phi, truth.phi_dot):
            self._calm = now
        moved = abs(truth.x - self._from) > MOVED
        fallen = abs(truth.phi) > FALLEN
        spent = now - self._since
        match self.doing:
            case OperatorActivity.WAITING:
                if self._was_home and moved:
                    self._see_the_self_test()
                if now - self._rested < CALM or not self._at_home():
                    return
                self._was_home, self._from = True, truth.x
                if now - self._calm >= CALM:
                    bench.press()
                    self._begin(
                        OperatorActivity.PRESSED, "" if self._pressed else "presses the button"
                    )
                    self._pressed = True
                elif now - self._calm < TICK and spent > SWINGING:
                    bench.steady()
                    self._begin(OperatorActivity.STEADYING, "stops the swinging pendulum")
            case OperatorActivity.STEADYING:
                if bench.hand.holds and now > bench.hand.arrives() + STEADY:
                    bench.let_go()
                    self._begin(OperatorActivity.WAITING, "lets the pendulum hang")
            case OperatorActivity.PRESSED:
                if moved:
                    self._see_the_self_test()
                elif spent > AGAIN:
                    self._begin(OperatorActivity.WAITING)
            case OperatorActivity.TESTED:
                if now - self._rested > self._swung_out:
                    self._lift()
            case OperatorActivity.LIFTING:
                if now > bench.hand.arrives():
                    self._begin(OperatorActivity.HOLDING, f"holds it for {self._holding:.1f} s")
            case OperatorActivity.HOLDING:
                if spent > self._holding:
                    bench.let_go()
                    self._begin(OperatorActivity.RELEASED, "lets go")
            case OperatorActivity.RELEASED:
                if fallen:
                    self._begin(
                        OperatorActivity.FALLEN, f"sees it fall after {spent:.1f} s", keep=True
                    )
                elif min(spent, now - self._rested) > STANDS:
                    bench.push(NUDGE)
                    self._begin(OperatorActivity.RELEASED, "nudges it: it stands by itself")
            case OperatorActivity.FALLEN:
                if spent < LAID_DOWN or now - self._rested < LAID_DOWN / 2.0:
                    return
                if moved or self._lifts >= LIFTS:
                    bench.steady()
                    self._begin(OperatorActivity.STEADYING, "takes hold of the pendulum")
                else:
                    self._lift()

    def _see_the_self_test(self) -> None:
        self._lifts, self._pressed, self._was_home = 0, False, False
        self._begin(OperatorActivity.TESTED, "sees the arm move")

    def _lift(self) -> None:
        manner = self._bench.lift(clumsy=self._clumsy)
        self._holding = manner.holding
        self._lifts += 1
        side = "in front" if manner.side == "front" else "at the back"
        self._begin(OperatorActivity.LIFTING, f"lifts the pendulum {side}")

    def _begin(self, doing: OperatorActivity, words: str = "", *, keep: bool = False) -> None:
        """Turn to something else, and remember where the arm is unless that is to be kept."""
        self.doing = doing
        self._since = self._bench.now
        if not keep:
            self._from = self._bench.truth().x
        if words:
            self._say(words)

    def _hangs_still(self, phi: float, phi_dot: float) -> bool:
        return cos(phi) < -cos(STILL) and abs(phi_dot) < STILL_RATE

    def _at_home(self) -> bool:
        q = self._bench.twin.kernel.bodies.qpos[: self._bench.joints]
        return bool(np.abs(q - self._home).max() < NEAR_HOME)
