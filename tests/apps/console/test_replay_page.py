"""The page of a replay without a browser: buttons are pressed as viser would."""

import io
import threading
import time
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from equipoise.apps.console.film_export import FilmExport
from equipoise.apps.console.replayed_run import ReplayedRun
from equipoise.apps.report.pictures import video
from equipoise.apps.report.pictures.scene import stage
from tests.apps.report.conftest import canvas
from tests.logs.made_up import balanced_on_a_rig, changed_table, conditions

viser = pytest.importorskip("viser", reason="viser is not installed (extra console)")

__all__ = ["canvas"]


class Browser:
    """Stands for a browser that presses and downloads."""

    client_id = 1

    def __init__(self):
        self.files = []

    def press(self, handle, value=None):
        if value is not None:
            handle._impl.value = value
        event = SimpleNamespace(client=self, client_id=1, target=handle)
        for callback in handle._impl.update_cb:
            callback(event)

    def send_file_download(self, name, content, *, save_immediately):
        assert save_immediately
        self.files.append((name, content))


@pytest.fixture
def browser():
    return Browser()


@pytest.fixture(scope="module")
def run():
    run = balanced_on_a_rig()
    q = np.tile(run.conditions.arm.home, (901, 1))
    return changed_table(run, "tick", q=q)


@pytest.fixture
def page(run):
    """The page, playing in a thread of its own."""
    from equipoise.apps.console.replay_page import ReplayPage

    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    page = ReplayPage(server, run, ReplayedRun.of(run), "a run")
    ended = threading.Event()
    player = threading.Thread(target=page.play, args=(ended.is_set,))
    player.start()
    yield page
    ended.set()
    player.join(10.0)
    server.stop()
    assert not player.is_alive()


def wait_until(condition):
    end = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def buttons(page):
    handles = page._server.gui._gui_input_handle_from_uuid.values()
    return {handle.label: handle for handle in handles if hasattr(handle, "label")}


def test_play_moves_the_arm_the_slider_and_the_cursor_and_pause_ends_it(page, browser):
    before, place = page._view.pivot, page._cursor.content
    browser.press(page._speed, "4×")
    browser.press(page._button)
    wait_until(lambda: page._slider.value > 0.5)
    assert page._button.label == "Pause"
    browser.press(page._button)
    wait_until(lambda: page._button.label == "Play")
    still = page._slider.value
    assert np.linalg.norm(page._view.pivot - before) > 0.01
    assert page._cursor.content != place
    time.sleep(0.1)
    assert page._slider.value == still


def test_an_event_is_jumped_to_and_described(page, browser):
    labels = buttons(page)
    assert "+0.00 s  balancing" in labels
    browser.press(labels["+2.01 s  lasted"])
    wait_until(lambda: page._slider.value == 2.01)
    assert "lasted (a cause of the end)" in page._sentence.content
    assert "balancing" not in page._state.content


def test_the_keys_play_and_step(page):
    page.ask("forward")
    wait_until(lambda: page._slider.value == -1.99)
    page.ask("back")
    page.ask("back")
    wait_until(lambda: page._slider.value == -2.01)
    # The shown part grows with a step out of it.
    assert page._part.value[0] == -2.01
    page.ask("toggle")
    wait_until(lambda: page._slider.value > -1.9)


def test_the_handles_choose_what_is_plotted(page, browser):
    drawn = page._plots.content
    browser.press(page._part, (0.5, 1.5))
    wait_until(lambda: page._plots.content != drawn)
    wait_until(lambda: page._slider.value == 0.5)


def test_a_drag_pauses_there(page, browser):
    browser.press(page._button)
    browser.press(page._slider, 1.25)
    wait_until(lambda: page._button.label == "Play" and page._playback.time == 1.25)


def client(aspect, number=1):
    """A browser with a camera."""
    camera = SimpleNamespace(aspect=aspect, position=np.zeros(3))
    return SimpleNamespace(client_id=number, camera=camera, atomic=nullcontext)


