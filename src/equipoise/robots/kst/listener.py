"""An emulated KST server on a TCP port, in real time.

Like the real server it serves one client. The system accepts the connection of another, which gets
no reply. Unlike its client, the server does not turn Nagle's algorithm off.

The server ends with each client, as the real one does. The emulated operator restarts it on the
smartPAD: at once after an `end`, and some seconds after a client has vanished (until then the servo
continues, and no other client gets a reply). Without that operator, the word `start` restarts it.
"""

import socket
import threading
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import replace
from math import inf
from typing import Final

from equipoise.errors import InputError, OutsideError
from equipoise.rig.interfaces import Clock
from equipoise.rig.plugins import ServerOptions, ignore
from equipoise.rig.transports import CHUNK
from equipoise.robots.kst.server_emulator import Faults, KstServer

PERIOD: Final = 0.001
"""Period of the service loop [s]."""
RESTART: Final = 1.0
"""Time in which the emulated operator restarts the server [s]."""
NOTICED: Final = 10.0
"""Time after which the emulated operator notices a vanished client [s]."""
MAX_FAULTS: Final = {"delay": 10.0, "jitter": 10.0, "drop": 1.0, "refuse": 1.0}
"""Largest values of the faults that a user may inject: times [s] and shares [-]."""


def parse_faults(text: str) -> Faults:
    """Return the faults that a text such as `delay=0.002,drop=0.01` names.

    Raises:
        InputError: A fault is unknown, or its number is invalid or too large.
    """
    numbers: dict[str, float] = {}
    for part in filter(None, map(str.strip, text.split(","))):
        name, _, number = part.partition("=")
        numbers[name] = -1.0
        with suppress(ValueError):
            numbers[name] = float(number)
        if name not in MAX_FAULTS or not 0.0 <= numbers[name] <= MAX_FAULTS[name]:
            known = ", ".join(f"{fault}=0 to {limit:g}" for fault, limit in MAX_FAULTS.items())
            raise InputError(f"--inject says {part!r}; expected any of {known}")
    return replace(Faults(), **numbers)


class KstListener:
    """A KST server that serves one client after the other; a `RobotServer`."""

    def __init__(self, options: ServerOptions) -> None:
        """Create the listener; no client can connect before `run`.

        Raises:
            InputError: The faults are unknown or too large.
        """
        self._options, self._faults = options, parse_faults(options.faults)
        self._server: KstServer | None = None
        self._restart = threading.Event()
        self._vanished: float | None = None
        self.acts = {"start": self._restart.set}

    def run(
        self, host: str, port: int, stop: Callable[[], bool], listening: Callable[[int], None]
    ) -> None:
        """Serve one client after the other until stopped.

        Args:
            host: Address to listen on.
            port: Port to listen on; for 0 the system chooses one, which then stays.
            stop: Returns whether to stop; called each millisecond.
            listening: Receives the port, once a client can connect for the first time.

        Raises:
            OutsideError: The port is not available.
        """

        def opened(number: int) -> None:
            nonlocal port, listening
            listening(number)
            port, listening = number, ignore

        def halt() -> bool:
            return stop() or self._restart.is_set()

        options = self._options
        body, speeds = options.rig.body, [joint.velocity for joint in options.arm.joints]
        while not stop():
            server = KstServer(body, speeds, faults=self._faults, seed=options.seed)
            self._server, self._vanished = server, None
            self._restart.clear()
            serve(server, (host, port), options.clock, self._work, halt, opened)
            self._server = None
            body.servo(False)
            if not stop():
                self._wait_for_restart(stop)

    def _wait_for_restart(self, stop: Callable[[], bool]) -> None:
        """Advance the rig without a server until its restart."""
        options = self._options
        if not self._restart.is_set():
            options.say("the server's application has ended")
        until = options.clock.now() + (RESTART if options.attended else inf)
        while not stop() and not self._restart.is_set() and options.clock.now() <= until:
            options.clock.wait_until(options.clock.now() + PERIOD)
            self._work(options.clock.now())
        if not stop():
            options.say("the server's application has been started on the smartPAD")

    def _work(self, now: float) -> None:
        """Advance all parts but the server, and detect a vanished client."""
        options = self._options
        options.work(now)
        if self._server is None or not self._server.deserted:
            return
        if self._vanished is None:
            self._vanished = now
            options.say("the client has vanished; a running servo continues")
        elif options.attended and now > self._vanished + NOTICED:
            self._restart.set()


def serve(
    server: KstServer,
    address: tuple[str, int],
    clock: Clock,
    work: Callable[[float], None],
    stop: Callable[[], bool],
    listening: Callable[[int], None] = ignore,
) -> None:
    """Serve one client until it has sent `end` and the servo has ended, or until stopped.

    The arm moves with or without a client, and a servo runs on when its client vanishes.

    Args:
        server: The server.
        address: Host and port to listen on; the system chooses a port for 0.
        clock: Clock of the machine.
        work: Advances the arm to a time [s]; called each millisecond, before the server.
        stop: Returns whether to stop; called each millisecond.
        listening: Receives the port, once clients can connect.

    Raises:
        OutsideError: The port is not available.
    """
    try:
        listener = socket.create_server(address)
    except OSError as error:
        where = "{}, port {}".format(*address)
        raise OutsideError(
            f"cannot listen on {where} ({error}); stop what uses it, or choose another"
        ) from None
    client: socket.socket | None = None
    with ExitStack() as sockets:
        sockets.enter_context(listener).setblocking(False)
        listening(listener.getsockname()[1])
        served, moment = False, clock.now()
        while not stop() and not (server.closed and not server.busy):
            moment = max(moment + PERIOD, clock.now() - 10.0 * PERIOD)
            clock.wait_until(moment)
            now = clock.now()
            work(now)
            if not served:
                with suppress(BlockingIOError):
                    client = sockets.enter_context(listener.accept()[0])
                    client.setblocking(False)
                    served = True
            if client is None:
                server.advance(now)
            elif not _exchange(client, server, now):
                client.close()
                client = None
                if not server.closed:
                    server.vanished(now)


def _exchange(client: socket.socket, server: KstServer, now: float) -> bool:
    """Pass bytes both ways, and return whether the connection stays open."""
    try:
        with suppress(BlockingIOError):
            data = client.recv(CHUNK)
            if not data:
                server.advance(now)
                return False
            server.feed(data, now)
        for segment in server.advance(now):
            client.send(segment)
    except OSError:
        return False
    return not server.closed
