"""The playground in a real browser."""

import threading
from math import degrees

import numpy as np
import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys

from equipoise.apps.console.play import PlayPage, run
from equipoise.apps.console.scenes import SCENES
from equipoise.apps.console.web import serving
from tests.apps.console.browser import browser, needs_browser, press, requests, shown, wait_until

pytestmark = [needs_browser, pytest.mark.compiled_only]


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


def said(tab):
    return "".join(shown(tab, "#equipoise-state"))


def type_into(tab, label, text):
    """Type a number beside the slider with a label."""
    field = tab.execute_script(
        "let e = [...document.querySelectorAll('body *')].find("
        "e => !e.children.length && e.checkVisibility() && e.innerText === arguments[0]);"
        "while (!e.querySelector('input[type=text]')) e = e.parentElement;"
        "return e.querySelector('input[type=text]')",
        label,
    )
    field.send_keys(Keys.CONTROL, "a")
    field.send_keys(text, Keys.ENTER)


def close_note(tab):
    """Close viser's note that the browser draws without a graphics card; it covers the arm."""
    return tab.execute_script(
        "const b = document.querySelector('.mantine-Notification-closeButton'); b?.click();"
        "return !!b"
    )


@pytest.mark.slow
def test_push_and_slider(played):
    page, address = played
    with browser() as tab:
        tab.get(address)
        wait_until(lambda: "standing" in said(tab), "playground")
        press(tab, "push right")
        wait_until(lambda: "Pushed to the right by 15" in said(tab), "push")
        type_into(tab, "delay [ms]", "45")
        wait_until(lambda: page.playground.scene.delay == pytest.approx(0.045), "delay")
        origin = address.partition("?")[0]
        assert all(url.startswith((origin, "data:", "blob:")) for url in requests(tab))


@pytest.mark.slow
def test_the_mouse_pushes_and_a_table_is_trained(played):
    page, address = played
    with browser(900, 600) as tab:
        tab.get(address)
        wait_until(lambda: "standing" in said(tab), "playground")
        wait_until(lambda: close_note(tab), "note of the browser without a graphics card")
        canvas = tab.find_element("css selector", "canvas")
        (client,) = page._server.get_clients().values()

        def place():
            """The middle of the pendulum in the canvas, from its middle [px]."""
            camera, size = client.camera, canvas.size
            rod = page._panel.view.pivot + np.array([0.0, 0.0, 0.12]) - camera.position
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
            return "Pushed to the" in said(tab)

        wait_until(dragged, "push by the mouse")
        assert 0.0 < abs(degrees(page.playground.pushed)) <= 60.0
        press(tab, "Train")
        wait_until(lambda: "episodes" in "".join(shown(tab, "#equipoise-training")), "training")
        assert not page.playground.policies.get("trained")
        wait_until(lambda: "trained" in page.playground.policies, "trained table", 300.0)
        assert page.playground.scene.policy == "trained"
        assert page.playground.policies["trained"].episodes > 100
