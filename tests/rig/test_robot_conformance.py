"""Every robot of this package passes the suite that a guest's robot passes; no broken driver does.

Another robot adds a class that says how to make it.
"""

import re
import time
from math import nan
from types import SimpleNamespace

import numpy as np
import pytest

from equipoise.errors import LinkError
from equipoise.rig import clocks, plugins
from equipoise.rig.interfaces import checked_setpoint
from equipoise.robots.kst.robot import KstRobot
from equipoise.testing import RobotConformance, RobotUnderTest, emulated_robot, misreads
from tests.guest.guest import robot as guest
from tests.robots.kst.follower import Bench


class TestKst(RobotConformance):
    def make(self, **options):
        bench = Bench(**options)

        def plug(connected):
            bench.client.cut = bench.end.cut = not connected

        robot = KstRobot(lambda: bench.client, bench.clock)
        true_joints = lambda: np.array(bench.body.q)  # noqa: E731
        return RobotUnderTest(robot, bench.clock, plug, true_joints, misreads(bench.body))


class TestKstOverASlowLink(TestKst):
    def make(self):
        return super().make(delay=0.008)


class TestKstOnTheTwin(RobotConformance):
    def make(self):
        return emulated_robot("kst")


class TestGuest(RobotConformance):
    driver = guest.GuestRobot

    def make(self):
        with pytest.MonkeyPatch.context() as patch:  # the guest is not installed here
            known = plugins._registered
            entry = SimpleNamespace(name="guest", value="guest.robot", load=lambda: guest.PLUGIN)
            patch.setattr(plugins, "_registered", lambda *a: entry if "guest" in a else known(*a))
            patch.setattr(guest, "GuestRobot", self.driver)
            return emulated_robot("guest")


def changed(measured=lambda q: q, reply=None, setpoint=lambda q: q):
    """Return the guest's driver with other measured joints, replies or setpoints."""
    reply = reply or (lambda one: one._replace(q=tuple(measured(np.array(one.q)))))

    class Changed(guest.GuestRobot):
        def measured(self):
            return measured(super().measured())

        def request(self, until):
            request = super().request(until)
            return request and reply(request)

        def answer(self, q):
            super().answer(setpoint(np.array(q)))

    return Changed


def recovers(driver, why):
    raise LinkError(why)


def connects(driver):
    driver._link = driver._open()


def blocks(driver, until):
    driver._clock.wait_until(driver._clock.now() + 1.0)
    return guest.GuestRobot.request(driver, until)


class Commanded(guest.GuestRobot):
    """Replies with the joints that it was last sent."""

    last = None

    def answer(self, q):
        super().answer(q)
        self.last = tuple(q)

    def request(self, until):
        request = super().request(until)
        return request and request._replace(q=self.last or request.q)


class Relative(guest.GuestRobot):
    """Answers with the way from what a single reply said at the start."""

    def start(self):
        super().start()
        self.begin, self.first = np.array(self._measured), None

    def answer(self, q):
        self.first = q if self.first is None else self.first
        super().answer(self.begin + np.array(q) - self.first)


def pulls(driver, q):
    """Correct the setpoint by what a request says, where that is far away."""
    error = np.array(q) - driver._requests[0].q
    guest.GuestRobot.answer(driver, q + np.where(np.abs(error) > 0.05, error, 0.0))


def accepts(driver, q):
    driver._requests.popleft()


class Old(changed()):
    """Replies with the joints of 25 requests before: 100 ms."""

    def request(self, until):
        request = super().request(until)
        if request is None:
            return None
        self.past = [*getattr(self, "past", [request.q] * 25)[-25:], request.q]
        return request._replace(q=self.past[0])


def driver(**methods):
    return type("Broken", (guest.GuestRobot,), methods)


def flipped(q):
    return q[::-1]


BROKEN = {
    "recovers by itself": (driver(_fail=recovers), "the link has failed"),
    "joints of the past": (Old, "older than 20 ms"),
    "degrees": (changed(np.degrees), "in degrees"),
    "degrees both ways": (changed(np.degrees, setpoint=np.radians), "in degrees"),
    "wrong order": (changed(flipped), "in another order"),
    "wrong order both ways": (changed(flipped, setpoint=flipped), "in another order"),
    "NaN in a reply": (changed(reply=lambda one: one._replace(q=(nan,) * 7)), "measured nan rad"),
    "works after close": (driver(close=lambda self: None), "after close"),
    "loses a sign": (changed(np.abs), "of the wrong sign"),
    "commanded joints": (Commanded, "commanded instead"),
    "connects to nothing": (driver(connect=connects), "without its peer"),
    "blocks in receive": (driver(request=blocks), "the driver blocks"),
    "times stand still": (changed(reply=lambda one: one._replace(time=0.0)), "0 replies"),
    "no setpoint is sent": (driver(answer=accepts), "6 requests had no answer"),
    "a single reply at the start": (Relative, "wrong replies moved the arm"),
    "corrected by wrong joints": (driver(answer=pulls), "wrong replies moved the arm"),
    "one joint too few": (changed(lambda q: q[:6]), "7 joints"),
}
"""Broken drivers, and words of the message that names the fault."""


@pytest.mark.full
@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_driver_fails_with_a_message_that_names_its_fault(name):
    broken, words = BROKEN[name]
    assert words in complaint(type("Suite", (TestGuest,), {"driver": broken}))


def test_a_setpoint_that_waits_for_the_next_one_is_noticed(monkeypatch):
    send = KstRobot.send

    def held(robot, q):
        robot.held, q = checked_setpoint(q, 7), getattr(robot, "held", q)
        send(robot, q)

    monkeypatch.setattr(KstRobot, "send", held)
    assert re.match(r"joint \d is at .* rad, expected", complaint(TestKst))


def test_a_start_that_sends_back_what_a_single_reply_says_is_noticed(monkeypatch):
    start = KstRobot.start

    def sends_back(robot):
        robot.send(start(robot))

    monkeypatch.setattr(KstRobot, "start", sends_back)
    suite = TestKst()
    with pytest.raises(AssertionError, match=r"wrong replies moved the arm by 0\.1 rad"):
        suite.test_a_single_wrong_reply_at_the_start_does_not_move_the_arm()


def test_a_driver_that_sleeps_where_it_should_wait_is_told_so(monkeypatch):
    def sleeps(robot):
        while robot._measured is None:
            time.sleep(1e-3)
            robot._read()
        return robot._measured

    monkeypatch.setattr(clocks, "STALL", 0.5)
    suite = type("Suite", (TestGuest,), {"driver": driver(_wait_for_joints=sleeps)})
    said = complaint(suite)
    assert "connect has waited for 0.5 s" in said
    assert "test_robot_conformance.py, line" in said


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
