"""Every robot of this package passes the suite that a user's robot passes; no broken driver does.

Another robot adds a class that says how to make it.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from equipoise.errors import LinkError
from equipoise.rig import plugins
from equipoise.rig.interfaces import checked_setpoint
from equipoise.robots.kst.robot import KstRobot
from equipoise.testing import RobotConformance, RobotUnderTest, emulated_robot, misreads
from tests.guest.guest import robot as guest
from tests.robots.kst.follower import Bench


class TestKstOverASlowLink(RobotConformance):
    def make(self):
        bench = Bench(delay=0.008)

        def plug(connected):
            bench.client.cut = bench.end.cut = not connected

        robot = KstRobot(lambda: bench.client, plugins.Session(bench.clock, bench.clock))
        true_joints = lambda: np.array(bench.body.q)  # noqa: E731
        return RobotUnderTest(robot, bench.clock, plug, true_joints, misreads(bench.body))


class TestKstOnTheTwin(RobotConformance):
    def make(self):
        return emulated_robot("kst")


class TestGuest(RobotConformance):
    driver = guest.GuestRobot

    def make(self):
        with pytest.MonkeyPatch.context() as patch:  # the guest is not installed here
            known = plugins.registered
            entry = SimpleNamespace(load=lambda: guest.PLUGIN)
            patch.setattr(plugins, "registered", lambda group: known(group) | {"guest": entry})
            patch.setattr(guest, "GuestRobot", self.driver)
            return emulated_robot("guest")


def changed(measured=lambda q: q, setpoint=lambda q: q):
    """Return the user's driver with other measured joints or setpoints."""

    class Changed(guest.GuestRobot):
        def measured(self):
            return measured(super().measured())

        def replies(self):
            return [one._replace(q=tuple(measured(np.array(one.q)))) for one in super().replies()]

        def send(self, q):
            super().send(setpoint(checked_setpoint(q, self.joints)))

    return Changed


def recovers(driver, why):
    raise LinkError(why)


def connects(driver):
    driver._link = driver._open()


def blocks(driver):
    driver._clock.wait_until(driver._clock.now() + 1.0)
    return guest.GuestRobot.replies(driver)


def driver(**methods):
    return type("Broken", (guest.GuestRobot,), methods)


BROKEN = {
    "recovers by itself": (driver(_fail=recovers), "LinkError not raised"),
    "degrees both ways": (changed(np.degrees, setpoint=np.radians), "in degrees"),
    "works after close": (driver(close=lambda self: None), "send"),
    "loses a sign": (changed(np.abs), "of the wrong sign"),
    "connects to nothing": (driver(connect=connects), "LinkError not raised"),
    "blocks in receive": (driver(replies=blocks), "the driver blocks"),
    "no setpoint is sent": (driver(send=lambda self, q: None), "LinkError not raised"),
    "one joint too few": (changed(lambda q: q[:6]), "7 joints"),
}
"""Broken drivers, and words of the message that names the fault."""


@pytest.mark.full
@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_driver_fails_with_a_message_that_names_its_fault(name):
    broken, words = BROKEN[name]
    assert words in complaint(type("Suite", (TestGuest,), {"driver": broken}))


def complaint(suite):
    """Return the message of the first test of a suite that fails; empty if none does."""
    for name in (name for name in dir(suite) if name.startswith("test_")):
        test = suite()
        try:
            getattr(test, name)()
        except (AssertionError, LinkError) as error:
            return str(error)
        finally:
            test.teardown_method()
    return ""
