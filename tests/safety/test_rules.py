"""The safety rules at their edges: each on either side of its bound, and all of them on nothing."""

from math import inf, nan, pi, radians

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from equipoise.arm.iiwa import iiwa
from equipoise.outcomes import MAX_COUNT_JUMP, SAFETY_RULES, Outcome, SafetyInputs
from equipoise.safety import rules
from equipoise.safety.rules import MonitorState

ARM = iiwa(14)
HOME = ARM.home
LIMITS = rules.limits_of(ARM)
H = 0.01
DT = 0.005
RESOLUTION = 2 * pi / 8192
GUARD = rules.make_safety_params(ARM, reaction=0.03, h=H)
SLOW = GUARD._replace(speed=0.23)
CALM = MonitorState()


def moved(q, joint, by):
    """Return a posture with one joint moved, counted from one."""
    return tuple(angle + by if i == joint else angle for i, angle in enumerate(q, start=1))


def broken(view, guard=GUARD, watched=CALM):
    """Return the rule that a view breaks, or none."""
    violations = rules.violations(guard, watched, view)
    return violations[0].outcome if violations else None


def test_limits_are_those_of_the_arm_less_three_degrees():
    assert np.degrees(LIMITS.upper) == pytest.approx([167, 117, 167, 117, 167, 117, 172])
    assert np.degrees(LIMITS.lower) == pytest.approx([-167, -117, -167, -117, -167, -117, -172])
    assert np.degrees(LIMITS.velocity) == pytest.approx([85, 85, 100, 75, 130, 135, 135])


def test_a_guard_knows_its_arm():
    assert GUARD.torque == pytest.approx([32.0, 32.0, 17.6, 17.6, 11.0, 4.0, 4.0])
    w = abs(np.linalg.det(ARM.kinematics(ARM.home_free).jacobian))
    assert GUARD.min_manipulability == pytest.approx(0.1 * w)
    mirrored = ARM.model_copy(update={"home": (*HOME[:5], -HOME[5], *HOME[6:])})
    guard = rules.make_safety_params(mirrored, reaction=0.0, h=H)
    assert guard.min_manipulability == pytest.approx(GUARD.min_manipulability)


# Setpoints.


@pytest.mark.parametrize(
    ("q", "rule"),
    [
        *(
            (moved(HOME, joint, number), Outcome.NUMBER)
            for joint, number in enumerate((nan, inf, -inf, nan, inf, -inf, nan), start=1)
        ),
        *((q, Outcome.COUNT) for q in ((), HOME[:6], (*HOME, 0.0))),
    ],
)
def test_only_one_finite_number_per_joint_is_sent(q, rule):
    assert rules.check_setpoint(LIMITS, q, HOME, HOME, DT).outcome is rule
    assert (
        rules.check_first(LIMITS, q, HOME).outcome
        is rules.check_first(LIMITS, HOME, q).outcome
        is rule
    )


@pytest.mark.parametrize("joint", range(1, 8))
@pytest.mark.parametrize("upper", [True, False])
def test_a_setpoint_stays_inside_the_position_limits(joint, upper):
    limit = (LIMITS.upper if upper else LIMITS.lower)[joint - 1]
    inwards = -1e-9 if upper else 1e-9
    at = moved(HOME, joint, limit - HOME[joint - 1] + inwards)
    beyond = moved(at, joint, -2 * inwards)
    assert rules.check_setpoint(LIMITS, at, at, at, DT) is rules.check_first(LIMITS, at, at) is None
    for violation in (
        rules.check_setpoint(LIMITS, beyond, beyond, beyond, DT),
        rules.check_setpoint(LIMITS, beyond, beyond, beyond, DT, to_rest=True),
        rules.check_first(LIMITS, beyond, beyond),
    ):
        assert of_joint(violation, Outcome.POSITION, joint, beyond[joint - 1], limit)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_setpoint_can_be_stopped_before_the_limit(side):
    # 1.2 rad/s needs 1.44 / (2 10) = 72 mrad.
    for room, may in ((0.0721, True), (0.0719, False)):
        q = moved(HOME, 1, side * (LIMITS.upper[0] - room) - HOME[0])
        last, before = moved(q, 1, -1.2 * side * DT), moved(q, 1, -2.4 * side * DT)
        violation = rules.check_setpoint(LIMITS, q, last, before, DT)
        assert (violation is None) == may
        if violation:
            assert violation.outcome is Outcome.POSITION
            rest = side * (LIMITS.upper[0] - room + 0.072)
            assert violation.evidence["value"] == pytest.approx(rest)
        # On the way back it may be there, and on a way to rest.
        assert rules.check_setpoint(LIMITS, last, q, moved(q, 1, 1.2 * side * DT), DT) is None
        assert rules.check_setpoint(LIMITS, q, last, before, DT, True) is None


