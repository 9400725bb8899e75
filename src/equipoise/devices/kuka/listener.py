"""An emulated KST server on a TCP port, in real time.

Like the real server it serves one client. The system accepts the connection of another, which gets
no reply. Unlike its client, the server does not turn Nagle's algorithm off.

The server ends with each client, as the real one does. The emulated operator restarts it on the
smartPAD: at once after an `end`, and some seconds after a client has vanished (until then the servo
continues, and no other client gets a reply). Without that operator, the word `start` restarts it.
"""

import socket
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Final

from equipoise.devices.interfaces import Clock
from equipoise.devices.kuka.server_emulator import Faults, KstServer
from equipoise.devices.plugins import ServerOptions
from equipoise.devices.transports import CHUNK
from equipoise.errors import InputError, OutsideError

PERIOD: Final = 0.001
"""Period of the service loop [s]."""
RESTART: Final = 1.0
"""Time that the emulated operator takes to start the server again [s]."""
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
    for part in text.split(","):
        name, _, number = part.strip().partition("=")
        if not part.strip():
            continue
        try:
            numbers[name] = float(number)
        except ValueError:
            numbers[name] = -1.0
        if name not in MAX_FAULTS or not 0.0 <= numbers[name] <= MAX_FAULTS[name]:
            known = ", ".join(f"{fault}=0 to {limit:g}" for fault, limit in MAX_FAULTS.items())
            raise InputError(f"--inject says {part.strip()!r}; expected any of {known}")
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
        self._restarted = False
        self._vanished: float | None = None
        self.acts: Mapping[str, Callable[[], object]] = {"start": self._restart}

    def run(
        self, host: str, port: int, stop: Callable[[], bool], listening: Callable[[int], None]
    ) -> None:
        """Serve one client after the other until stopped.

        Args:
            host: Address to listen on.
            port: Port to listen on; 0 lets the system choose one, which then stays.
            stop: Returns whether to stop; called each millisecond.
            listening: Receives the port, once a client can connect for the first time.

        Raises:
            OutsideError: The port is not available.
        """
        begun = False

        def opened(number: int) -> None:
            nonlocal begun, port
            if not begun:
                listening(number)
            begun, port = True, number

        options = self._options
        body, speeds = options.rig.body, [joint.velocity for joint in options.arm.joints]
        while not stop():
            server = KstServer(body, speeds, faults=self._faults, seed=options.seed)
            self._server, self._restarted, self._vanished = server, False, None
            serve(
                server,
                host,
                port,
                options.clock,
                self._work,
                lambda: stop() or self._restarted,
                listening=opened,
            )
            self._server = None
            body.servo(False)
            if not stop():
                self._wait_for_restart(stop)

    def _wait_for_restart(self, stop: Callable[[], bool]) -> None:
        """Advance the rig without a server until its restart."""
        options = self._options
        if not self._restarted:
            options.say("the server's application has ended")
        until = options.clock.now() + RESTART
        while not stop() and not self._restarted:
            if options.attended and options.clock.now() > until:
                break
            options.clock.wait_until(options.clock.now() + PERIOD)
            self._work(options.clock.now())
        if not stop():
            options.say("the server's application has been started on the smartPAD")

    def _restart(self) -> None:
        self._restarted = True

    def _work(self, now: float) -> None:
        """Advance all parts but the server, and detect a vanished client."""
        options = self._options
        options.work(now)
        if self._server is None or not self._server.deserted:
            return
        if self._vanished is None:
            self._vanished = now
            options.say("the client has vanished; its servo, if any, goes on")
        elif options.attended and now > self._vanished + NOTICED:
            self._restart()


def serve(
    server: KstServer,
    host: str,
    port: int,
    clock: Clock,
    work: Callable[[float], None],
    stop: Callable[[], bool],
    *,
    listening: Callable[[int], None] = lambda _: None,
) -> None:
    """Serve one client until it has sent `end` and the servo has ended, or until stopped.

    The arm moves with or without a client, and a servo runs on when its client vanishes.

    Args:
        server: The server.
        host: Address to listen on.
        port: Port to listen on; 0 lets the system choose one.
        clock: Clock of the machine.
        work: Advances the arm to a time [s]; called each millisecond, before the server.
        stop: Returns whether to stop; called each millisecond.
        listening: Receives the port, once clients can connect.

    Raises:
        OutsideError: The port is not available.
    """
    client: socket.socket | None = None
    try:
        listener = socket.create_server((host, port))
    except OSError as error:
        raise OutsideError(
            f"cannot listen on {host}, port {port} ({error}); stop what uses it, or choose another"
        ) from None
    try:
        listener.setblocking(False)
        listening(listener.getsockname()[1])
        served, moment = False, clock.now()
        while not stop() and not (server.closed and not server.busy):
            moment = max(moment + PERIOD, clock.now() - 10.0 * PERIOD)
            clock.wait_until(moment)
            now = clock.now()
            work(now)
            if not served:
                with suppress(BlockingIOError):
                    client, _ = listener.accept()
                    client.setblocking(False)
                    served = True
            if client is not None and not _exchange(client, server, now):
                client.close()
                client = None
                if not server.closed:
                    server.vanished(now)
            elif client is None:
                server.advance(now)
    finally:
        if client is not None:
            client.close()
        listener.close()


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
