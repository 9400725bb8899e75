r"""States of a run on a rig, and the transitions between them.

::

    IDLE --start--> HOMING --arrived--> AT_HOME --confirmed--> REFERENCING --referenced--> SELF_TEST
                                                                    ^                       | |   |
                                                                    +-------- refused ------+ |   |
                                                            EXCITING <------- excited --------+   |
                                                                |                          passed |
    BALANCING <--released-- ARMED --denied--> LIFTING <-passed--+---------------------------------+
                              ^---- armed -------+

    any of them but IDLE --stop--> STOPPING --at rest--> STOPPED --re-armed--> IDLE
    IDLE --stop--> STOPPED                    any state --lost--> LOST

Setpoints are sent in the streaming states, HOMING to STOPPING, and in no other.

A stop is latched. Only the operator leads out of STOPPED, by re-arming; the run then begins anew,
and its first setpoint is the measured posture. The first cause is kept. LOST is final: software
commands nothing without a link, and nothing reconnects.

An event without an entry in the table changes nothing: a late event must not move an arm.
"""

from collections.abc import Mapping
from enum import Enum
from typing import Final, NamedTuple


class Phase(Enum):
    """Phase of a run."""

    IDLE = "idle"
    """Connected, the servo not running."""
    HOMING = "homing"
    """On the way home, inside the servo stream."""
    AT_HOME = "at home"
    """Held at home, until the operator confirms."""
    REFERENCING = "referencing"
    """Held, the pendulum hanging, until it is still and the button is pressed."""
    SELF_TEST = "self-test"
    """The flange moves by 40 mm, the pendulum answers and swings out."""
    EXCITING = "exciting"
    """Every joint moves about home, the pendulum hanging; then the arm is identified."""
    LIFTING = "lifting"
    """Held, the operator lifts the pendulum."""
    ARMED = "armed"
    """Held, the pendulum stands in a hand that may release it."""
    BALANCING = "balancing"
    """The policy commands."""
    STOPPING = "stopping"
    """On the way to rest, inside the servo stream. Latched."""
    STOPPED = "stopped"
    """At rest, the servo not running. Latched."""
    LOST = "lost"
    """The link is lost: the arm holds or approaches the last target. Latched, final."""


class RunEvent(Enum):
    """Event that moves a run from one phase to the next."""

    START = "start"
    """The servo runs, holding the measured posture."""
    ARRIVED = "arrived"
    """The path home has ended."""
    CONFIRMED = "confirmed"
    """The operator confirms home."""
    REFERENCED = "referenced"
    """The resting count is known."""
    REFUSED = "refused"
    """The self-test refuses the resting count as the zero."""
    EXCITED = "excited"
    """The self-test passed, and the excitation begins."""
    PASSED = "passed"
    """The self-test passed, and gave the zero; the arm is known."""
    ARMED = "armed"
    """The pendulum stands still."""
    DENIED = "denied"
    """The hand is still on."""
    RELEASED = "released"
    """The pendulum falls freely."""
    STOP = "stop"
    """A safety rule, a key, a signal, an error or the end of the run."""
    AT_REST = "at rest"
    """The ramp and the servo have ended, and the arm is measured at rest."""
    LOST = "lost"
    """The robot or its link has stopped answering."""
    REARMED = "re-armed"
    """The operator acknowledges the cause and starts the run anew."""


STREAMING: Final = frozenset(Phase) - {Phase.IDLE, Phase.STOPPED, Phase.LOST}
"""Phases in which setpoints are sent."""
LATCHED: Final = frozenset({Phase.STOPPING, Phase.STOPPED, Phase.LOST})
"""Phases in which a stop is latched."""
TRANSITIONS: Final[Mapping[tuple[Phase, RunEvent], Phase]] = {
    (Phase.IDLE, RunEvent.START): Phase.HOMING,
    (Phase.HOMING, RunEvent.ARRIVED): Phase.AT_HOME,
    (Phase.AT_HOME, RunEvent.CONFIRMED): Phase.REFERENCING,
    (Phase.REFERENCING, RunEvent.REFERENCED): Phase.SELF_TEST,
    (Phase.SELF_TEST, RunEvent.REFUSED): Phase.REFERENCING,
    (Phase.SELF_TEST, RunEvent.PASSED): Phase.LIFTING,
    (Phase.SELF_TEST, RunEvent.EXCITED): Phase.EXCITING,
    (Phase.EXCITING, RunEvent.PASSED): Phase.LIFTING,
    (Phase.LIFTING, RunEvent.ARMED): Phase.ARMED,
    (Phase.ARMED, RunEvent.DENIED): Phase.LIFTING,
    (Phase.ARMED, RunEvent.RELEASED): Phase.BALANCING,
    (Phase.STOPPING, RunEvent.AT_REST): Phase.STOPPED,
    (Phase.STOPPED, RunEvent.REARMED): Phase.IDLE,
    (Phase.IDLE, RunEvent.STOP): Phase.STOPPED,
    **{(phase, RunEvent.STOP): Phase.STOPPING for phase in STREAMING},
    **{(phase, RunEvent.LOST): Phase.LOST for phase in Phase},
}
"""All transitions."""


class Cause(NamedTuple):
    """Cause of a stop."""

    name: str
    """Name, such as that of a rule."""
    reason: str
    """Message for the operator."""
    from_measured: bool = False
    """Whether the arm is not at its setpoint; the targets then go to the measured posture after the
    ramp."""


class RunState(NamedTuple):
    """The state of a run."""

    phase: Phase = Phase.IDLE
    """Phase."""
    cause: Cause | None = None
    """Cause of the latched stop, if any."""
    from_measured: bool = False
    """Whether any cause so far shows that the arm is not at its setpoint."""

    @property
    def latched(self) -> bool:
        """Whether a stop is latched."""
        return self.phase in LATCHED


UNKNOWN: Final = Cause("unknown", "the run was stopped without a cause", from_measured=True)
"""Cause of a stop without a given one."""


def step(state: RunState, event: RunEvent, cause: Cause | None = None) -> RunState:
    """Return the state after an event.

    Args:
        state: The state before it.
        event: The event.
        cause: Cause of STOP and LOST.
    """
    phase = TRANSITIONS.get((state.phase, event))
    if phase is None:
        return state
    if event in (RunEvent.STOP, RunEvent.LOST):
        cause = cause or UNKNOWN
        return RunState(phase, state.cause or cause, state.from_measured or cause.from_measured)
    if event is RunEvent.REARMED:
        return RunState()
    return state._replace(phase=phase)
