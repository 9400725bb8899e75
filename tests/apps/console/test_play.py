"""The playground in a real browser."""

import threading

import numpy as np
import pytest
from selenium.webdriver.common.action_chains import ActionChains

from equipoise.apps.console.play import PlayPage, run
from equipoise.apps.console.playground import SCENES
from equipoise.apps.console.web import serving
from tests.apps.console.browser import browser, needs_browser, press, requests, shown, wait_until

pytestmark = [needs_browser, pytest.mark.compiled_only, pytest.mark.slow]


@pytest.fixture
def played():
    """The page of a playground that runs in a thread, and its address."""
    ended = threading.Event()
    with serving() as (server, address):
        page = PlayPage(server, SCENES["balance"])
        thread = threading.Thread(target=run, args=(page, ended.is_set))
        thread.start()
        try:
            yield page, address
        finally:
            ended.set()
            thread.join(10.0)


def close_note(tab):
    """Close viser's note that the browser draws without a graphics card; it covers the arm."""
    return tab.execute_script(
        "const b = document.querySelector('.mantine-Notification-closeButton'); b?.click();"
        "return !!b"
    )


def test_a_button_and_the_mouse_push_the_pendulum(played, monkeypatch):
    page, address = played
    pushes = []
    monkeypatch.setattr(page.playground, "push", pushes.append)
    with browser(900, 600) as tab:
        tab.get(address)
        wait_until(lambda: "standing" in "".join(shown(tab, "#equipoise-state")), "playground")
        press(tab, "push right")
        wait_until(lambda: pushes, "push")
        assert pushes.pop() == pytest.approx(np.radians(15.0))
        wait_until(lambda: close_note(tab), "note of the browser without a graphics card")
        canvas = tab.find_element("css selector", "canvas")
        (client,) = page._server.get_clients().values()

        def place():
            """The middle of the pendulum in the canvas, from its middle [px]."""
            camera, size = client.camera, canvas.size
            rod = page._page.pendulum.position + np.array([0.0, 0.0, 0.12]) - camera.position
            ahead = camera.look_at - camera.position
            ahead /= np.linalg.norm(ahead)
            right = np.cross(ahead, camera.up_direction)
            right /= np.linalg.norm(right)
            scale = 0.5 * size["height"] / np.tan(0.5 * camera.fov) / (rod @ ahead)
            return round(scale * (rod @ right)), -round(scale * (rod @ np.cross(right, ahead)))

        def dragged():
            x, y = place()
            move = ActionChains(tab).move_to_element_with_offset(canvas, x, y).click_and_hold()
            move.move_by_offset(12, 0).move_by_offset(12, 0).pause(0.3).release().perform()
            return pushes

        wait_until(dragged, "push by the mouse")
        assert 0.0 < abs(pushes[0]) <= np.radians(60.0)
        origin = address.partition("?")[0]
        assert all(url.startswith((origin, "data:", "blob:")) for url in requests(tab))
