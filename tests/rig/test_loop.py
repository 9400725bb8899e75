"""The loop in virtual time, around a heart, a sensor and a robot that do as each test says."""

from types import SimpleNamespace

import numpy as np
import pytest

from equipoise.arm.iiwa import iiwa
from equipoise.control.ticks import OperatorMessage, TickOutput, TickRecord
from equipoise.errors import LinkError
from equipoise.log.recorder import Recorder
from equipoise.outcomes import Outcome, describe
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.guarded import GuardedRobot
from equipoise.rig.interfaces import Reply, Sample
from equipoise.rig.loop import CANNOT_STOP, run_loop
from equipoise.safety.rules import limits_of

ARM = iiwa(7)
HOME = ARM.home
H = 0.01


class Held(VirtualClock):
    """A clock whose waits take too long: by `held_up[n]` seconds, the n-th of them."""

    def __init__(self, held_up=None):
        super().__init__()
        self.waits, self.held_up = 0, held_up or {}

    def wait_until(self, moment):
        self.waits += 1
        super().wait_until(max(moment, self.now()) + self.held_up.get(self.waits, 0.0))


class Arm:
    """A robot that answers each setpoint; its link breaks at a call of `send` or of `replies`."""

    joints = 7

    def __init__(self, clock, breaks=None, q=HOME):
        self.clock, self.breaks, self.q = clock, breaks or {}, q
        self.calls = {"send": 0, "replies": 0}
        self.times, self.sent, self.waiting = [], [], []

    def _call(self, name):
        self.calls[name] += 1
        if self.calls[name] == self.breaks.get(name):
            raise LinkError(f"{name} failed")

    def measured(self):
        return np.array(self.q)

    def start(self):
        return self.measured()

    def send(self, q):
        self._call("send")
        now = self.clock.now()
        self.times.append(now)
        self.sent.append(tuple(q))
        self.waiting.append(Reply(now, now, tuple(q), None))

    def replies(self):
        self._call("replies")
        waiting, self.waiting = self.waiting, []
        return waiting


class Heart:
    """Moves A7 back and forth, or as it is given; keeps what it is told."""

    h = H

    def __init__(self, ticks, each=None):
        self.ticks, self.each = ticks, each or {}
        self.seen = []

    def at(self, n):
        """Where it wants the arm at half a tick: at rest, then gently to and fro."""
        return (*HOME[:6], HOME[6] + 0.05 * (1.0 - np.cos(4.0 * 0.5 * H * n)))

    def tick(self, now, inputs):
        n = len(self.seen)
        self.seen.append((now, inputs))
        setpoints, done = (self.at(2 * n), self.at(2 * n + 1)), n + 1 == self.ticks
        output = TickOutput(setpoints, HOME, (0.0,) * 7, 3, TickRecord(), (), done=done)
        return self.each.get(n, lambda output: output)(output)


class Course:
    def __init__(self, heart, *, held_up=None, breaks=None):
        self.clock, self.told = Held(held_up), []
        self.arm, self.heart = Arm(self.clock, breaks), heart
        self.person = SimpleNamespace(notify=self.told.append, read_input=list)
        self.robot = GuardedRobot(self.arm, limits_of(ARM), H / 2.0)
        self.recorder = Recorder(7)
        self.robot.start()
        self.more = {}

    def run(self):
        sample = lambda: [Sample(self.clock.now(), 100, False, False, 0)]  # noqa: E731
        parts = self.clock, self.heart, self.recorder, self.person
        return run_loop(self.robot, SimpleNamespace(samples=sample), *parts, **self.more)


def came_to_rest(sent, since):
    """From a setpoint on each step is smaller, down to what one step of a ramp ends with."""
    steps = np.abs(np.diff(sent, axis=0)).max(axis=1)[since - 1 :]
    return len(steps) > 1 and steps[-1] <= 10.0 * (H / 2.0) ** 2 and (np.diff(steps) < 1e-12).all()


def raising(error):
    def change(output):
        raise error

    return change


def test_each_tick_reads_decides_and_sends_two_setpoints_half_a_tick_apart():
    course = Course(Heart(20))
    fault, stoppable = course.run()
    assert (fault, stoppable) == (None, True)
    assert [now for now, _ in course.heart.seen] == pytest.approx(H * np.arange(1, 21))
    assert course.arm.times[:40] == pytest.approx(H * (1.0 + 0.5 * np.arange(40)))
    assert course.arm.sent[:40] == [course.heart.at(n) for n in range(40)]
    # What came since the tick before goes in: a sample, and two replies.
    assert all(len(inputs.samples) == 1 for _, inputs in course.heart.seen)
    assert [len(inputs.replies) for _, inputs in course.heart.seen] == [0] + 19 * [2]


