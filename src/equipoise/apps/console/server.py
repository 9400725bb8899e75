"""Process of the console: it finds runs on this computer, and shows one after the other.

The process belongs to nobody's loop. It stays off the processor core on which a run's loop stays.
"""

import contextlib
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from importlib import resources
from typing import Any, Final

from equipoise.apps.console.live import LivePage
from equipoise.apps.console.watch import RunWatch
from equipoise.apps.console.web import LOOPBACK, require_viser, serving
from equipoise.errors import EquipoiseError, OutsideError
from equipoise.logs.shared import live_runs, read_info

PERIOD: Final = 0.04
"""Time between two pictures [s]."""
SEARCH_PERIOD: Final = 0.25
"""Time between two searches for a run [s]."""
START_TIMEOUT: Final = 60.0
"""Longest start of the console's process [s]."""
NICE: Final = 10
"""Step of the priority below that of a loop and an emulated rig [-]."""
LINGER: Final = 2.0
"""Time for browsers to show the end of a run before the process ends [s]."""


def serve(
    address: str,
    port: int,
    ready: Callable[[str], None],
    stopped: Callable[[], bool],
    owner: int | None = None,
) -> None:
    """Serve the console until stopped.

    Args:
        address: Address of this computer to listen on.
        port: Port; 0 selects a free one.
        ready: Receives the address of the page with its token.
        stopped: Returns whether to end; called for each picture.
        owner: Process whose run is shown; by default any run of this user.

    Raises:
        MissingExtraError: viser is not installed.
        InputError: The address is invalid.
        OutsideError: The port is not available.
    """
    stay_aside()
    page: LivePage | None = None
    actions: dict[str, Callable[[], str]] = {
        "/stop": lambda: page.stop() if page is not None else "no run to stop",
        "/alive": lambda: "ended" if page is not None and page.ended else "alive",
    }
    overlay = resources.files("equipoise.apps.console").joinpath("overlay.html").read_bytes()
    with serving(address, port, actions=actions, overlay=overlay) as (server, url):
        page = LivePage(server)
        ready(url)
        while not stopped():
            watch = _next_run(owner)
            if watch is None:
                time.sleep(SEARCH_PERIOD)
                continue
            _show(page, watch, stopped)
            if owner is not None:
                time.sleep(LINGER)
                return


def _show(page: LivePage, watch: RunWatch, stopped: Callable[[], bool]) -> None:
    """Show a run until its end."""
    page.begin(watch)
    due = time.monotonic()
    try:
        while True:
            now = watch.observe()
            page.show(now)
            if now.ended or stopped():
                return
            due = max(due + PERIOD, time.monotonic())
            time.sleep(max(due - time.monotonic(), 0.0))
    finally:
        page.end()
        watch.close()


def _next_run(owner: int | None) -> RunWatch | None:
    """Attach to the newest run without a console; None without one."""
    for folder in live_runs():
        with contextlib.suppress(OSError, ValueError):
            if owner is None or read_info(folder).pid == owner:
                return RunWatch(folder)
    return None


def stay_aside() -> None:
    """Give way to a loop: other cores than its own, the last one, and a low priority."""
    if sys.platform == "linux":
        os.nice(NICE)
        allowed = sorted(os.sched_getaffinity(0))
        if len(allowed) > 1:
            os.sched_setaffinity(0, set(allowed[:-1]))


@contextmanager
def console_process(address: str = LOOPBACK, port: int = 0) -> Generator[str]:
    """Run a console for the runs of this process, in a process of its own.

    Yields:
        Address of the page, with its token.

    Raises:
        MissingExtraError: viser is not installed.
        InputError: The address is invalid.
        OutsideError: The console does not start.
    """
    require_viser()
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(
        target=_serve_child, args=(address, port, os.getpid(), theirs), daemon=True
    )
    process.start()
    theirs.close()
    try:
        yield _address(ours)
    finally:
        ours.close()  # the console ends by itself, once its browsers have seen the end
        process.join(2.0 * LINGER)
        if process.is_alive():
            process.kill()


def _address(pipe: Any) -> str:
    """Return the address of a console that starts; raise its error."""
    try:
        said = pipe.recv() if pipe.poll(START_TIMEOUT) else None
    except (EOFError, OSError):
        said = None
    if isinstance(said, EquipoiseError):
        raise said
    if said is None:
        raise OutsideError("the console has not started; try again, or leave --console out")
    return str(said)


def _serve_child(address: str, port: int, owner: int, pipe: Any) -> None:
    """Serve the console in a process of its own, until the run ends or its process does."""
    for name in ("SIGINT", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)  # they stop the run, seen here

    # viser prints; the terminal is the operator's.
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        try:
            serve(address, port, pipe.send, lambda: os.getppid() != owner or pipe.poll(), owner)
        except EquipoiseError as error:
            with contextlib.suppress(OSError):
                pipe.send(type(error)(str(error)))
