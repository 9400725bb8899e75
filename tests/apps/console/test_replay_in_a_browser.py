"""`equipoise log show` in a real browser, and over HTTP."""

import io
import json
from http.cookiejar import CookieJar
from urllib.error import HTTPError
from urllib.request import HTTPCookieProcessor, Request, build_opener

import numpy as np
import pytest
from PIL import Image

from tests.apps.console.browser import (
    browser,
    needs_browser,
    press,
    program,
    requests,
    shown,
    wait_until,
)
from tests.apps.report.conftest import canvas
from tests.logs.made_up import balanced_on_a_rig, changed_table

__all__ = ["canvas"]


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    run = balanced_on_a_rig()
    q = np.tile(run.conditions.arm.home, (901, 1))
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    changed_table(run, "tick", q=q).save(path, command="test")
    return path


def test_the_page_is_behind_its_token_and_ends_with_the_verb(log):
    with program("log", "show", str(log), "--json") as replay:
        address = json.loads(replay.find(r"\{.*\}")[0])["replay"]
        assert address.startswith("http://127.0.0.1:")
        base = address.partition("/?")[0]
        opener = build_opener(HTTPCookieProcessor(CookieJar()))
        for wrong in (base, f"{base}/?token=wrong", f"{base}/toggle"):
            with pytest.raises(HTTPError, match="403"):
                opener.open(wrong, timeout=10.0)
        assert b'"/toggle"' in opener.open(address, timeout=10.0).read()
        with pytest.raises(HTTPError, match="403"):
            opener.open(f"{base}/toggle", timeout=10.0)
        key = Request(f"{base}/toggle", headers={"X-Equipoise": "1"})
        assert opener.open(key, timeout=10.0).status == 200
        assert replay.end() == 0


def time_of(page):
    """The position in the card of the state [s]."""
    (text,) = shown(page, "#equipoise-state") or ("t = nan s",)
    return float(text.replace("−", "-").partition("t = ")[2].partition(" s")[0])


def open_tab(page, label):
    (tab,) = page.find_elements("xpath", f"//*[@role='tab'][contains(., '{label}')]")
    tab.click()


@needs_browser
@pytest.mark.slow
@pytest.mark.usefixtures("canvas")
def test_a_run_is_played_searched_and_filmed_in_the_browser(log, tmp_path):
    from selenium.webdriver import ActionChains

    with program("log", "show", str(log), "--json") as replay, browser() as page:
        address = json.loads(replay.find(r"\{.*\}")[0])["replay"]
        folder = {"behavior": "allow", "downloadPath": str(tmp_path)}
        page.execute_cdp_cmd("Browser.setDownloadBehavior", folder)
        page.get(address)
        wait_until(lambda: shown(page, "#equipoise-state"), "replay")
        assert time_of(page) == -2.0
        press(page, "Play")
        wait_until(lambda: time_of(page) > -1.5, "motion")
        wait_until(lambda: time_of(page) == 3.0, "end of the run")
        wait_until(lambda: "Play" in shown(page, "button"), "pause at the end")
        # The keys step and play.
        press(page, "start")
        wait_until(lambda: time_of(page) == -2.0, "start")
        ActionChains(page).send_keys(".").perform()
        wait_until(lambda: time_of(page) == -1.99, "step of a tick")
        ActionChains(page).send_keys(" ").perform()
        wait_until(lambda: time_of(page) > -1.8, "motion after the space bar")
        # Events.
        open_tab(page, "Events")
        press(page, "+2.01 s")
        wait_until(lambda: abs(time_of(page) - 2.01) < 0.01, "jump")
        # A film.
        open_tab(page, "Film")
        press(page, "Make a film")
        press(page, "Download")
        films = wait_until(lambda: [*tmp_path.glob("run_*_s.*[4p]")], "download")
        assert films[0].stat().st_size > 10_000
        check_film(films[0])
        assert {each.split("/")[2] for each in requests(page) if each.startswith("http")} == {
            address.split("/")[2]
        }
        assert replay.end() == 0


def check_film(path):
    """The film shows the part that was shown: five seconds."""
    if path.suffix == ".webp":
        with Image.open(io.BytesIO(path.read_bytes())) as film:
            assert film.n_frames == pytest.approx(62, abs=1)
        return
    import imageio_ffmpeg

    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert (frames, seconds) == (150, pytest.approx(5.0, abs=0.1))
