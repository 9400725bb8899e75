"""The playground without a browser: its rig, its scenes, and its page."""

from math import degrees, radians
from types import SimpleNamespace

import numpy as np
import pytest
import viser

from equipoise.console.play import FALL, SCENES, Playground, PlayPage
from equipoise.control.bound_policy import bind_policy, load_policy


def played(playground, seconds):
    for _ in range(round(seconds / playground.h)):
        playground.advance()
    return playground


def test_it_stands_and_a_push_moves_it():
    playground, undisturbed = Playground(SCENES["balance"]), Playground(SCENES["balance"])
    assert not played(playground, 10.0).fallen
    played(undisturbed, 10.0)
    playground.loop.push(radians(15.0))
    rates = [played(each, 0.01) and each.loop.state()[3] for each in (playground, undisturbed)]
    assert rates[0] - rates[1] == pytest.approx(radians(15.0), rel=0.1)
    assert not played(playground, 5.0).fallen
    playground.loop.push(radians(200.0))
    assert played(playground, 1.0).fallen


def test_a_delay_without_prediction_falls_and_with_it_stands():
    playground = Playground(SCENES["why-it-falls"])
    while not playground.fallen:
        playground.advance()
        assert playground._tick * playground.h < 20.0
    assert abs(degrees(played(playground, 1.0).phi)) > 20.0  # the fall is shown
    playground.set(SCENES["why-it-falls"]._replace(predict=True))
    assert not played(playground, 30.0).fallen


def test_a_pendulum_that_was_tipped_over_is_swung_up_again():
    playground = Playground(SCENES["balance"])
    played(playground, 1.0).loop.push(radians(200.0))
    assert "It fell after 1." in played(playground, 1.0).sentences()[2]
    played(playground, FALL)
    assert (playground.loop.balancing, playground.fallen, playground.box) == (False, "", -1)
    assert abs(playground.loop.state()[0]) < 0.05
    assert "has been swinging it up for" in playground.sentences()[2]
    assert played(playground, 10.0).loop.balancing
    assert "It has been up for" in playground.sentences()[2]


def test_a_pendulum_that_does_not_come_up_has_failed_and_hangs_at_the_start_of_a_swing_up():
    playground = Playground(SCENES["balance"], load_policy("random"))
    playground.set(SCENES["balance"]._replace(policy="yours"))
    playground.begin(hanging=True)
    assert abs(degrees(played(playground, 0.01).phi)) > 179.0
    assert "ended after 15.0 s (not upright)" in played(playground, 15.2).sentences()[2]


def test_without_a_kernel_a_policy_is_released_again():
    playground = Playground(SCENES["balance"], bind_policy(lambda _: 2.0))
    playground.set(SCENES["balance"]._replace(policy="yours"))
    assert playground.swing_up is None
    assert played(playground, 1.0).fallen
    played(playground, FALL - 0.5)
    while playground.fallen:
        playground.advance()
    assert abs(degrees(playground.phi)) < 4.0


def test_the_box_in_use_is_known_for_a_table_alone():
    playground = Playground(SCENES["balance"])
    played(playground, 3.0)
    assert playground.box >= 0
    playground.set(SCENES["lqr"])
    assert played(playground, 1.0).box == -1


def test_the_page_pushes_and_changes_the_rig(monkeypatch):
    server, pushes = viser.ViserServer("127.0.0.1", 0, verbose=False), []
    page = PlayPage(server, SCENES["balance"])
    page.advance(0)
    assert "balancing" in page._page._state.content
    assert "shipped table" in page._page._state.content
    table = page._boxes.content
    assert table.count("<rect") == 270
    assert table.count('stroke-width="3"') == 1
    for label in ("angle φ [°]", ">−5<", ">50<", "x −0.08 to 0.08 m", "ẋ 0.5 to ∞ m/s"):
        assert label in table
    page._controls["delay_ms"].value = 25.0
    page._controls["policy"].value = "LQR"
    page._changed()
    assert page.playground.scene.delay_ms == 25.0
    page.advance(0)
    assert "shipped table" not in page._page._state.content
    assert "after 43 ms: 25 ms transport + 18 ms servo" in page._page._state.content
    assert not page._table.visible
    page.playground.begin(hanging=True)
    page.advance(0)
    assert "swinging up" in page._page._state.content
    monkeypatch.setattr(page.playground.loop, "push", pushes.append)
    for drawn in (0.05, -1.0):  # [m]
        event = {"start_position": (0.1, 0.0, 0.9), "end_position": (0.1 + drawn, 0.0, 0.9)}
        page._dragged(SimpleNamespace(phase="end", **event))
    assert np.degrees(pushes) == pytest.approx([6.0, -60.0])
    server.stop()
