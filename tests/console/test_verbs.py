"""`equipoise console` over HTTP."""

from http.cookiejar import CookieJar
from urllib.request import HTTPCookieProcessor, Request, build_opener

import pytest

from tests.program import program


def test_a_console_without_a_run_waits_until_it_is_ended():
    with program("console") as console:
        address = console.find(r"(http://127\.0\.0\.1:\d+/\?token=\S+)")[1]
        opener = build_opener(HTTPCookieProcessor(CookieJar()))
        assert b"equipoise-stop" in opener.open(address, timeout=10.0).read()
        alive = Request(address.partition("/?")[0] + "/alive", headers={"X-Equipoise": "1"})
        assert opener.open(alive, timeout=10.0).read() == b"alive"
        assert console.end() == 0


@pytest.mark.full
@pytest.mark.parametrize("address", ["no where", "203.0.113.7"])
def test_an_address_that_cannot_be_used_is_one_error(address):
    with program("console", "--listen", address) as console:
        assert console.process.wait(60.0) == 3
        assert address in " ".join(console.lines)
        assert not any("Traceback" in line for line in console.lines)
