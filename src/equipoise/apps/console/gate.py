"""Gate in front of viser's server: a token for each request, and a short way for urgent words.

viser serves page and websocket on one port, through `websockets.asyncio.server.serve`. The gate
wraps the function that this server calls with each request, before it accepts a websocket:

* The header `Host` names this server: a page of another server whose name leads here, by DNS
  rebinding, is refused.
* The address with the token, `/?token=...`, gives a cookie and leads to the page.
* Each other request needs the cookie, and a websocket also the origin of this server.
* The address of an action, such as `/stop`, calls a function at once, past viser's queues and
  threads.
* The content policy of the page forbids requests to any other server.
"""

import hmac
import ipaddress
import re
import secrets
from collections.abc import Callable, Mapping
from contextlib import suppress
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from importlib import import_module
from typing import Any, Final
from urllib.parse import parse_qs, urlsplit

TOKEN_BYTES: Final = 24
"""Length of a token [B]."""
OWN_HEADER: Final = "X-Equipoise"
"""Header that only a script of the page can send."""
CONTENT_POLICY: Final = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self' data: blob:; worker-src 'self' blob:; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)
"""Sources that the page may use: its own server. viser's page has its scripts inside."""
HEADERS: Final = {
    "Content-Security-Policy": CONTENT_POLICY,
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
"""Headers of all responses."""
HOST: Final = re.compile(r"(?:\[([\da-f:.]+)\]|([\w.-]+))(?::\d+)?", re.ASCII | re.IGNORECASE)
"""Form of a header `Host`: an IPv6 address in brackets or a name, and a port."""
REFUSED: Final = "Open this page with its whole address, token included, as the terminal shows it."


class Gate:
    """Check of all requests to one server."""

    def __init__(
        self,
        host: str,
        actions: Mapping[str, Callable[[], str]] | None = None,
        overlay: bytes = b"",
        *,
        any_address: bool = False,
    ) -> None:
        """Create a gate with a new token.

        Args:
            host: Name or address of the server, as in the address of the page.
            actions: Functions by their addresses, such as `/stop`, for scripts of the page. They
                are called in the server's thread, do not block, and return a text for the script.
            overlay: HTML at the end of the page.
            any_address: Whether the server listens on all addresses of this computer.
        """
        self._hosts, self._any_address = {"localhost", _host_name(host)}, any_address
        self.token = secrets.token_urlsafe(TOKEN_BYTES)
        """Token of the address."""
        self._cookie = f"equipoise-{secrets.token_hex(4)}"  # cookies ignore the port
        self._actions = dict(actions or {})
        self._overlay = overlay

    def check(self, request: Any, serve: Callable[[Any], Any]) -> Any:
        """Return the response to a request; None accepts a websocket.

        Args:
            request: Request of the package websockets.
            serve: Returns viser's own response.
        """
        try:
            return self._response(request, serve)
        except (ValueError, LookupError):  # an invalid address, or a header given twice
            return _respond(HTTPStatus.BAD_REQUEST, "This is not a valid request.")

    def _response(self, request: Any, serve: Callable[[Any], Any]) -> Any:
        if not self._is_own(request.headers["Host"]):
            return _respond(HTTPStatus.FORBIDDEN, REFUSED)
        address = urlsplit(request.path)
        given = parse_qs(address.query).get("token", [])
        if given and not _is_websocket(request):
            if not self._is_token(given[0]):
                return _respond(HTTPStatus.FORBIDDEN, REFUSED)
            cookie = f"{self._cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"
            return _respond(HTTPStatus.SEE_OTHER, "", {"Location": "/", "Set-Cookie": cookie})
        if not self._has_cookie(request):
            return _respond(HTTPStatus.FORBIDDEN, REFUSED)
        if _is_websocket(request):
            origin = urlsplit(request.headers.get("Origin", "")).netloc
            if not origin or origin != request.headers.get("Host", ""):
                return _respond(HTTPStatus.FORBIDDEN, "This websocket is for the page.")
            return serve(request)
        if (action := self._actions.get(address.path)) is not None:
            if OWN_HEADER not in request.headers:
                return _respond(HTTPStatus.FORBIDDEN, "This is for scripts of the page.")
            return _respond(HTTPStatus.OK, action())
        if address.path in ("/", "/index.html"):
            return self._serve_page(request, serve)
        return _with_headers(serve(request))

    def _is_own(self, host: str) -> bool:
        """Return whether a header `Host` names this server; tunnels may change the port."""
        name = _host_name(host)
        with suppress(ValueError):
            return name in self._hosts or (self._any_address and bool(ipaddress.ip_address(name)))
        return False

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(), self.token.encode())

    def _has_cookie(self, request: Any) -> bool:
        with suppress(CookieError):
            for header in request.headers.get_all("Cookie"):
                cookie = SimpleCookie(header).get(self._cookie)
                if cookie is not None and self._is_token(cookie.value):
                    return True
        return False

    def _serve_page(self, request: Any, serve: Callable[[Any], Any]) -> Any:
        """Return viser's page with the overlay."""
        with suppress(KeyError):
            del request.headers["Accept-Encoding"]  # viser then sends plain text
        response = serve(request)
        response.body = response.body.replace(b"</body>", self._overlay + b"</body>")
        del response.headers["Content-Length"]
        response.headers["Content-Length"] = str(len(response.body))
        return _with_headers(response)


def _host_name(host: str) -> str:
    """Return the name or address in a header `Host`, without its port; empty if it is invalid."""
    found = HOST.fullmatch(host)
    return (found[1] or found[2]).lower() if found else ""


def _is_websocket(request: Any) -> bool:
    return bool(request.headers.get_all("Upgrade"))


def _respond(status: HTTPStatus, text: str, headers: dict[str, str] | None = None) -> Any:
    http = import_module("websockets.http11")
    structures = import_module("websockets.datastructures")
    body = text.encode()
    own = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))}
    response = http.Response(
        status.value, status.phrase, structures.Headers(own | (headers or {})), body
    )
    return _with_headers(response)


def _with_headers(response: Any) -> Any:
    for name, value in HEADERS.items():
        response.headers[name] = value
    return response
