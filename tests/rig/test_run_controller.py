"""A run from home to balance, its measurements made up: what stops it, and what it lets pass.

The arm is where it was sent a little while ago, the pendulum where each test puts it.
"""

from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from functools import partial
from math import cosh, pi, radians, sinh, sqrt

import numpy as np
import pytest

from equipoise import Actuator, shipped_policy
from equipoise.control.ticks import Reply, Sample, TickInputs, missed_ticks
from equipoise.errors import RecordingError
from equipoise.identification.driven_swing import SelfTest, SelfTestVerdict
from equipoise.log.conditions import Reference
from equipoise.outcomes import MAX_MEASUREMENT_AGE, End, Outcome, Phase, describe
from equipoise.rig import script
from equipoise.rig.config import RigSettings
from equipoise.rig.request import RunRequest
from equipoise.rig.run_controller import MOVING, UNCERTAIN_TORQUE_FACTOR, RunController
from equipoise.rig.script import Run


@pytest.fixture(autouse=True)
def _short_swings(monkeypatch):
    """Shorten the self-test's observation, whose verdict is made up here."""
    monkeypatch.setattr(script, "SWING_TIME", 0.5)


POLICY = shipped_policy()
ARM, H = POLICY.arm, POLICY.h
COUNTS = 8192
TORQUE_EVERY = 5  # ticks, over a KST link
PER_RADIAN = COUNTS / (2.0 * pi)
TORQUES = np.array([0.1, 1.7, 0.0, -1.2, 0.1, 0.3, -0.1])
FALLS = sqrt(POLICY.pendulum.parameters().w2)
SOUND = SelfTest(SelfTestVerdict.PASSED, "all well", *(1.0, 70.0, 0.0, 0.0, 0.01), 0.1)
SWAY = 0.02 * np.sin(np.linspace(0.0, 8.0 * pi, 401))[:, None] ** 2
"""Two seconds of motion of every joint, from home to home [rad]."""


class Swaying(RunRequest):
    """A request with a short excitation."""

    def excitation(self):
        return np.array(self.settings.described_arm.home) + SWAY


REQUEST = Swaying(POLICY, POLICY.actuator, RigSettings(), "twin:nominal", None, 60.0)


class Course:
    """A pilot and what it is told, a tick of 10 ms at a time."""

    def __init__(self, q=ARM.home, identify=None, request=REQUEST):
        request, self.jobs = replace(request, identify=identify), ThreadPoolExecutor(1)
        run = Run(request, q, submit=self.submit)
        self.pilot = RunController(run)
        self.guard = self.pilot.run.safety
        self.tick_number, self.now = 0, 0.0
        self.theta = lambda time: 0.0
        self.samples_lost = frozenset()
        self.torques = TORQUES
        self.sent = [(-1.0, tuple(q))]
        self.told, self.texts = [], []
        self.answers, self.verdicts = [], []
        self.link_dead = False
        self.measured, self.trip = lambda time, q: q, 0.004
        self.answered = self.seen = 0

    def where(self, time):
        """Where the arm is: where it was sent before its response."""
        before = time - self.guard.reaction
        return next(q for when, q in reversed(self.sent) if when <= before or when < 0)

    def samples(self):
        """One in each millisecond, but for those that are lost on their way."""
        came, missing = [], 0
        last = round(1e3 * self.now) - 1
        for ms in range(self.seen + 1, last + 1):
            if ms in self.samples_lost:
                missing += 1
                continue
            counts = round(self.theta(1e-3 * ms) * PER_RADIAN)
            came.append(Sample(1e-3 * ms, counts, False, False, missing))
            missing = 0
        self.seen = last - missing
        return came

    def replies(self):
        came = []
        while not self.link_dead and self.answered + 1 < len(self.sent):
            when, _ = self.sent[self.answered + 1]
            if when + self.trip > self.now:
                break
            self.answered += 1
            there = when + 0.5 * self.trip
            q = self.measured(there, np.asarray(self.where(there)) + 1e-3 * (self.answered % 2))
            with_torques = self.answered % 10 == 9
            torque = tuple(self.torques) if with_torques else None
            q = None if q is None or with_torques else tuple(q)
            came.append(Reply(when, when + self.trip, q, torque))
        return came

    def tick(self, late=0.0, **inputs):
        """Let a tick begin so late; those that it misses are left out."""
        missed = missed_ticks(late, H)
        self.tick_number += 1 + missed
        due = H * self.tick_number
        self.now = max(due, due + late - missed * H)
        answers, self.answers = self.answers, []
        given = TickInputs(self.samples(), self.replies(), answers, [], late)
        output = self.pilot.tick(self.now, given._replace(**inputs))
        for place, setpoint in enumerate(output.setpoints):
            self.sent.append((max(self.now, due + 0.5 * H * place), setpoint))
        self.told += [event.name for event in output.events]
        self.texts += [event.text for event in output.events]
        for event in output.events:
            if event.answers:
                self.answers = [event.answers[0]]
        return output

    def submit(self, job):
        """Make up the verdict of a self-test, and run any other job."""
        if self.pilot.run.phase is Phase.SELF_TEST:
            verdict = self.verdicts.pop() if self.verdicts else SOUND.verdict
            job = partial(SOUND._replace, verdict=verdict)
        future = self.jobs.submit(job)
        wait([future])
        return future

    def ticks(self, number):
        for _ in range(number):
            self.tick()

    def until(self, phase, longest=30.0):
        for _ in range(round(longest / H)):
            self.tick()
            if self.pilot.run.phase is phase:
                return self
        raise AssertionError(f"{self.pilot.run.phase} after {longest} s: {self.pilot.end}")

    @property
    def cause(self):
        return None if self.pilot.end is None else self.pilot.end.outcome

    @property
    def reason(self):
        return "" if self.pilot.end is None else describe(self.pilot.end)


