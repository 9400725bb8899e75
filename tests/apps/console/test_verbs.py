"""`--console` beside programs without a loop, and `equipoise console`, over HTTP."""

from http.cookiejar import CookieJar
from urllib.request import HTTPCookieProcessor, Request, build_opener

import pytest

from tests.apps.console.browser import program, wait_until

pytestmark = pytest.mark.compiled_only


def page_of(started):
    """What the console answers to paths, with the cookie of its address."""
    address = started.find(r"(http://127\.0\.0\.1:\d+/\?token=\S+)")[1]
    opener = build_opener(HTTPCookieProcessor(CookieJar()))
    assert b"equipoise-stop" in opener.open(address, timeout=10.0).read()

    def ask(path):
        request = Request(address.partition("/?")[0] + path, headers={"X-Equipoise": "1"})
        return opener.open(request, timeout=10.0).read().decode()

    return ask


def test_a_console_without_a_run_waits_until_it_is_ended():
    with program("console") as console:
        ask = page_of(console)
        assert ask("/alive") == "alive"
        assert console.end() == 0


@pytest.mark.parametrize(("address", "code"), [("nowhere", 2), ("203.0.113.7", 3)])
def test_an_address_that_cannot_be_used_is_one_error(address, code):
    with program("console", "--listen", address) as console:
        assert console.process.wait(60.0) == code
        assert address in " ".join(console.lines)
        assert not any("Traceback" in line for line in console.lines)


@pytest.mark.slow
def test_the_stop_of_an_emulated_rig_is_its_emergency_stop():
    with program("rig", "emulate", "--port", "0", "--console") as rig:
        ask = page_of(rig)
        rig.find("robot +kst://")
        wait_until(lambda: ask("/stop") == "stop sent", "rig in the console")
        rig.find("console: estop")
        assert rig.end() == 0
