"""What the console's server lets in, without a browser."""

import http.client
import re
import socket
from urllib.parse import urlsplit

import pytest

from equipoise.console.web import Gate, serving


@pytest.fixture(scope="module")
def served():
    called = []
    actions = {"/act": lambda: called.append(True) or "done"}
    with serving(actions=actions, overlay=b"<i>over</i>") as (_, address):
        yield urlsplit(address), called


def ask(served, path, **headers):
    address = served[0]
    connection = http.client.HTTPConnection(address.hostname, address.port, timeout=5.0)
    connection.request("GET", path, headers={k.replace("_", "-"): v for k, v in headers.items()})
    answer = connection.getresponse()
    return answer.status, dict(answer.getheaders()), answer.read()


@pytest.fixture(scope="module")
def cookie(served):
    status, headers, _ = ask(served, f"/?{served[0].query}")
    assert (status, headers["Location"]) == (303, "/")
    assert {"HttpOnly", "SameSite=Strict"} <= set(headers["Set-Cookie"].split("; "))
    return headers["Set-Cookie"].split(";")[0]


WEBSOCKET = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec_WebSocket_Version": "13",
    "Sec_WebSocket_Protocol": "viser-v1.1.1",
}


@pytest.mark.parametrize("path", ["/", "/act", "/?token=", "/?token=wrong"])
@pytest.mark.parametrize(
    "headers", [{}, {"Cookie": "equipoise=1"}, {"X_Equipoise": "1"}, WEBSOCKET]
)
def test_nothing_is_served_without_the_token(served, path, headers):
    assert ask(served, path, **headers)[0] == 403
    assert not served[1]


def test_the_page_may_ask_no_other_server(served, cookie):
    status, headers, page = ask(served, "/", Cookie=cookie)
    assert status == 200
    assert b"<i>over</i></body>" in page
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert not re.search(r"https?:|\*", policy)


@pytest.mark.parametrize(
    ("line", "status"),
    [
        (b"GET /\x1b]0;owned\x07 HTTP/1.1", 403),
        (b"GET //[ HTTP/1.1", 400),
        (b"GET /?token=\xff HTTP/1.1", 400),
        (b"GET / HTTP/1.1\r\nHost: 127.0.0.1", 400),  # twice
        (b"GET / HTTP/9\x1b[2J", None),
        (b"\x1b]0;owned\x07\xff", None),
        (b"GET / HTTP/1.1\r\n\x1b[2J: x", None),
    ],
)
def test_no_request_writes_to_the_terminal(served, caplog, capfd, line, status):
    where = (served[0].hostname, served[0].port)
    with socket.create_connection(where, timeout=5.0) as connection:
        connection.sendall(line + b"\r\nHost: 127.0.0.1\r\n\r\n")
        answer = http.client.HTTPResponse(connection)
        if status is not None:
            answer.begin()
            assert answer.status == status
        while connection.recv(4096):
            pass
    assert not caplog.records
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("host", ["{}.evil.org", "evil.org", "0.0.0.0", ""])
def test_a_page_under_a_foreign_name_is_refused(served, cookie, host):
    port = served[0].port
    for name in (host, f"{host}:{port}"):
        given = {"Cookie": cookie, "Host": name.format(served[0].hostname)}
        assert ask(served, "/", **given)[0] == 403
        assert ask(served, f"/?{served[0].query}", Host=given["Host"])[0] == 403
    for name in ("localhost", f"LOCALHOST:{port + 1}"):  # a tunnel has its own port
        assert ask(served, "/", Cookie=cookie, Host=name)[0] == 200


def test_a_server_on_all_addresses_is_open_to_each_of_them():
    gate = Gate("Rig", {}, b"", any_address=True)
    own = ["rig", "RIG:8080", "192.168.1.7:80", "[fe80::1]:80", "localhost"]
    assert [host for host in [*own, "rig.evil.org", "evil.org", ""] if gate.is_own(host)] == own


def test_an_action_needs_a_script_of_the_page(served, cookie):
    assert ask(served, "/act", Cookie=cookie)[0] == 403
    assert not served[1]
    assert ask(served, "/act", Cookie=cookie, X_Equipoise="1")[2] == b"done"
    assert served[1] == [True]


def test_a_websocket_of_another_page_is_refused(served, cookie):
    host = served[0].netloc
    for origin in ("http://elsewhere.org", f"http://{host}.elsewhere.org", "null"):
        assert ask(served, "/", Cookie=cookie, Origin=origin, **WEBSOCKET)[0] == 403
    assert ask(served, "/", Cookie=cookie, Origin=f"http://{host}", **WEBSOCKET)[0] == 101