def armed(make=Course):
    """A course whose pendulum stands in a hand."""
    course = make().until(Phase.LIFTING)
    lifted = course.now

    def lifting(time):
        fraction = min(max((time - lifted) / 2.0, 0.0), 1.0)
        return pi * fraction**2 * (3.0 - 2.0 * fraction)

    course.theta = lifting
    return course.until(Phase.ARMED)


def balancing(make=Course):
    """A course whose pendulum was let go; then it comes upright again and stands there."""
    course = armed(make)
    begin = course.now + 0.1

    def falling(time):
        since = max(time - begin, 0.0)
        return pi - radians(0.4) * (cosh(FALLS * since) + 0.5 * sinh(FALLS * since))

    course.theta = falling
    course.until(Phase.BALANCING, 1.0)
    released, back = falling(course.now), course.now
    # A smooth way back to upright, with the rate that it has.
    rate = (falling(back + 1e-4) - falling(back - 1e-4)) / 2e-4

    def returning(time):
        since = time - back
        away = (released - pi) + (rate + (released - pi) / 0.08) * since
        return pi + away * np.exp(-since / 0.08)

    course.theta = lambda time: falling(time) if time <= back else returning(time)
    return course


@pytest.fixture
def course():
    return balancing()


SLOW = Actuator.assumed("kst", delay=0.01, lag=0.02, cycle=0.1)
"""An actuator that the policy does not fit."""


def exciting(identify):
    """A course that excites the arm, its setpoints from `SWAY`."""
    return Course(identify=identify).until(Phase.EXCITING)


def test_a_job_that_cannot_begin_stops_the_run():
    course = Course()
    course.pilot.run.submit = fails
    assert course.until(Phase.STOPPING).cause == Outcome.SELF_TEST
    assert "too short" in course.reason


def test_an_excitation_identifies_the_arm_before_the_lift():
    found, records = POLICY.actuator, []

    def identify(sent, measured):
        records.append((sent, measured))
        return found

    course = exciting(identify)
    course.until(Phase.LIFTING)
    order = ["self-test", "excitation", "identified", "lift"]
    assert [name for name in course.told if name in order] == order
    assert course.pilot.run.identified is found
    # All setpoints were sent, and recorded with the joints that answered.
    ((sent, measured),) = records
    free = REQUEST.excitation()[:, list(ARM.free)]
    first = next(i for i, row in enumerate(sent[:, 1:]) if np.array_equal(row, free[1]))
    assert np.array_equal(sent[first : first + 400, 1:], free[1:])
    assert np.diff(sent[first : first + 400, 0]) == pytest.approx(0.5 * H)
    assert np.ptp(measured[:, 1:], axis=0) == pytest.approx(0.02, abs=0.002)


