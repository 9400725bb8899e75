"""Emulated operators at a simulated rig: they type answers, and use a hand on the pendulum.

`EmulatedOperator` receives the messages of a run in the same process. It reacts to each request
after a reaction time, with the first expected answer and with the hand.

`SightedOperator` has no screen behind the wires of a real rig. It acts on the motion of arm and
pendulum:

1. The arm rests at home and the pendulum hangs still: press the button, repeatedly. Stop a swinging
   pendulum by hand first.
2. The arm moves for the self-test. After the arm has rested for the length of the test, lift the
   pendulum from either side, hold it upright and release it.
3. The arm moves to balance; keep the hand off. After the pendulum has fallen and the arm rests,
   bring the pendulum to hang and begin again. If neither moves, dry friction holds the pendulum:
   nudge it.
4. The arm does not move: lift once more, then begin again.

Equal seeds and equal perceptions at equal times give equal acts.
"""

from collections.abc import Callable
from math import cos, inf, radians
from typing import Final, Literal

import numpy as np

from equipoise.control.ticks import OperatorMessage
from equipoise.rig.interfaces import Clock
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


class EmulatedOperator:
    """Operator at a simulated rig, who perceives a run by its messages."""

    def __init__(
        self, bench: SimulatedRig, clock: Clock, *, clumsy: float = 0.0, seed: int = 0
    ) -> None:
        """Stand at a simulated rig, idle.

        Args:
            bench: The rig; its own seed draws how the hand acts.
            clock: Time of the messages.
            clumsy: Probability of a release with a push or a drag.
            seed: Seed of the reaction times.
        """
        self._clock, self._random = clock, np.random.default_rng(seed)
        self._due: list[tuple[float, str, str]] = []
        self.messages: list[OperatorMessage] = []
        """Messages received."""
        self.ignored: frozenset[str] = frozenset()
        """Names of messages that the operator misses."""
        self.acts: dict[str, Callable[[], object]] = {
            "hang": bench.steady,
            "reference": lambda: (bench.let_go(), bench.press()),
            "lift": lambda: bench.lift(clumsy=clumsy),
            "armed": bench.let_go,
            "nudge": lambda: (bench.let_go(), bench.push(NUDGE_RATE)),
            "disarmed": lambda: bench.lift(clumsy=clumsy),
        }
        """Act of the hand for each message that asks for one, by its name."""

    def notify(self, event: OperatorMessage) -> None:
        """Receive a message, and plan the answer to it."""
        if event.name in self.ignored:
            return
        self.messages.append(event)
        if event.name in self.acts or event.answers:
            moment = self._clock.now() + float(self._random.uniform(*REACTION_TIME))
            self._due.append((moment, next(iter(event.answers), ""), event.name))

    def read_input(self) -> list[str]:
        """Carry out the acts that are due, and return the words typed by now."""
        now = self._clock.now()
        due = [one for one in self._due if one[0] <= now]
        self._due = [one for one in self._due if one[0] > now]
        for _, _, name in due:
            if name in self.acts:
                self.acts[name]()
        return [word for _, word, _ in due if word]


class SightedOperator:
    """Operator at a simulated rig, who perceives a run by the motion of arm and pendulum."""

    def __init__(
        self,
        bench: SimulatedRig,
        *,
        clumsy: float = 0.0,
        swing_out_time: float = SWING_OUT_TIME,
        say: Callable[[str], None],
    ) -> None:
        """Stand at a simulated rig, idle.

        Args:
            bench: The rig; its own seed draws how the hand acts.
            clumsy: Probability of a release with a push or a drag.
            swing_out_time: Rest of the arm after which the self-test is over [s].
            say: Receives each act, in words.
        """
        self._bench, self._clumsy, self._say = bench, clumsy, say
        self._swing_out_time, self._home = swing_out_time, bench.twin.kernel.home
        self._since = self._rested = self._calm = bench.now
        self._from = self._holding = 0.0
        self._pressed_at = -inf
        self._lifts = self._looks = 0
        self._was_home = False
        self.doing: Literal["waits", "steadies", "tests", "holds", "released", "fallen"] = "waits"
        """Activity."""

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
        spent, rest = now - self._since, now - self._rested
        match self.doing:
            case "waits":
                self._wait_at_home(truth.x, moved, spent, rest)
            case "steadies":
                if bench.hand.holds and now > bench.hand.arrives() + STEADY_TIME:
                    bench.let_go()
                    self._begin("waits", "lets the pendulum hang")
            case "tests":
                if rest > self._swing_out_time:
                    self._lift()
            case "holds":
                if now > bench.hand.arrives() + self._holding:
                    bench.let_go()
                    self._begin("released", "lets go")
            case "released":
                if abs(truth.phi) > FALLEN_ANGLE:
                    self._say(f"sees it fall after {spent:.1f} s")
                    self.doing, self._since = "fallen", now
                elif min(spent, rest) > STAND_TIME:
                    bench.push(NUDGE_RATE)
                    self._begin("released", "nudges it: it stands by itself")
            case "fallen":
                if spent < LAID_DOWN_TIME or rest < LAID_DOWN_TIME / 2.0:
                    return
                if moved or self._lifts >= MAX_LIFTS:
                    self._steady("takes hold of the pendulum")
                else:
                    self._lift()

    def _wait_at_home(self, x: float, moved: bool, spent: float, rest: float) -> None:
        """Press the button where all rests; see the self-test that follows."""
        now, bench = self._bench.now, self._bench
        if self._was_home and moved:
            self._lifts, self._pressed_at, self._was_home = 0, -inf, False
            self._begin("tests", "sees the arm move")
            return
        q = bench.twin.kernel.bodies.qpos[: bench.joints]
        if rest < CALM_TIME or np.abs(q - self._home).max() >= HOME_TOLERANCE:
            return
        self._was_home, self._from = True, x
        if now - self._calm >= CALM_TIME:
            if now - self._pressed_at > PRESS_INTERVAL:
                bench.press()
                if self._pressed_at == -inf:
                    self._say("presses the button")
                self._pressed_at = now
        elif now - self._calm < TICK and spent > MAX_SWING_TIME:
            self._steady("stops the swinging pendulum")

    def _lift(self) -> None:
        hand = self._bench.lift(clumsy=self._clumsy)
        self._holding = hand.holding
        self._lifts += 1
        self._begin("holds", f"lifts the pendulum ({hand.side}) and holds it")

    def _steady(self, said: str) -> None:
        self._bench.steady()
        self._begin("steadies", said)

    def _begin(
        self, doing: Literal["waits", "steadies", "tests", "holds", "released"], said: str
    ) -> None:
        """Change the activity, and store the position of the arm."""
        self.doing, self._since = doing, self._bench.now
        self._from = self._bench.truth().x
        self._say(said)
