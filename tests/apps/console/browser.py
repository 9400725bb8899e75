"""A real browser, and programs of Equipoise beside it, for the tests of the pages."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time

import pytest

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
LONGEST = 90.0  # a first start compiles [s]

needs_browser = pytest.mark.skipif(
    not (CHROMIUM and DRIVER), reason="Chromium and its driver are not installed"
)
pytest.importorskip("viser", reason="viser is not installed (extra console)")


def _aside():
    os.nice(15)
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


@contextlib.contextmanager
def browser(width=640, height=480):
    """Chromium without a screen, on the first core: a loop stays on the last one.

    It draws without a graphics card: a larger window takes seconds for a picture.
    """
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for argument in (
        *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage"),
        *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
        f"--window-size={width},{height}",
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL"})
    service = webdriver.ChromeService(DRIVER, popen_kw={"preexec_fn": _aside})
    page = webdriver.Chrome(options, service)
    try:
        yield page
    finally:
        page.quit()


def shown(page, css):
    """The texts of the visible elements."""
    return page.execute_script(
        "return [...document.querySelectorAll(arguments[0])].filter(e => e.checkVisibility())"
        ".map(e => e.innerText.trim())",
        css,
    )


def press_now(page, label):
    """Press a button, if there is one that can be pressed; return whether there is."""
    return page.execute_script(
        "const b = [...document.querySelectorAll('button')].find(e => e.checkVisibility() && "
        "!e.disabled && e.innerText.trim().startsWith(arguments[0])); b?.click(); return !!b",
        label,
    )


def press(page, label):
    """Press a button as soon as it can be pressed."""
    wait_until(lambda: press_now(page, label), f"a button {label!r}")


def wait_until(condition, what, limit=LONGEST):
    """Wait until a condition holds, and return its value."""
    end = time.monotonic() + limit
    while not (value := condition()):
        assert time.monotonic() < end, f"no {what} within {limit:g} s"
        time.sleep(0.05)
    return value


def requests(page):
    """The addresses of all requests of the page since the last call."""
    found = []
    for entry in page.get_log("performance"):
        if '"Network.requestWillBeSent"' in entry["message"]:
            found += re.findall(r'"request":\{.*?"url":"([^"]*)"', entry["message"])
    return found


class Program:
    """A program of Equipoise, and the lines that it prints."""

    def __init__(self, *words):
        self.process = subprocess.Popen(
            [sys.executable, "-u", "-m", "equipoise", *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | {"COLUMNS": "400"},
        )
        self.lines = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.process.stdout:
            self.lines.append(line.rstrip())

    def find(self, pattern, limit=LONGEST):
        """Wait for a line with a pattern, and return the match."""

        def found():
            matches = (re.search(pattern, line) for line in list(self.lines))
            match = next(filter(None, matches), None)
            assert match or self.process.poll() is None, "\n".join(self.lines)
            return match

        return wait_until(found, f"line with {pattern}", limit)

    def end(self):
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(20.0)


@contextlib.contextmanager
def program(*words):
    started = Program(*words)
    try:
        yield started
    finally:
        started.process.terminate()
        try:
            started.process.wait(10.0)
        except subprocess.TimeoutExpired:
            started.process.kill()
        started.process.stdin.close()
