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
import io
import logging
import re
import secrets
import socket
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, redirect_stdout
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
        is_websocket, is_own = bool(headers.get_all("Upgrade")), self.is_own(headers["Host"])
        (token,) = parse_qs(address.query).get("token", [""])
        if is_own and not is_websocket and _equal(token, self.token):
            response = connection.respond(HTTPStatus.SEE_OTHER, "")
            cookie = f"{self._cookie}; Path=/; HttpOnly; SameSite=Strict"
            response.headers.update({"Location": "/", "Set-Cookie": cookie})
            return response
        cookies = [part.strip() for text in headers.get_all("Cookie") for part in text.split(";")]
        allowed = is_own and any(_equal(cookie, self._cookie) for cookie in cookies)
        action = None if is_websocket else self._actions.get(address.path)
        if is_websocket:
            allowed &= urlsplit(headers.get("Origin", "")).netloc == headers["Host"]
        elif action is not None:
            allowed &= "X-Equipoise" in headers  # only a script of the page can send it
        if not allowed:
            advice = "Open the page with the whole address that the terminal shows, token included."
            return connection.respond(HTTPStatus.FORBIDDEN, advice)
        if action is not None:
            return connection.respond(HTTPStatus.OK, action())
        if is_websocket or address.path not in ("/", "/index.html"):
            return serve(connection, request)
        headers.pop("Accept-Encoding", None)  # viser then sends plain text
        response = serve(connection, request)
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
    import_optional("viser", "console")
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
    with redirect_stdout(io.StringIO()):
        server = _guarded(gate, address, port)
    try:
        yield server, f"http://{host}:{server.get_port()}/?token={gate.token}"
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


def _guarded(gate: Gate, address: str, port: int) -> Any:
    """Start a viser server behind a gate.

    Raises:
        OutsideError: This version of viser starts its server in another way.
    """
    import viser

    class Server(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> str | None:
            """Share nothing, whoever asks."""
            return None

    websockets: Any = import_module("websockets.asyncio.server")
    original, guarded = websockets.serve, list[bool]()
    silent = logging.getLogger(f"{__name__}.requests")
    silent.disabled = True

    def serve(*arguments: Any, process_request: Any, **options: Any) -> Any:
        guarded.append(True)
        check = partial(gate.check, serve=process_request)
        return original(*arguments, process_request=check, logger=silent, **options)

    websockets.serve = serve
    try:
        server = Server(address, port, verbose=False)
    finally:
        websockets.serve = original
    if not guarded:
        raise OutsideError(
            "this version of viser cannot be guarded with a token; install version 1.1"
        )
    return server
