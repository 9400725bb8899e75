"""Operator interface of a run: receives messages, returns typed input."""

from typing import Protocol, runtime_checkable

from equipoise.control.ticks import OperatorMessage


@runtime_checkable
class Operator(Protocol):
    """Person, program or emulation that supervises a run."""

    def notify(self, event: OperatorMessage) -> None:
        """Receive a message; never blocks."""
        ...

    def read_input(self) -> list[str]:
        """Return the lines typed since the last call, the oldest first; never blocks."""
        ...
