"""Process of the console: it finds runs on this computer, and shows one after the other.

The process belongs to nobody's loop. It stays off the processor core on which a run's loop stays.
"""

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from importlib import resources
from typing import Any, Final

from equipoise.apps.console.live import LivePage
from equipoise.apps.console.watch import RunWatch
from equipoise.apps.console.web import LOOPBACK, require_viser, serving
from equipoise.errors import EquipoiseError, OutsideError
from equipoise.logs.shared import live_runs, read_info

PERIOD: Final = 0.04
"""Time between two pictures, and between two searches for a run [s]."""
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
        OutsideError: The address or the port is not available.
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
                time.sleep(PERIOD)
                continue
            _show(page, watch, stopped)
            if owner is not None:
                time.sleep(LINGER)
                return


def _show(page: LivePage, watch: RunWatch, stopped: Callable[[], bool]) -> None:
    """Show a run until its end."""
    page.begin(watch)
    try:
        while True:
            now = watch.observe()
            page.show(now)
            if now.ended or stopped():
                return
            time.sleep(PERIOD)
    finally:
        page.end()
        watch.close()


def _next_run(owner: int | None) -> RunWatch | None:
    """Attach to the newest run without a console; None without one."""
    for folder in live_runs():
        with suppress(OSError, ValueError):
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
def console_process() -> Generator[str]:
    """Run a console for the runs of this process, in a process of its own.

    Yields:
        Address of the page, with its token.

    Raises:
        MissingExtraError: viser is not installed.
        OutsideError: The console does not start.
    """
    require_viser()
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve_child, args=(os.getpid(), theirs), daemon=True)
    process.start()
    theirs.close()
    said: Any = None
    try:
        with suppress(EOFError, OSError):
            said = ours.recv() if ours.poll(60.0) else None  # [s]: a slow disk
        if not isinstance(said, str):
            cause = said or "it does not answer; try again, or leave --console out"
            raise OutsideError(f"the console has not started: {cause}")
        yield said
    finally:
        ours.close()  # the console ends by itself, once its browsers have seen the end
        process.join(2.0 * LINGER)
        if process.is_alive():
            process.kill()


def _serve_child(owner: int, pipe: Any) -> None:
    """Serve the console in a process of its own, until the run ends or its process does."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # they stop the run, seen here

    # viser prints; the terminal is the operator's.
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        try:
            serve(LOOPBACK, 0, pipe.send, lambda: os.getppid() != owner or pipe.poll(), owner)
        except EquipoiseError as error:
            with suppress(OSError):
                pipe.send(OutsideError(str(error)))
