"""Whoever stands at the rig: is told what a run does and asks for, and answers in words.

The emulated one has hands too. What it does with them follows from the name of what it is told, a
reaction time later; what it types is the first answer that would do.
"""

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple, Protocol, runtime_checkable

import numpy as np

from equipoise.devices.interfaces import Clock

REACTION: Final = (0.3, 1.0)
"""Least and most time from what is seen to what is done about it [s]. Assumed."""


@runtime_checkable
class OperatorNotice(Protocol):
    """What an operator is told; any value with these attributes is one."""

    @property
    def name(self) -> str:
        """One word: a state that has begun, or what is asked for, e.g. `lift`."""
        ...

    @property
    def text(self) -> str:
        """The sentence for a person."""
        ...

    @property
    def answers(self) -> tuple[str, ...]:
        """Words of which one is expected to be typed; empty where none is."""
        ...


class Notice(NamedTuple):
    """The plainest event."""

    name: str
    """A state that has begun, or what is asked for."""
    text: str = ""
    """The sentence for a person."""
    answers: tuple[str, ...] = ()
    """Words of which one is expected to be typed."""


@runtime_checkable
class Operator(Protocol):
    """Who is told what a run does, and answers."""

    def notify(self, event: OperatorNotice) -> None:
        """Take note of an event; never blocks."""
        ...

    def read_input(self) -> list[str]:
        """Take what was typed since the last call, a line each, the oldest first; never blocks."""
        ...


class EmulatedOperator:
    """An operator by script: types what is asked for, and does what its hands are for.

    Equal seeds and equal events at equal times give equal acts.
    """

    def __init__(
        self, clock: Clock, acts: Mapping[str, Callable[[], Any]] | None = None, *, seed: int = 0
    ) -> None:
        """Stand at a rig.

        Args:
            clock: Its time.
            acts: What is done with the hands, by the name of the event that asks for it, e.g.
                `{"lift": hands.lift}`; it is done when `words` is called after the reaction time.
            seed: Seed of the reaction times.
        """
        self._clock = clock
        self._acts = dict(acts or {})
        self._random = np.random.default_rng(seed)
        self._due: list[tuple[float, str, Callable[[], Any] | None]] = []
        self.told: list[OperatorNotice] = []
        """All events so far."""

    def notify(self, event: OperatorNotice) -> None:
        """Take note of an event, and plan what it asks for."""
        self.told.append(event)
        act = self._acts.get(event.name)
        if act is not None or event.answers:
            moment = self._clock.now() + float(self._random.uniform(*REACTION))
            word = event.answers[0] if event.answers else ""
            self._due.append((moment, word, act))

    def read_input(self) -> list[str]:
        """Do what is due, and return what is typed by now."""
        now = self._clock.now()
        due = [plan for plan in self._due if plan[0] <= now]
        self._due = [plan for plan in self._due if plan[0] > now]
        for _, _, act in due:
            if act is not None:
                act()
        return [word for _, word, _ in due if word]
