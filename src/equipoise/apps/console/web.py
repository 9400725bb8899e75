"""Web server of a page with a 3-D scene: viser behind a gate, for browsers of this computer.

viser's own sharing is off, and nothing is printed or logged: the terminal belongs to the operator,
and whoever reaches the port chooses the words of a request.
"""

import atexit
import ipaddress
import logging
import os
import socket
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, redirect_stdout
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from equipoise.apps.console.gate import Gate
from equipoise.errors import InputError, MissingExtraError, OutsideError

if TYPE_CHECKING:
    import viser

LOOPBACK: Final = "127.0.0.1"
"""Address that only browsers on this computer reach."""
EVERYWHERE: Final = ("0.0.0.0", "::")
"""Addresses that stand for all addresses of this computer."""


def require_viser() -> Any:
    """Return the module `viser`.

    Raises:
        MissingExtraError: viser is not installed.
    """
    try:
        return import_module("viser")
    except ImportError:
        raise MissingExtraError("viser", "console") from None


@contextmanager
def serving(
    address: str = LOOPBACK,
    port: int = 0,
    *,
    actions: Mapping[str, Callable[[], str]] | None = None,
    overlay: bytes = b"",
) -> "Generator[tuple[viser.ViserServer, str]]":
    """Serve a viser scene; every request needs the token of the page's address.

    Args:
        address: Address of this computer to listen on.
        port: Port; 0 selects a free one.
        actions: Functions by their addresses, as of `Gate`.
        overlay: HTML at the end of the page.

    Yields:
        The viser server, and the address of the page with its token.

    Raises:
        MissingExtraError: viser is not installed.
        InputError: The address is invalid.
        OutsideError: The port is not available.
    """
    viser = require_viser()
    port = _check(address, port)
    shown = f"[{address}]" if ":" in address else address
    shown = socket.gethostname() if address in EVERYWHERE else shown
    gate = Gate(shown, actions, overlay, any_address=address in EVERYWHERE)

    class Server(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> str | None:
            """Share nothing, whoever asks."""
            return None

    with _guarding(gate), open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
        server: Any = Server(address, port, verbose=False)
    atexit.unregister(server._websock_server.stop)  # it prints; `finally` stops the server
    try:
        yield server, f"http://{shown}:{server.get_port()}/?token={gate.token}"
    finally:
        with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
            server.stop()


@contextmanager
def _guarding(gate: Gate) -> Generator[None]:
    """Put a gate in front of the viser server that starts in this context.

    Raises:
        OutsideError: This version of viser starts its server in another way.
    """
    server: Any = import_module("websockets.asyncio.server")
    original, guarded = server.serve, list[bool]()
    silent = logging.getLogger(f"{__name__}.requests")
    silent.disabled = True

    def serve(*arguments: Any, process_request: Any, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            return gate.check(request, lambda passed: process_request(connection, passed))

        guarded.append(True)
        return original(*arguments, process_request=check, logger=silent, **options)

    server.serve = serve
    try:
        yield
    finally:
        server.serve = original
    if not guarded:
        raise OutsideError(
            "Equipoise cannot guard this version of viser with its token; install another one "
            "(1.1 was tested)"
        )


def _check(address: str, port: int) -> int:
    """Return a free port of an address; viser would try others without end.

    Raises:
        InputError: The address is invalid.
        OutsideError: The port is not available.
    """
    try:
        family = socket.AF_INET6 if ipaddress.ip_address(address).version == 6 else socket.AF_INET
    except ValueError:
        raise InputError(
            f"{address!r} is not an IP address of this computer, such as {LOOPBACK}, 0.0.0.0 for "
            "all of them, or one from `ip address`"
        ) from None
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except OSError as error:
            raise OutsideError(
                f"cannot listen on {address}, port {port}: {error.strerror}; choose another"
            ) from None
        return int(probe.getsockname()[1])