def test_a_new_browser_has_the_view_of_the_pictures_and_it_fits_into_a_narrow_window(page, run):
    camera = stage(run.conditions.arm, (480, 480)).camera
    ahead, found = np.cross(camera.up, camera.right), {}
    for number, aspect in enumerate((2.0, 1.0, 0.5)):
        browser = client(aspect, number)
        page._view.keep_in_view(browser)
        offset = browser.camera.look_at - browser.camera.position
        found[aspect] = np.linalg.norm(offset)
        np.testing.assert_allclose(offset / found[aspect], ahead, atol=1e-9)
    assert found[2.0] == found[1.0] == pytest.approx(0.5 * found[0.5])


def test_a_window_that_changes_keeps_the_view_unless_it_was_turned(page):
    browser = client(1.0)
    page._view.look_from(browser, "front")
    near = browser.camera.position
    browser.camera.aspect = 0.5
    page._view.keep_in_view(browser)
    far = browser.camera.position
    assert np.linalg.norm(far - near) > 1.0
    browser.camera.position = far + np.array([0.1, 0.0, 0.0])
    browser.camera.aspect = 1.0
    page._view.keep_in_view(browser)
    assert browser.camera.position[0] == far[0] + 0.1


@pytest.mark.usefixtures("canvas")
def test_the_shown_part_becomes_a_film_for_the_browser_that_asks(page, browser):
    browser.press(page._kind, "animated WebP")
    browser.press(page._part, (0.5, 0.8))
    wait_until(lambda: page._playback.end == 0.8)
    browser.press(page._make)
    wait_until(lambda: page._download.visible)
    assert page._make.label.startswith("Make")
    browser.press(page._download)
    ((name, content),) = browser.files
    assert name == "a-run_0.50_to_0.80_s.webp"
    assert name in page._download.label
    with Image.open(io.BytesIO(content)) as film:
        assert (film.format, film.n_frames) == ("WEBP", 4)
        film.seek(2)
        film.load()
        assert film.info["duration"] == 80


def test_a_failure_of_the_film_is_told(page, browser, monkeypatch):
    monkeypatch.setattr(
        "equipoise.apps.report.pictures.rendering._backend", lambda: "equipoise.paper"
    )
    browser.press(page._kind, "animated WebP")
    browser.press(page._make)
    wait_until(lambda: page._note.visible and "cannot draw pictures" in page._note.content)
    assert not page._download.visible


def test_a_webp_that_is_too_long_is_refused(run, browser):
    from equipoise.apps.console.replay_page import ReplayPage

    long = changed_table(run, "tick", time=np.linspace(1.0, 91.0, 901))
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        page = ReplayPage(server, long, ReplayedRun.of(long), "long")
        page._kind._impl.value = "animated WebP"
        page._playback.show(-50.0, 25.0)
        page._begin_or_cancel()
        assert "too large, expected 30 s or less" in page._note.content
    finally:
        server.stop()


@pytest.mark.usefixtures("canvas")
def test_a_cancelled_film_ends_at_once(run):
    film = FilmExport(run, "a/../run", -6.0, 3.0, ".webp")
    assert film.name == "a-..-run_-6.00_to_3.00_s.webp"
    film.cancel()
    assert not film.running
    assert (film.content, film.error) == (None, "cancelled")


@pytest.mark.usefixtures("canvas")
def test_an_mp4_has_the_frames_of_its_part(run, monkeypatch, tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="the extra `video` is not installed")
    monkeypatch.setattr(video, "FRAME", (240, 176))
    film = FilmExport(run, "run", -0.5, 0.5, ".mp4")
    film._thread.join(60.0)
    assert film.error == ""
    assert film.share == 1.0
    path = tmp_path / film.name
    path.write_bytes(film.content)
    frames, seconds = ffmpeg.count_frames_and_secs(str(path))
    assert (frames, seconds) == (30, pytest.approx(1.0, abs=0.05))


def test_texts_of_the_log_do_not_become_markup(run):
    from dataclasses import replace

    from equipoise.apps.console.replay_page import ReplayPage

    evil = "<img src=x onerror=alert(1)>\x1b[2J"
    given = conditions(world="kst://" + evil).model_dump(include={"world"})
    run = replace(run, conditions=run.conditions.model_copy(update=given))
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        page = ReplayPage(server, run, ReplayedRun.of(run), evil)
        assert "<img" not in page._state.content
        assert "\x1b" not in page._state.content
        assert "&lt;img" in page._state.content
    finally:
        server.stop()