def of_joint(violation, rule, joint, value, limit):
    """Whether a violation is of a rule, and names joint, value and limit."""
    assert violation.outcome is rule
    assert violation.evidence["joint"] == joint
    assert violation.evidence["value"] == pytest.approx(value)
    assert violation.evidence["limit"] == pytest.approx(limit)
    return True


@pytest.mark.parametrize("joint", range(1, 8))
@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("dt", [0.002, 0.01])
def test_no_joint_is_sent_faster_or_harder_than_it_can(joint, side, dt):
    fastest, hardest = LIMITS.velocity[joint - 1], LIMITS.acceleration[joint - 1]
    for fraction, may in ((0.999, True), (1.001, False)):
        v, change = side * fraction * fastest * dt, side * fraction * hardest * dt**2
        fast = rules.check_setpoint(LIMITS, moved(HOME, joint, v), HOME, moved(HOME, joint, -v), dt)
        if may:
            assert fast is None
        else:
            assert of_joint(fast, Outcome.VELOCITY, joint, fraction * fastest, fastest)
        # From rest, while moving on, and to rest.
        for v in (0.0, 0.3 * side * dt):
            q, before = moved(HOME, joint, v + change), moved(HOME, joint, -v)
            hard = rules.check_setpoint(LIMITS, q, HOME, before, dt)
            if may:
                assert hard is None
            else:
                assert of_joint(hard, Outcome.ACCELERATION, joint, fraction * hardest, hardest)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_jump_is_a_jump_however_long_ago_the_last_one_was(side):
    for step, rule in ((0.0348, None), (0.0350, Outcome.JUMP)):
        q = moved(HOME, 1, side * step)
        violation = rules.check_setpoint(LIMITS, q, HOME, HOME, 10.0)
        assert (violation and violation.outcome) is rule
    assert of_joint(violation, Outcome.JUMP, 1, 0.035, radians(2.0))


@pytest.mark.parametrize("joint", range(1, 8))
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_first_setpoint_is_the_measured_posture(joint, side):
    assert rules.check_first(LIMITS, moved(HOME, joint, side * 0.00499), HOME) is None
    violation = rules.check_first(LIMITS, moved(HOME, joint, side * 0.00501), HOME)
    assert of_joint(violation, Outcome.FIRST, joint, 0.00501, 0.005)


# The run.


def test_nothing_wrong_breaks_no_rule():
    assert rules.violations(GUARD, CALM, SafetyInputs()) == []
    assert rules.violations(SLOW, CALM, SafetyInputs(balancing=True, on_track=True)) == []


