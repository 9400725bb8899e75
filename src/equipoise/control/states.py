r"""Phases of a run on a rig, and the transitions between them.

::

    HOMING --arrived--> AT_HOME --confirmed--> REFERENCING --referenced--> SELF_TEST
                                                   ^                        | |   |
                                                   +-------- refused -------+ |   |
                                          EXCITING <-------- excited ---------+   |
                                              |                            passed |
    BALANCING <--released-- ARMED <--armed-- LIFTING <-passed--+------------------+
                              +----denied----> ^

The servo runs in all phases. `stop` leads from each of them to STOPPING. A stop is latched: no
event leads out of STOPPING, and the first cause is kept; only the operator begins anew, with a new
run. After a lost link the loop returns, so that no event follows (`equipoise.rig.loop`).

An event without an entry in the table changes nothing: a late event must not move an arm.
"""

from collections.abc import Mapping
from enum import Enum
from typing import Final, NamedTuple

from equipoise.outcomes import End, Phase


class RunEvent(Enum):
    """Event that moves a run from one phase to the next."""

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


TRANSITIONS: Final[Mapping[tuple[Phase, RunEvent], Phase]] = {
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
}
"""All transitions but stops."""


class RunState(NamedTuple):
    """The state of a run."""

    phase: Phase = Phase.HOMING
    """Phase."""
    cause: End | None = None
    """Cause of the latched stop, if any."""
    from_measured: bool = False
    """Whether any cause so far shows that the arm is not at its setpoint."""

    @property
    def latched(self) -> bool:
        """Whether a stop is latched."""
        return self.phase is Phase.STOPPING


def step(state: RunState, event: RunEvent) -> RunState:
    """Return the state after an event."""
    return state._replace(phase=TRANSITIONS.get((state.phase, event), state.phase))


def stop(state: RunState, cause: End, from_measured: bool = False) -> RunState:
    """Return the state after a stop: by a safety rule, the operator, an error or the run's end."""
    away = state.from_measured or from_measured
    return RunState(Phase.STOPPING, state.cause or cause, away)