def fails(*_):
    raise RecordingError("too short")


@pytest.mark.parametrize("identify", [lambda *_: SLOW, fails])
def test_an_arm_without_a_usable_actuator_lifts_nothing(identify):
    course = exciting(identify).until(Phase.STOPPING)
    assert course.cause == Outcome.UNIDENTIFIED
    assert "lift" not in course.told


HANGING = replace(REQUEST, start="hanging")
FOLLOWING = replace(HANGING, reference=Reference(zero=0.0, torque=TORQUES))


def hanging(request=HANGING):
    return Course(away(), request=request)


REACH = {
    Phase.EXCITING: lambda: exciting(fails),
    Phase.ARMED: armed,
    Phase.BALANCING: balancing,
    Phase.DAMPING: lambda: hanging(FOLLOWING).until(Phase.DAMPING),
    Phase.SWINGING_UP: lambda: hanging().until(Phase.SWINGING_UP),
}
"""Courses to the phases that `Course.until` alone does not reach."""


@pytest.mark.parametrize("phase", [phase for phase in Phase if phase is not Phase.STOPPING])
def test_each_phase_can_be_stopped_and_nothing_opens_the_latch(phase):
    course = REACH.get(phase, lambda: Course(away()).until(phase))()
    course.ticks(20 if phase in MOVING else 0)
    assert course.pilot.run.phase is phase
    begin = len(course.sent)
    course.tick(lines=["stop"])
    key, frozen = course.pilot.end, End(Outcome.NOT_FOLLOWING)
    assert (key.outcome, course.pilot.run.phase) == (Outcome.OPERATOR, Phase.STOPPING)
    course.tick(lines=["y", "", "ok"], faults=[frozen])
    # What comes later about the arm is believed.
    assert course.pilot.from_measured
    while not course.tick(late=0.02 if course.tick_number % 7 == 0 else 0.0).done:
        assert (course.pilot.run.phase, course.pilot.end) == (Phase.STOPPING, key)
    assert course.told.count("stopping") == 1
    assert beyond_the_ramp(np.array([q for _, q in course.sent[begin - 1 :]])) < 1e-9


@pytest.mark.full
def test_a_pendulum_that_does_not_come_up_is_damped_and_swung_three_times():
    course = hanging().until(Phase.STOPPING, 90.0)
    assert course.cause == Outcome.NOT_UPRIGHT
    assert [n for n in course.told if n in ("swing-up", "damping")] == ["swing-up", "damping"] * 3


def test_a_pendulum_that_is_not_damped_is_not_swung_up():
    course = hanging(FOLLOWING)
    course.theta = lambda time: 0.5 * np.sin(8.4 * time)
    course.until(Phase.STOPPING)
    assert course.cause == Outcome.SELF_TEST
    assert "still swings by" in course.reason


def test_a_zero_that_has_changed_since_the_reference_ends_a_following_run():
    course = hanging(FOLLOWING)
    course.verdicts = [SelfTestVerdict.ZERO]
    course.until(Phase.STOPPING)
    assert course.cause == Outcome.SELF_TEST
    assert course.pilot.run.encoder.zero == 0.0


def moves(course):
    """Ticks until the arm moves."""
    for _ in range(400):
        course.tick()
        if max(np.abs(np.subtract(course.sent[-1][1], course.sent[-2][1]))) > 2e-4:
            return course
    raise AssertionError("it does not move")


STREAMS = {
    "homing": lambda: moves(Course(q=tuple(np.add(ARM.home, 0.1)))),
    "swing": lambda: moves(Course().until(Phase.SELF_TEST)),
    "balancing": lambda: moves(balancing()),
}


@pytest.fixture(params=STREAMS)
def moving(request):
    """A course in one of the streams."""
    return STREAMS[request.param]()


@pytest.mark.parametrize("unsent", [0, 1])
def test_after_a_stall_each_stream_begins_anew_where_the_arm_rests(moving, unsent):
    phase = moving.pilot.run.phase
    del moving.sent[len(moving.sent) - unsent :]
    rest = len(moving.sent)
    moving.tick(0.04, unsent=unsent)
    moving.ticks(30)
    q = np.array([moving.sent[rest - 1][1], *(setpoint for _, setpoint in moving.sent[rest - 1 :])])
    hardest = np.abs(np.diff(q, n=2, axis=0)).max() / 0.005**2
    assert 0.1 < hardest <= 10.0
    assert moving.pilot.run.phase is phase
    assert moving.told.count("warning") == 1


