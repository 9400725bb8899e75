"""Signals that end a program, and processes that must not be ended by them."""

import signal
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from typing import Final

SIGNALS: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""Signals that end a program: Ctrl-C, a request of the system, a closed terminal."""


@contextmanager
def handled_signals(
    signals: Iterable[signal.Signals], handler: Callable[..., object]
) -> Generator[None]:
    """Handle signals in this context; for the main thread only."""
    before = [(number, signal.signal(number, handler)) for number in signals]
    try:
        yield
    finally:
        for number, old in before:
            signal.signal(number, old)


def start_process(process: BaseProcess) -> None:
    """Start a process with signals blocked, until it is ready for them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
