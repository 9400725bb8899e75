"""Inputs and outputs of a control tick of a run on a rig.

A tick handler decides (`equipoise.control.run_controller`). It knows no device, no clock and no
file. The protocols here name the attributes that it reads of a device's values.
"""

from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

OK: Final = "ok"
"""Among an event's answers: what Enter says there, and the pendulum's button does as well."""


class EncoderSample(Protocol):
    """One count of the encoder."""

    @property
    def time(self) -> float:
        """When it was counted [s]."""
        ...

    @property
    def counts(self) -> int:
        """Counts, which grow with theta, after x4."""
        ...

    @property
    def pressed(self) -> bool:
        """Whether the button was pressed since the one before."""
        ...

    @property
    def illegal(self) -> bool:
        """Whether the board met a transition that cannot be."""
        ...

    @property
    def missing(self) -> int:
        """Samples lost since the one before."""
        ...


class RobotReply(Protocol):
    """What a robot said to one setpoint."""

    @property
    def sent(self) -> float:
        """When that setpoint was sent [s]."""
        ...

    @property
    def received(self) -> float:
        """When the reply was read [s]."""
        ...

    @property
    def q(self) -> Sequence[float] | None:
        """Measured joints [rad], if they were asked for."""
        ...

    @property
    def torque(self) -> Sequence[float] | None:
        """External torques [N m], if they were asked for."""
        ...


Job = Callable[[], Any]
"""Work for another process: a `functools.partial` of a function and its values."""


class OperatorMessage(NamedTuple):
    """Something that an operator is told."""

    name: str
    """One word: a state that has begun, or what is asked for."""
    text: str = ""
    """The sentence for a person."""
    answers: tuple[str, ...] = ()
    """Words of which one is expected to be typed."""


class TickRecord(NamedTuple):
    """What a heart saw and decided in a tick, for the log; NaN where it did not look."""

    x: float = np.nan
    """Displacement of the flange as the policy sees it [m]."""
    x_dot: float = np.nan
    """Its velocity [m/s]."""
    phi: float = np.nan
    """Angle of the pendulum from upright as the policy sees it [rad]."""
    phi_dot: float = np.nan
    """Its rate [rad/s]."""
    box: int = -1
    """Box of the table; -1 for none."""
    u: float = 0.0
    """Commanded acceleration of the flange [m/s^2]."""
    estimated_phi: float = np.nan
    """phi now [rad]."""
    estimated_phi_dot: float = np.nan
    """phi_dot now [rad/s]."""
    bias: float = 0.0
    """Estimated error of the zero [rad]."""


class TickOutput(NamedTuple):
    """What a heart wants of a tick."""

    setpoints: tuple[Sequence[float], ...]
    """All joints now, and h / 2 later [rad]."""
    q: Sequence[float]
    """Commanded joints at the end of the tick [rad]."""
    dq: Sequence[float]
    """Their velocities [rad/s]."""
    state: int
    """Where in the run it is."""
    record: TickRecord
    """For the log."""
    events: Sequence[OperatorMessage]
    """For the operator, and for the log."""
    job: Job | None = None
    """What takes longer than a tick, and is to be done beside the loop."""
    to_rest: bool = False
    """Whether the setpoints are on a way to rest: from them on the arm need not be stopped."""
    done: bool = False
    """Whether the arm is at rest and the run is over; the setpoints are sent."""


class TickInputs(NamedTuple):
    """What happened since the last tick."""

    samples: Sequence[EncoderSample]
    """Of the encoder."""
    replies: Sequence[RobotReply]
    """Of the robot."""
    words: Sequence[str]
    """Of the operator."""
    faults: Sequence[str]
    """What failed, in words: the encoder's link, a setpoint that the guard held back."""
    lateness: float
    """How late the tick began [s]."""
    result: Any = None
    """What came of a job, once; an exception where it failed."""


class TickHandler(Protocol):
    """What decides: equal inputs at equal times give equal outputs."""

    @property
    def h(self) -> float:
        """Time between ticks [s]."""
        ...

    def tick(self, now: float, inputs: TickInputs) -> TickOutput:
        """Decide."""
        ...
