"""Emulated operator at a simulated rig: types answers, and uses a hand on the pendulum.

It perceives a run in one of two ways, and the owner connects one of them:

Messages
    The run in the same process sends messages. The operator reacts to each request after a reaction
    time, with the first expected answer and with the hand.
Sight
    The operator has no screen behind the wires of a real rig. `look` runs each millisecond and acts
    on the motion of arm and pendulum:

    1. The arm rests at home and the pendulum hangs still: press the button, repeatedly. Stop a
       swinging pendulum by hand first.
    2. The arm moves for the self-test. After the arm has rested for the length of the test, lift
       the pendulum from either side, hold it upright and release it.
    3. The arm moves to balance; keep the hand off. After the pendulum has fallen and the arm rests,
       bring the pendulum to hang and begin again. If neither moves, dry friction holds the
       pendulum: nudge it.
    4. The arm does not move: lift once more, then begin again.

Acting on sight waits until motion has visibly ended, which messages make unnecessary. Both ways are
kept because sight alone would change the time and the random draws of all runs with messages.
Equal seeds and equal perceptions at equal times give equal acts.
"""

from collections.abc import Callable
from enum import Enum
from math import cos, radians
from typing import Final

import numpy as np

from equipoise.control.ticks import OperatorMessage
from equipoise.rig.interfaces import Clock
from equipoise.rig.plugins import ignore
from equipoise.rig.simulated_rig import SimulatedRig
from equipoise.worlds.twin.physics import TICK

REACTION_TIME: Final = (0.3, 1.0)
"""Minimum and maximum reaction time [s]. Assumed."""
NUDGE_RATE: Final = 0.1
"""Change of the pendulum's rate by a nudge [rad/s]."""
LOOK_TICKS: Final = 10
"""Time between two looks [ms]."""
HOME_TOLERANCE: Final = radians(1.0)
"""Maximum distance of a joint from home, for an arm that stands at home [rad]."""
VISIBLE_MOTION: Final = 0.010
"""Minimum displacement of the flange that an eye notices [m]."""
REST_SPEED: Final = 0.005
"""Flange speed below which the arm seems to rest [m/s]."""
HANG_ANGLE: Final = radians(0.3)
"""Maximum angle from hanging of a pendulum that seems to hang still [rad]."""
HANG_RATE: Final = radians(2.0)
"""Maximum rate of a pendulum that seems to hang still [rad/s]."""
CALM_TIME: Final = 3.0
"""Rest of arm and pendulum before the button is pressed [s]; a resting count takes 2 s."""
PRESS_INTERVAL: Final = 5.0
"""Time until the button is pressed again, if nothing has moved [s]."""
MAX_SWING_TIME: Final = 4.0
"""Time after which a swinging pendulum is stopped by hand [s]."""
SWING_OUT_TIME: Final = 8.0
"""Rest of the arm after which the self-test is over [s]; it watches the swing for 4 s."""
STEADY_TIME: Final = 1.0
"""Time for which the hand keeps a pendulum hanging before it releases it [s]."""
STAND_TIME: Final = 3.0
"""Time after which a pendulum above a resting arm stands by itself [s]; a fall takes less than 2 s
from where friction just releases it."""
FALLEN_ANGLE: Final = radians(45.0)
"""Angle from upright of a fallen pendulum [rad]."""
LAID_DOWN_TIME: Final = 2.0
"""Time between a fall and the next grip [s]."""
MAX_LIFTS: Final = 2
"""Number of lifts for an arm that does not move."""


class OperatorActivity(Enum):
    """Activity of an operator who acts on sight."""

    WAITING = "waits for the arm to rest at home"
    STEADYING = "stops the pendulum"
    PRESSED = "waits for the self-test"
    TESTED = "waits until the self-test is over"
    LIFTING = "lifts the pendulum"
    HOLDING = "holds it"
    RELEASED = "has let go"
    FALLEN = "leaves the fallen pendulum alone"


