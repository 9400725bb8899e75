"""Emulated operator at a simulated rig: it types answers, and uses a hand on the pendulum.

It receives the messages of a run in the same process, and reacts to each request after a reaction
time, with the first expected answer and with the hand. Equal seeds and equal messages at equal
times give equal acts.
"""

from collections.abc import Callable
from typing import Final

import numpy as np

from equipoise.control.ticks import OperatorMessage
from equipoise.rig.interfaces import Clock
from equipoise.rig.simulated_rig import SimulatedRig

REACTION_TIME: Final = (0.3, 1.0)
"""Minimum and maximum reaction time [s]. Assumed."""


class EmulatedOperator:
    """Operator at a simulated rig, who perceives a run by its messages."""

    def __init__(self, bench: SimulatedRig, clock: Clock, *, seed: int = 0) -> None:
        """Stand at a simulated rig, idle.

        Args:
            bench: The rig; its own seed draws how the hand acts.
            clock: Time of the messages.
            seed: Seed of the reaction times.
        """
        self._clock, self._random = clock, np.random.default_rng(seed)
        self._due: list[tuple[float, str, str]] = []
        self.ignored: frozenset[str] = frozenset()
        """Names of messages that the operator misses."""
        self.acts: dict[str, Callable[[], object]] = {
            "hang": bench.steady,
            "reference": lambda: (bench.let_go(), bench.press()),
            "lift": lambda: bench.lift(clumsy=0.0),
            "armed": bench.let_go,
            "nudge": lambda: (bench.let_go(), bench.push(0.1)),
            "disarmed": lambda: bench.lift(clumsy=0.0),
        }
        """Act of the hand for each message that asks for one, by its name."""

    def notify(self, event: OperatorMessage) -> None:
        """Receive a message, and plan the answer to it."""
        if event.name in self.ignored:
            return
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