@pytest.mark.parametrize(
    ("late", "found", "missed"),
    [(0.004, 0.004, 0), (0.009, 0.010, 1), (0.012, 0.012, 1), (0.060, 0.060, 6)],
)
def test_a_late_tick_says_so_and_those_that_were_missed_are_left_out(late, found, missed):
    # Two waits a tick: the ninth is for the fifth tick.
    course = Course(Heart(10), held_up={9: late})
    course.run()
    lateness = [inputs.lateness for _, inputs in course.heart.seen]
    assert lateness[:5] == pytest.approx([0.0] * 4 + [found], abs=1e-12)
    # Skipped, not made up for: the next one is at the next deadline of the old rhythm.
    times = [now for now, _ in course.heart.seen]
    assert times[5] == pytest.approx(H * (6 + missed))
    assert np.diff(times[5:]) == pytest.approx(H)


@pytest.mark.parametrize(("late", "unsent"), [(0.005, 0), (0.006, 1), (0.012, 1), (0.060, 1)])
def test_a_setpoint_that_is_later_than_the_next_one_is_not_sent(late, unsent):
    course = Course(Heart(10), held_up={10: late})
    course.run()
    assert [inputs.unsent for _, inputs in course.heart.seen] == [0] * 5 + [unsent] + [0] * 4
    assert len(course.arm.sent) == 20 - unsent


@pytest.mark.parametrize(("call", "number"), [("send", 7), ("send", 8), ("replies", 4)])
def test_where_the_link_to_the_robot_is_gone_the_operator_is_told_so_and_nothing_is_sent(
    call, number
):
    course = Course(Heart(20), breaks={call: number})
    fault, stoppable = course.run()
    assert not stoppable
    assert fault.evidence == {"text": f"{call} failed"}
    assert course.told == [OperatorMessage("fault", f"{call} failed; {CANNOT_STOP}")]
    # In the very tick: the fourth begins at 0.04 s.
    assert course.clock.now() <= 0.045 + 1e-9
    assert course.arm.calls["send"] == (number if call == "send" else 6)
    assert course.recorder.pulse["ticks"] == 0.0


@pytest.mark.parametrize("error", [ZeroDivisionError, SystemExit])
def test_a_heart_that_fails_leaves_the_arm_to_come_to_rest(error):
    course = Course(Heart(20, {9: raising(error("by zero"))}))
    fault, stoppable = course.run()
    assert fault.outcome is Outcome.FAULT
    assert stoppable
    assert course.told == [OperatorMessage("fault", describe(fault))]
    assert len(course.arm.sent) > 18
    assert came_to_rest(course.arm.sent, 18)
    # The stream goes on without a gap, and what left is what the log says.
    assert np.diff(course.arm.times).max() <= 0.01 + 1e-9
    stream = course.recorder.stream.take()
    assert [tuple(q) for q in stream["q"]] == course.arm.sent
    assert stream["time"] == pytest.approx(course.arm.times)


def test_the_heart_beats_while_the_arm_comes_to_rest_without_it():
    course, ages = Course(Heart(40, {30: raising(RuntimeError("no"))})), []

    def look(now):
        pulse = course.recorder.pulse
        if pulse["ticks"] > 0.0:
            ages.append(now - pulse["time"])

    course.clock.attach(look)
    course.run()
    # An arm that is ramped down is no arm that nobody commands: that is told after 80 ms.
    assert max(ages) <= 0.020 + 1e-9
    assert course.recorder.pulse["ticks"] == 0.0


def test_an_interruption_goes_on_once_the_arm_rests():
    course = Course(Heart(20, {9: raising(KeyboardInterrupt())}))
    with pytest.raises(KeyboardInterrupt):
        course.run()
    assert came_to_rest(course.arm.sent, 18)


def test_a_link_that_breaks_on_the_way_to_rest_is_told_as_well():
    course = Course(Heart(20, {9: raising(RuntimeError("no"))}), breaks={"send": 20})
    _, stoppable = course.run()
    assert not stoppable
    assert course.told[-1].text == CANNOT_STOP


@pytest.mark.parametrize(
    ("what", "since"),
    [("replies", 24), ("read_input", 24), ("tell", 25), ("record", 25), ("idle", 26)],
)
def test_whatever_fails_in_a_tick_the_arm_comes_to_rest(what, since):
    calls = iter(range(1000))

    def fail(*_, **values):
        if what == "tell" or next(calls) == 12:
            raise OSError("broken pipe")
        return []

    note = OperatorMessage("note")
    course = Course(Heart(30, {12: lambda output: output._replace(events=(note,))}))
    places = {
        "replies": (course.arm, "replies"),
        "read_input": (course.person, "read_input"),
        "tell": (course.person, "notify"),
        "record": (course.recorder.encoder, "push"),
    }
    if what in places:
        setattr(*places[what], fail)
    else:
        course.more[what] = fail
    fault, stoppable = course.run()
    assert fault.outcome is Outcome.FAULT
    assert stoppable
    assert came_to_rest(course.arm.sent, since)


def test_the_guard_is_told_of_a_way_to_rest():
    course = Course(Heart(3, {2: lambda output: output._replace(to_rest=True)}))
    told, send = [], course.robot.send
    course.robot.send = lambda q, **how: told.append(how["to_rest"]) or send(q, **how)
    course.run()
    assert told == [False] * 4 + [True] * 2