LEAST = GUARD.min_manipulability
BOUNDS = [
    # rule, view that keeps it, view that breaks it
    *(
        (rule, {bound.name: bound.limit}, {bound.name: bound.limit + 1e-4})
        for rule in SAFETY_RULES
        if (bound := rule.bound)
    ),
    (Outcome.TORQUE, {"torque": (32.0, -32.0, 0, 0, 0, 0, 4.0)}, {"torque": (0,) * 6 + (4.01,)}),
    (Outcome.TORQUE, {"torque": (0.0,) * 7}, {"torque": (0, -32.1, 0, 0, 0, 0, 0)}),
    (Outcome.SINGULAR, {"manipulability": 1.001 * LEAST}, {"manipulability": 0.999 * LEAST}),
    (Outcome.TRACK, {"x": -0.217}, {"x": -0.219}),
    (Outcome.TRACK, {"x": 0.217}, {"x": 0.219}),
    (Outcome.TRACK, {"x": 0.215, "x_dot": -0.5}, {"x": 0.22, "x_dot": -0.5}),
    (Outcome.TRACK, {"x": -0.215, "x_dot": 0.5}, {"x": -0.22, "x_dot": 0.5}),
    (Outcome.TRACK, {"x": 0.155, "x_dot": 0.5}, {"x": 0.157, "x_dot": 0.5}),
    (Outcome.DRIFT, {"drift": 0.0149}, {"drift": 0.0151}),
    (Outcome.TILT, {"tilt": radians(1.99)}, {"tilt": radians(2.01)}),
    (Outcome.TILT, {"tilt": -radians(1.99)}, {"tilt": -radians(2.01)}),
    (Outcome.ENCODER_JUMP, {"encoder_jump": radians(0.599)}, {"encoder_jump": radians(0.601)}),
    (Outcome.ANGLE, {"phi": radians(10.99)}, {"phi": radians(11.0)}),
    (Outcome.ANGLE, {"phi": -radians(10.99)}, {"phi": -radians(11.0)}),
]


@pytest.mark.parametrize(("rule", "kept", "not_kept"), BOUNDS)
def test_each_rule_on_either_side_of_its_bound(rule, kept, not_kept):
    usual = {"on_track": True, "balancing": True}
    assert rules.violations(GUARD, CALM, SafetyInputs(**usual | kept)) == []
    violation = rules.violations(GUARD, CALM, SafetyInputs(**usual | not_kept))[0]
    assert violation.outcome is rule
    value, limit = violation.evidence["value"], violation.evidence["limit"]
    assert abs(value) >= abs(limit) or rule is Outcome.SINGULAR


def test_flange_and_angle_count_where_they_mean_something():
    away = SafetyInputs(x=9.0, x_dot=9.0, drift=9.0, tilt=9.0, manipulability=0.0, phi=3.0)
    assert rules.violations(SLOW, CALM, away) == []
    assert broken(away._replace(on_track=True)) is Outcome.SINGULAR
    assert broken(away._replace(balancing=True)) is Outcome.ANGLE


def test_t1_is_slow_and_a_stop_not_a_clip():
    for side in (1.0, -1.0):
        slow, fast = (SafetyInputs(on_track=True, x_dot=side * v) for v in (0.2299, 0.23))
        assert broken(slow, SLOW) is None
        assert broken(fast, SLOW) is Outcome.SPEED
        assert broken(fast) is None


FIELDS = zip(SafetyInputs._fields, SafetyInputs(), strict=True)
NUMBERS = [name for name, value in FIELDS if type(value) is float]


@pytest.mark.parametrize("number", [nan, inf, -inf])
@pytest.mark.parametrize("name", [*NUMBERS, "measured", "expected", "torque"])
def test_what_is_no_number_stops_the_run_whatever_else_is_wrong(name, number):
    if name == "manipulability" and number == inf:
        return
    value = number if name in NUMBERS else (0.0, 0.0, 0.0, number, 0.0, 0.0, 0.0)
    view = SafetyInputs(overdue=1.0, on_track=True, balancing=True, x=9.0)._replace(**{name: value})
    violation = rules.violations(GUARD, CALM, view)[0]
    assert violation.outcome is Outcome.NUMBER
    assert (violation.evidence["name"], violation.evidence["got"]) == (name, str(number))


# What goes on for a while.


def seen(*views):
    """Return what has been going on after these views, and the first violation."""
    watched, first = MonitorState(), None
    for view in views:
        watched = rules.update_monitor(GUARD, watched, view)
        first = first or next(iter(rules.violations(GUARD, watched, view)), None)
    return watched, first


def along(n, follow, speed=0.1):
    """Return views of an arm that is expected to move steadily, and does by a fraction of it."""
    return [
        SafetyInputs(
            measured=moved(HOME, 1, follow * speed * H * i), expected=moved(HOME, 1, speed * H * i)
        )
        for i in range(n)
    ]


