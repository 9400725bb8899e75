"""The rig in a viser scene and the panel beside it, without a browser."""

import re

import numpy as np
import pytest
import viser
from viser.transforms import SO3

from equipoise.arm.iiwa import iiwa7, iiwa14
from equipoise.console.scene import RigPage, messages_list


@pytest.fixture
def server():
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield server
    server.stop()


def page_of(server, arm):
    page = RigPage(server, "test")
    page.show_arm(arm)
    return page


def places_of(page):
    moving = [mesh for mesh in page._bodies.values() if mesh is not page.pendulum]
    return np.array([[*mesh.position, *mesh.wxyz] for mesh in moving])


def unknown_in(page):
    return re.findall(r">(\w) = —<", page._readings.content)


@pytest.mark.parametrize("make", [iiwa7, iiwa14])
def test_the_pivot_is_where_the_kinematics_of_the_arm_have_it(server, make):
    arm = make()
    page = page_of(server, arm)
    q = np.array(arm.home) + np.array([0.1, -0.2, 0.0, 0.15, 0.1, -0.1, 0.3])
    x = page.show(q, 0.1)
    pose, home = arm.kinematics(arm.without_held(q)), arm.kinematics(arm.home_free)
    expected = pose.position + pose.rotation @ np.array(arm.pivot)
    assert page.pendulum.position == pytest.approx(expected, abs=1e-9)
    at_home = home.position + home.rotation @ np.array(arm.pivot)
    assert x == pytest.approx(expected[0] - at_home[0], abs=1e-9)
    page.show(arm.home, 0.1)
    lean = SO3(np.array(page.pendulum.wxyz)).as_matrix()[:, 2]
    assert lean == pytest.approx([np.sin(0.1), 0.0, np.cos(0.1)], abs=1e-9)


@pytest.mark.parametrize("q", [None, np.full(7, np.nan)])
def test_unknown_arm_and_pendulum_are_drawn_nowhere_and_stay_unnumbered(server, q):
    page = page_of(server, iiwa7())
    drawn = lambda: {n for n, mesh in page._bodies.items() if mesh.visible}  # noqa: E731
    assert drawn() == {0}  # the table
    assert unknown_in(page) == ["φ", "x"]
    page.show(np.array(iiwa7().home) + 0.05, 0.3, 1.0)
    assert drawn() == set(page._bodies)
    assert unknown_in(page) == []
    before = places_of(page)
    assert np.isnan(page.show(q, 0.3, 1.0))
    assert places_of(page) == pytest.approx(before)  # where it was last
    assert (page.pendulum.visible, page._arrow.visible) == (False, False)
    assert unknown_in(page) == ["x"]
    page.show(iiwa7().home, np.nan)
    assert not page.pendulum.visible
    assert unknown_in(page) == ["φ"]


def test_texts_of_devices_and_plugins_are_escaped(server):
    bad, page = "<img src=x onerror=alert(1)>\x1b[2J", page_of(server, iiwa7())
    page.describe(bad, "#000", [bad])
    for html in (page._state.content, messages_list([(bad, "#000")])):
        assert "<img" not in html
        assert "\x1b" not in html
