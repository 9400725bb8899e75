"""Web server of a page with a 3-D scene: viser behind a gate, for browsers of this computer.

viser serves page and websocket on one port, through `websockets.asyncio.server.serve`. The gate
wraps the function that this server calls with each request, before it accepts a websocket:

* The header `Host` names this server: a page of another server whose name leads here, by DNS
  rebinding, is refused.
* The address with the token, `/?token=...`, gives a cookie and leads to the page.
* Each other request needs the cookie, and a websocket also the origin of this server.
* The address of an action, such as `/stop`, calls a function at once, past viser's queues and
  threads.
* The content policy of the page forbids requests to any other server.

viser's own sharing is off, and nothing is printed or logged: the terminal belongs to the operator,
and whoever reaches the port chooses the words of a request.
"""

import hmac
import logging
import os
import re
import secrets
import socket
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from functools import partial
from http import HTTPStatus
from importlib import import_module, resources
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import parse_qs, urlsplit

from equipoise.errors import OutsideError, import_optional

if TYPE_CHECKING:
    import viser

LOOPBACK: Final = "127.0.0.1"
"""Address that only browsers on this computer reach."""
HEADERS: Final = {
    # Sources that the page may use: its own server. viser's page has its scripts inside.
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; "
        "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
        "connect-src 'self' data: blob:; worker-src 'self' blob:; base-uri 'none'; "
        "form-action 'none'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
"""Headers of all responses."""

Actions = Mapping[str, Callable[[], str]]
"""Functions by their addresses, such as `/stop`, for scripts of the page. They are called in the
server's thread, do not block, and return a text for the script."""


class Gate:
    """Check of all requests to one server."""

    def __init__(
        self, host: str, actions: Actions, overlay: bytes, *, any_address: bool = False
    ) -> None:
        """Create a gate with a new token.

        Args:
            host: Name or address of the server, as in the address of the page.
            actions: Functions for scripts of the page.
            overlay: HTML at the end of the page.
            any_address: Whether the server listens on all addresses of this computer.
        """
        self._hosts, self._any_address = {"localhost", host.strip("[]").lower()}, any_address
        self.token = secrets.token_urlsafe(24)
        """Token of the address."""
        # Cookies ignore the port: the name is that of this server.
        self._cookie = f"equipoise-{secrets.token_hex(4)}={self.token}"
        self._actions, self._overlay = actions, overlay

    def check(self, connection: Any, request: Any, serve: Callable[[Any, Any], Any]) -> Any:
        """Return the response to a request; None accepts a websocket.

        Args:
            connection: Connection of the package websockets.
            request: Its request.
            serve: Returns viser's own response.
        """
        try:
            response = self._response(connection, request, serve)
        except (ValueError, LookupError):  # an invalid address, or a header given twice
            response = connection.respond(HTTPStatus.BAD_REQUEST, "This is not a valid request.")
        if response is not None:
            response.headers.update(HEADERS)
        return response

    def is_own(self, host: str) -> bool:
        """Return whether a header `Host` names this server; tunnels may change the port."""
        name = urlsplit(f"//{host}").hostname or ""
        is_address = ":" in name or name.replace(".", "").isdigit()
        return name in self._hosts or (self._any_address and is_address)

    def _response(self, connection: Any, request: Any, serve: Callable[[Any, Any], Any]) -> Any:
        headers, address = request.headers, urlsplit(request.path)
        is_websocket = bool(headers.get_all("Upgrade"))
        cookies = [part.strip() for text in headers.get_all("Cookie") for part in text.split(";")]
        has_cookie = any(_equal(cookie, self._cookie) for cookie in cookies)
        tokens = parse_qs(address.query).get("token", [])
        is_own = self.is_own(headers["Host"])
        if is_own and tokens and not is_websocket:
            if _equal(tokens[0], self.token):
                response = connection.respond(HTTPStatus.SEE_OTHER, "")
                cookie = f"{self._cookie}; Path=/; HttpOnly; SameSite=Strict"
                response.headers.update({"Location": "/", "Set-Cookie": cookie})
                return response
        elif is_own and has_cookie:
            if is_websocket:
                origin = urlsplit(headers.get("Origin", "")).netloc
                if origin == headers["Host"]:
                    return serve(connection, request)
            elif (action := self._actions.get(address.path)) is not None:
                if "X-Equipoise" in headers:  # only a script of the page can send it
                    return connection.respond(HTTPStatus.OK, action())
            elif address.path in ("/", "/index.html"):
                with suppress(KeyError):
                    del headers["Accept-Encoding"]  # viser then sends plain text
                return self._with_overlay(serve(connection, request))
            else:
                return serve(connection, request)
        advice = "Open this page with its whole address, token included, as the terminal shows it."
        return connection.respond(HTTPStatus.FORBIDDEN, advice)

    def _with_overlay(self, response: Any) -> Any:
        """Return viser's page with the overlay."""
        body = re.sub(rb"<title>.*?</title>", b"<title>Equipoise</title>", response.body, count=1)
        body = re.sub(rb'<link\s+rel="icon".*?/>', b"", body, count=1, flags=re.DOTALL)
        own = resources.files("equipoise.console").joinpath("page.html").read_bytes()
        response.body = body.replace(b"</body>", own + self._overlay + b"</body>")
        del response.headers["Content-Length"]
        response.headers["Content-Length"] = str(len(response.body))
        return response


def _equal(text: str, secret: str) -> bool:
    return hmac.compare_digest(text.encode(), secret.encode())


@contextmanager
def serving(
    address: str = LOOPBACK, port: int = 0, *, actions: Actions | None = None, overlay: bytes = b""
) -> "Generator[tuple[viser.ViserServer, str]]":
    """Serve a viser scene; every request needs the token of the page's address.

    Args:
        address: Address of this computer to listen on.
        port: Port; 0 selects a free one.
        actions: Functions for scripts of the page.
        overlay: HTML at the end of the page.

    Yields:
        The viser server, and the address of the page with its token.

    Raises:
        MissingExtraError: viser is not installed.
        OutsideError: The address or the port is not available.
    """
    viser = import_optional("viser", "console")
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    try:  # viser would try other ports without end
        with socket.create_server((address, port), family=family) as probe:
            port = int(probe.getsockname()[1])
    except OSError as error:
        raise OutsideError(
            f"cannot listen on {address}, port {port}: {error.strerror}; give an address of this "
            f"computer, such as {LOOPBACK}, or 0.0.0.0 for all of them, and a free port"
        ) from None
    everywhere = address in ("0.0.0.0", "::")
    host = socket.gethostname() if everywhere else f"[{address}]" if ":" in address else address
    gate = Gate(host, actions or {}, overlay, any_address=everywhere)

    class Server(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> str | None:
            """Share nothing, whoever asks."""
            return None

    with _guarding(gate), open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
        server: Any = Server(address, port, verbose=False)
    try:
        yield server, f"http://{host}:{server.get_port()}/?token={gate.token}"
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
        guarded.append(True)
        check = partial(gate.check, serve=process_request)
        return original(*arguments, process_request=check, logger=silent, **options)

    server.serve = serve
    try:
        yield
    finally:
        server.serve = original
    if not guarded:
        raise OutsideError(
            "this version of viser cannot be guarded with a token; install version 1.1"
        )
