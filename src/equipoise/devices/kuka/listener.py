"""An emulated KST server on a TCP port, in real time.

`equipoise rig emulate` calls `serve` with the body's own progress as `work`::

    server = KstServer(body, speeds)
    serve(server, "127.0.0.1", 30001, SystemClock(), body.advance_until, stop.is_set)

As with the real server there is one client. Another can connect, since the system accepts it, but
it is never answered. Unlike its client the server does not switch Nagle's algorithm off.
"""

import socket
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from equipoise.devices.interfaces import Clock
from equipoise.devices.kuka.server_emulator import KstServer
from equipoise.devices.transports import CHUNK
from equipoise.errors import OutsideError

PERIOD: Final = 0.001
"""Time between two looks at client and arm [s]."""


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
    """Serve one client until it has said goodbye and the servo has ended, or until stopped.

    The arm goes on whether there is a client or not, as does a servo whose client has vanished.

    Args:
        server: What answers.
        host: Address to listen on.
        port: Port to listen on; 0 lets the system choose one.
        clock: Whose time passes.
        work: Lets the arm pass until a time [s]; called each millisecond, before the server.
        stop: Says when to stop; asked each millisecond.
        listening: Takes the port, once clients can connect.

    Raises:
        OutsideError: The port cannot be had.
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
    """Pass bytes both ways, and return whether the connection lives on."""
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
