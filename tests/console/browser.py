"""A real browser for the tests of the pages."""

import contextlib
import os
import re
import shutil

import pytest

from tests.program import LONGEST, wait_until

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")

needs_browser = pytest.mark.skipif(
    not (CHROMIUM and DRIVER), reason="Chromium and its driver are not installed"
)


DRAW_SELDOM = """{
const draw = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = (act) => setTimeout(() => draw(act), 150);
window.cancelAnimationFrame = clearTimeout;
}"""


def _aside():
    os.nice(15)
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


@contextlib.contextmanager
def browser(width=640, height=480):
    """Chromium without a screen, on the first core: a loop stays on the last one.

    It draws without a graphics card, a picture of a large window takes seconds: it draws seldom, to
    have time for the rest.
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
    page.set_script_timeout(LONGEST)
    page.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": DRAW_SELDOM})
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


def press(page, label):
    """Press a button as soon as it can be pressed."""
    script = (
        "const b = [...document.querySelectorAll('button')].find(e => e.checkVisibility() && "
        "!e.disabled && e.innerText.trim().startsWith(arguments[0])); b?.click(); return !!b"
    )
    wait_until(lambda: page.execute_script(script, label), f"a button {label!r}")


def requests(page):
    """The addresses of all requests of the page since the last call."""
    found = []
    for entry in page.get_log("performance"):
        if '"Network.requestWillBeSent"' in entry["message"]:
            found += re.findall(r'"request":\{.*?"url":"([^"]*)"', entry["message"])
    return found