def test_a_self_test_swings_four_times_at_most():
    for repeated, after in ((3, Phase.LIFTING), (4, Phase.STOPPING)):
        course = Course()
        course.verdicts = repeated * [SelfTestVerdict.REPEAT]
        course.until(after, 60.0)
        assert course.told.count("self-test") == 4


def test_a_stop_after_a_stall_holds_the_arm_where_it_rests():
    course = STREAMS["balancing"]()
    last = course.sent[-1][1]
    course.tick(0.1)
    course.ticks(20)
    assert course.cause == Outcome.TICK
    others = {setpoint for _, setpoint in course.sent if setpoint != last}
    assert others.isdisjoint({setpoint for _, setpoint in course.sent[-40:]})


def stall(course, part, long):
    """Let the loop, or the link, stand still once."""
    if part == "loop":
        course.tick(long)
    else:
        course.link_dead = True
        course.ticks(max(round(long / H), 3))
        course.link_dead = False
        course.ticks(3)


@pytest.mark.parametrize("parts", [("loop",) * 3, ("link",) * 3, ("loop", "link", "loop")])
@pytest.mark.parametrize("long", [0.008, 0.06])
def test_a_third_stall_within_a_second_stops_it(moving, parts, long):
    for number, part in enumerate(parts, start=1):
        assert moving.cause is None, number
        stall(moving, part, long)
        moving.ticks(10)
    assert moving.cause == Outcome.STALLS
    assert f"at last {'the loop' if parts[-1] == 'loop' else 'the robot'}" in moving.reason


def test_a_link_that_stands_still_is_sent_nothing_until_it_answers_again():
    course = STREAMS["balancing"]()
    course.link_dead, number, began = True, len(course.sent), course.now
    course.ticks(6)
    sent = course.sent[number:]
    assert max(when for when, _ in sent) <= began + 0.03
    course.link_dead = False
    course.tick()
    course.ticks(5)
    assert course.pilot.run.phase is Phase.BALANCING
    assert len(course.sent) == number + len(sent) + 12
    q = np.array([sent[-1][1], *(setpoint for _, setpoint in course.sent[-13:])])
    assert np.abs(np.diff(q, n=2, axis=0)).max() <= 10.0 * 0.005**2


# Measured joints.


@pytest.mark.parametrize("trip", [0.021, 0.044, 0.060])
def test_a_link_with_a_long_round_trip_stops_it_and_is_named(moving, trip):
    moving.trip, began, phase = trip, moving.now, moving.pilot.run.phase
    while moving.pilot.run.phase is phase:
        moving.tick()
    assert moving.cause == (Outcome.STALLS if trip < 0.03 else Outcome.MEASUREMENT_STALE)
    assert "link" in moving.reason
    assert moving.now - began <= MAX_MEASUREMENT_AGE + H


def test_a_robot_that_answers_without_joints_stops_it(moving):
    began, phase = moving.now, moving.pilot.run.phase
    moving.measured = lambda time, q: None
    while moving.pilot.run.phase is phase:
        moving.tick()
    assert moving.cause == Outcome.MEASUREMENT_STALE
    assert moving.now - began <= MAX_MEASUREMENT_AGE + H


def run_off(course, joint, rate, most=1.5):
    """Report a joint as running off from now on."""
    began = course.now
    course.measured = lambda time, q: (
        q + np.eye(7)[joint] * np.clip(rate * max(time - began, 0.0), -most, most)
    )


def after_stop(course):
    """Let a course stop and come to rest; return the setpoints since the last one before."""
    while course.pilot.end is None:
        number = len(course.sent) - 1
        course.tick()
    for _ in range(1000):
        if course.tick().done:
            return np.array([q for _, q in course.sent[number:]])
    raise AssertionError("it does not come to rest")


def beyond_the_ramp(sent):
    """Return how much further than the ramp setpoints go from the last one before a stop [rad]."""
    away = np.abs(sent - sent[0])
    rest = int(np.argmax(np.abs(np.diff(sent, axis=0)).max(axis=1) < 1e-9))
    return float((away.max(axis=0) - away[rest]).max())