def test_an_arm_that_stands_still_while_it_should_move_does_not_follow():
    views = along(50, 0.0)
    # 0.1 rad/s: after 0.15 s it should have gone 15 mrad.
    assert seen(*views[:15])[1] is None
    watched, violation = seen(*views[:18])
    assert violation.outcome is Outcome.NOT_FOLLOWING
    assert violation.evidence["value"] == pytest.approx(0.016, abs=0.0015)
    assert violation.evidence["limit"] == 0.015
    assert watched.rest == HOME
    # A tremble within the noise is no motion; beyond it, it is one of that joint.
    for joint, by, rule in (
        (1, 2e-4, Outcome.NOT_FOLLOWING),
        (1, 6e-4, None),
        (2, 6e-4, Outcome.NOT_FOLLOWING),
    ):
        trembles = (moved(HOME, joint, by * (i % 2)) for i in range(20))
        views = [v._replace(measured=q) for v, q in zip(views, trembles, strict=False)]
        violation = seen(*views)[1]
        assert (violation and violation.outcome) is rule


def test_standing_still_counts_from_the_last_motion():
    follows = along(30, 1.0)
    stop = follows[-1].measured
    frozen = [SafetyInputs(measured=stop, expected=moved(stop, 1, 0.001 * i)) for i in range(1, 20)]
    assert seen(*follows, *frozen[:14])[1] is None
    assert seen(*follows, *frozen[:17])[1].outcome is Outcome.NOT_FOLLOWING
    # What has come back counts all the same.
    back = SafetyInputs(measured=stop, expected=stop)
    watched, _ = seen(*follows, *frozen[:8], back)
    assert max(watched.expected_motion) == pytest.approx(0.008, abs=0.0011)


def test_ticks_without_measured_joints_change_nothing_of_that():
    views = along(9, 0.0)
    blind = (SafetyInputs(), SafetyInputs(measured=HOME), SafetyInputs(expected=HOME))
    assert seen(*views, *blind)[0] == seen(*views)[0]._replace(unmeasured=3)


def off(n, by, joint=3):
    """Return views of an arm that moves along, beside where it is expected."""
    views = along(n, 1.0, speed=0.2)
    return [view._replace(measured=moved(view.expected, joint, by)) for view in views]


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_an_arm_that_is_elsewhere_for_long_is_not_following(side):
    far, near = off(12, side * 0.031), off(12, side * 0.029)
    assert seen(*near)[1] is None
    # Five ticks are 50 ms; it has to last longer.
    assert seen(*far[:5])[1] is None
    watched, violation = seen(*far[:6])
    assert watched.error_time == pytest.approx(0.06)
    assert of_joint(violation, Outcome.FOLLOWING, 3, 0.031, 0.03)
    # Near in between, it begins anew.
    assert seen(*far[:5], near[5], *far[6:11])[1] is None


def test_a_following_error_lasts_through_ticks_without_measured_joints():
    far, blind = off(8, 0.031), SafetyInputs()
    assert seen(far[0], *(blind,) * 9)[1] is None
    # An error before and after them persists; one measurement is not enough.
    assert seen(far[0], *(blind,) * 4, far[5])[1].outcome is Outcome.FOLLOWING
    assert seen(far[0], *(blind,) * 3, far[4])[1] is None
    assert seen(*(blind,) * 9, far[0])[1] is None
    assert seen(far[0], *(blind,) * 4, off(6, 0.029)[5], far[6])[1] is None


def test_a_following_error_needs_measured_joints_to_be_named():
    watched = MonitorState(error_time=1.0)
    assert rules.violations(GUARD, watched, SafetyInputs()) == []
    assert rules.violations(GUARD, watched, SafetyInputs(measured=HOME)) == []
    assert broken(SafetyInputs(measured=HOME, expected=HOME), watched=watched) is Outcome.FOLLOWING


# Track.