class EmulatedOperator:
    """Operator at a simulated rig, who perceives it by messages or by sight."""

    def __init__(
        self,
        bench: SimulatedRig,
        clock: Clock,
        *,
        clumsy: float = 0.0,
        seed: int = 0,
        swing_out_time: float = SWING_OUT_TIME,
        say: Callable[[str], None] = ignore,
    ) -> None:
        """Stand at a simulated rig, idle.

        Args:
            bench: The rig; its own seed draws how the hand acts.
            clock: Time of the messages.
            clumsy: Probability of a release with a push or a drag.
            seed: Seed of the reaction times.
            swing_out_time: Rest of the arm after which the self-test is over [s].
            say: Receives each act on sight, in words.
        """
        self._bench, self._clock, self._clumsy, self._say = bench, clock, clumsy, say
        self._random = np.random.default_rng(seed)
        self._plans: list[tuple[float, str, Callable[[], object]]] = []
        self.messages: list[OperatorMessage] = []
        """Messages received."""
        self.ignored: frozenset[str] = frozenset()
        """Names of messages that the operator misses."""
        self.acts: dict[str, Callable[[], object]] = {
            "hang": lambda: bench.steady(),
            "reference": self._release_and_press,
            "lift": self._lift,
            "armed": bench.let_go,
            "nudge": self._nudge,
            "disarmed": self._lift,
        }
        """Act of the hand for each message that asks for one, by its name."""
        self._swing_out_time, self._home = swing_out_time, bench.twin.kernel.home
        self._since = self._rested = self._calm = bench.now
        self._from = self._holding = 0.0
        self._lifts = self._looks = 0
        self._pressed = self._was_home = False
        self.doing = OperatorActivity.WAITING
        """Activity of an operator who acts on sight."""

    # By messages.

    def notify(self, event: OperatorMessage) -> None:
        """Receive a message, and plan the answer to it."""
        if event.name in self.ignored:
            return
        self.messages.append(event)
        if event.name in self.acts or event.answers:
            moment = self._clock.now() + float(self._random.uniform(*REACTION_TIME))
            word, act = next(iter(event.answers), ""), self.acts.get(event.name, ignore)
            self._plans.append((moment, word, act))

    def read_input(self) -> list[str]:
        """Carry out the acts that are due, and return the words typed by now."""
        now = self._clock.now()
        due = [plan for plan in self._plans if plan[0] <= now]
        self._plans = [plan for plan in self._plans if plan[0] > now]
        for _, _, act in due:
            act()
        return [word for _, word, _ in due if word]

    # The hand.

    def _lift(self) -> None:
        hand = self._bench.lift(clumsy=self._clumsy)
        self._holding = hand.holding
        self._lifts += 1
        side = "in front" if hand.side == "front" else "at the back"
        self._begin(OperatorActivity.LIFTING, f"lifts the pendulum {side}")

    def _release_and_press(self) -> None:
        self._bench.let_go()
        self._bench.press()

    def _nudge(self) -> None:
        self._bench.let_go()
        self._bench.push(NUDGE_RATE)

    # By sight.

    def look(self) -> None:
        """Act on the motion of arm and pendulum; to be called each millisecond."""
        self._looks += 1
        if self._looks % LOOK_TICKS:
            return
        bench, now, truth = self._bench, self._bench.now, self._bench.truth()
        if abs(truth.x_dot) > REST_SPEED:
            self._rested = now
        if cos(truth.phi) >= -cos(HANG_ANGLE) or abs(truth.phi_dot) >= HANG_RATE:
            self._calm = now
        moved = abs(truth.x - self._from) > VISIBLE_MOTION
        spent = now - self._since
        match self.doing:
            case OperatorActivity.WAITING:
                if self._was_home and moved:
                    self._see_self_test()
                if now - self._rested < CALM_TIME or not self._at_home():
                    return
                self._was_home, self._from = True, truth.x
                if now - self._calm >= CALM_TIME:
                    bench.press()
                    said = "" if self._pressed else "presses the button"
                    self._begin(OperatorActivity.PRESSED, said)
                    self._pressed = True
                elif now - self._calm < TICK and spent > MAX_SWING_TIME:
                    self._steady("stops the swinging pendulum")
            case OperatorActivity.STEADYING:
                if bench.hand.holds and now > bench.hand.arrives() + STEADY_TIME:
                    bench.let_go()
                    self._begin(OperatorActivity.WAITING, "lets the pendulum hang")
            case OperatorActivity.PRESSED:
                if moved:
                    self._see_self_test()
                elif spent > PRESS_INTERVAL:
                    self._begin(OperatorActivity.WAITING)
            case OperatorActivity.TESTED:
                if now - self._rested > self._swing_out_time:
                    self._lift()
            case OperatorActivity.LIFTING:
                if now > bench.hand.arrives():
                    self._begin(OperatorActivity.HOLDING, f"holds it for {self._holding:.1f} s")
            case OperatorActivity.HOLDING:
                if spent > self._holding:
                    bench.let_go()
                    self._begin(OperatorActivity.RELEASED, "lets go")
            case OperatorActivity.RELEASED:
                if abs(truth.phi) > FALLEN_ANGLE:
                    said = f"sees it fall after {spent:.1f} s"
                    self._begin(OperatorActivity.FALLEN, said, keep=True)
                elif min(spent, now - self._rested) > STAND_TIME:
                    self._nudge()
                    self._begin(OperatorActivity.RELEASED, "nudges it: it stands by itself")
            case OperatorActivity.FALLEN:
                if spent < LAID_DOWN_TIME or now - self._rested < LAID_DOWN_TIME / 2.0:
                    return
                if moved or self._lifts >= MAX_LIFTS:
                    self._steady("takes hold of the pendulum")
                else:
                    self._lift()

    def _see_self_test(self) -> None:
        self._lifts, self._pressed, self._was_home = 0, False, False
        self._begin(OperatorActivity.TESTED, "sees the arm move")

    def _steady(self, said: str) -> None:
        self._bench.steady()
        self._begin(OperatorActivity.STEADYING, said)

    def _begin(self, doing: OperatorActivity, said: str = "", *, keep: bool = False) -> None:
        """Change the activity; store the position of the arm unless `keep` is set."""
        self.doing = doing
        self._since = self._bench.now
        if not keep:
            self._from = self._bench.truth().x
        if said:
            self._say(said)

    def _at_home(self) -> bool:
        q = self._bench.twin.kernel.bodies.qpos[: self._bench.joints]
        return bool(np.abs(q - self._home).max() < HOME_TOLERANCE)