@pytest.mark.parametrize(("joint", "rate"), [(0, 10.0), (0, -3.5), (3, 3.5), (5, 1.0), (6, -0.4)])
def test_joints_that_run_off_move_nothing_after_the_stop(moving, joint, rate):
    run_off(moving, joint, rate)
    assert beyond_the_ramp(after_stop(moving)) < 1e-9
    assert "which holds: the measurement is not plausible" in " ".join(moving.texts)


def blocked(course):
    """Let the arm stand where it is, as after an emergency stop."""
    place = np.array(course.where(course.now))
    course.measured = lambda time, q: place


@pytest.mark.parametrize("stream", STREAMS)
def test_the_target_goes_back_towards_a_blocked_arm_within_the_reach_of_the_ramp(stream):
    course = STREAMS[stream]()
    course.ticks(20 if stream == "homing" else 10)
    blocked(course)
    sent = after_stop(course)
    assert "which goes back by" in " ".join(course.texts)
    assert beyond_the_ramp(sent) < 1e-9
    arm, rest = course.measured(0.0, None), sent[np.abs(sent - sent[0]).max(axis=1).argmax()]
    assert np.abs(sent[-1] - arm).max() < np.abs(rest - arm).max() - 1e-4


def going_back():
    """A course that goes back towards a blocked arm after its stop."""
    course = STREAMS["balancing"]()
    course.ticks(10)
    blocked(course)
    while not any("goes back" in text for text in course.texts):
        course.tick()
    return course


@pytest.mark.parametrize("word", ["stop", "", "y"])
def test_any_key_ends_a_way_back(word):
    course = going_back()
    course.tick()
    course.tick(lines=[word])
    held = course.sent[-1][1]
    assert "The target holds: a key was pressed." in course.texts
    while not course.tick().done:
        assert course.sent[-1][1] == pytest.approx(held, abs=1e-4)


def test_a_flange_that_leaves_its_line_ends_a_way_back():
    course = going_back()
    place = course.measured(0.0, None)
    course.measured = lambda time, q: place + 0.1 * np.eye(7)[1]
    course.tick()
    course.tick()
    assert any(text.startswith("The target holds: the flange is") for text in course.texts)


# The encoder.


def lose(course, *ms):
    """Lose the samples of so many milliseconds from now."""
    course.samples_lost = frozenset(round(1e3 * course.now) + after for after in ms)


def test_a_single_lost_sample_is_bridged_counted_and_told_once(course):
    lose(course, 5, 255)
    course.ticks(30)
    assert course.pilot.run.phase is Phase.BALANCING
    assert course.told.count("warning") == 1


def test_lost_samples_that_come_often_stop_it(course):
    lose(course, 5, 45, 85)
    for _ in range(9):  # the third is at 85 ms
        assert course.pilot.run.phase is Phase.BALANCING
        course.tick()
    assert course.cause == Outcome.ENCODER_GAP


# External torques.


def away():
    return tuple(angle + 0.2 for angle in ARM.home)


def push(course, joint, fraction):
    limit = course.guard.torque[joint]
    course.torques = TORQUES + fraction * limit * np.eye(7)[joint]


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_contact_on_the_way_home_stops_it(joint, sign):
    course = Course(away())
    course.ticks(2 * TORQUE_EVERY)
    push(course, joint, 1.02 * UNCERTAIN_TORQUE_FACTOR * sign)
    began = course.now
    while course.pilot.run.phase is Phase.HOMING:
        course.tick()
    assert course.cause == Outcome.TORQUE
    assert course.now - began <= (TORQUE_EVERY + 1) * H
    assert course.pilot.from_measured


def test_the_torques_at_home_are_what_others_are_compared_with_there():
    # Where it began something else hung on it; at home the limit is the narrow one.
    course = Course(away())
    course.ticks(2 * TORQUE_EVERY)
    push(course, 1, 0.9 * UNCERTAIN_TORQUE_FACTOR)
    course.until(Phase.SELF_TEST)
    course.ticks(20)
    assert course.pilot.run.phase is Phase.SELF_TEST
    push(course, 1, 0.9 * UNCERTAIN_TORQUE_FACTOR + 1.02)
    course.ticks(TORQUE_EVERY + 1)
    assert course.cause == Outcome.TORQUE