@settings(max_examples=50)
@given(st.floats(-0.22, 0.22), st.floats(-1.0, 1.0), st.floats(0.0, 0.08))
def test_the_reach_is_where_a_simulated_stop_ends(x, x_dot, reaction):
    # Outwards at 2 m/s^2 for a tick and until the stop takes effect, then at 4 m/s^2 to rest.
    s = 1.0 if x_dot > 0.0 or (x_dot == 0.0 and x >= 0.0) else -1.0
    place, v, h = s * x, abs(x_dot), 1e-3
    left = H + reaction
    while left > 1e-12:
        dt = min(h, left)
        place += v * dt + 0.5 * 2.0 * dt**2
        v += 2.0 * dt
        left -= dt
    while v > 1e-12:
        dt = min(h, v / 4.0)
        place += v * dt - 2.0 * dt**2
        v -= 4.0 * dt
    limits = GUARD._replace(reaction=reaction)
    assert rules.stopping_reach(limits, x, x_dot) == pytest.approx(place, abs=1e-9)


def test_the_setpoint_in_force_is_the_newest_that_was_sent_by_then():
    sent = [0.04, 0.01, 0.02, 0.03]  # the fifth has taken the place of the first
    in_force = [rules.newest_before(sent, 5, since) for since in (0.045, 0.04, 0.039, 0.02, 0.01)]
    assert in_force == [0, 0, 3, 2, 1]
    assert rules.newest_before(sent, 5, 0.005) == 1, "all were sent later: the oldest"
    begun = [0.04, 0.05, -inf, -inf]
    assert rules.newest_before(begun, 2, 10.0) == 1
    assert begun[rules.newest_before(begun, 2, 0.0)] == -inf, "where it rested before the first"


# Encoder.


@pytest.mark.parametrize("side", [1, -1])
def test_a_jump_of_the_counts_is_seen(side):
    times = (0.0, 0.001, 0.002)
    # Two steps of the encoder and gravity's 0.15 mrad explain two counts.
    assert rules.unexplained_turn(times, (0, 5 * side, 12 * side), RESOLUTION) == 0.0
    jump = rules.unexplained_turn(times, (0, 5 * side, 40 * side), RESOLUTION)
    late = 4.0 * 0.0003 * 5.0 * RESOLUTION / 0.001
    assert jump == pytest.approx((30 - 2) * RESOLUTION - late - 0.5 * 150.0 * 0.001 * 0.002)
    assert broken(SafetyInputs(encoder_jump=jump)) is Outcome.ENCODER_JUMP
    # As long after a longer pause: a step then stands for more.
    later = rules.unexplained_turn((0.0, 0.001, 0.004), (0, 0, 30 * side), RESOLUTION)
    assert later == pytest.approx((30 - 4) * RESOLUTION - 0.5 * 150.0 * 0.003 * 0.004)


@pytest.mark.parametrize("side", [1, -1])
def test_no_pendulum_turns_faster_than_twenty_radians_per_second(side):
    def steady(rate):
        counts = tuple(round(side * rate * t / RESOLUTION) for t in (0.0, 0.01, 0.02))
        return rules.unexplained_turn((0.0, 0.01, 0.02), counts, RESOLUTION)

    assert steady(20.0) == 0.0
    assert steady(23.0) == pytest.approx(0.03 - 0.012 - RESOLUTION, abs=RESOLUTION)


@pytest.mark.parametrize("errors", [(1, -1, 1), (-1, 1, -1), (1, -1, -1), (0, 1, -1)])
def test_times_that_err_by_a_third_of_a_millisecond_are_no_jump_of_a_fast_swing(errors):
    # The bottom of a swing-up, at 17 rad/s.
    times = tuple(0.001 * k + 0.0003 * error for k, error in enumerate(errors))
    counts = tuple(round(0.017 * k / RESOLUTION) for k in range(3))
    assert rules.unexplained_turn(times, counts, RESOLUTION) < MAX_COUNT_JUMP
    slipped = (*counts[:2], counts[2] + round(np.radians(5.0) / RESOLUTION))
    assert rules.unexplained_turn(times, slipped, RESOLUTION) > MAX_COUNT_JUMP


@pytest.mark.parametrize("times", [(0.0, 0.0, 0.001), (0.0, 0.001, 0.001), (0.0, 0.002, 0.001)])
def test_time_that_does_not_go_on_explains_nothing(times):
    assert rules.unexplained_turn(times, (0, 0, 0), RESOLUTION) == inf
    assert broken(SafetyInputs(encoder_jump=inf)) is Outcome.NUMBER
