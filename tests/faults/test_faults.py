"""Each fault ends as required; the list is complete, and the judge finds each wrong end."""

from math import inf, nan
from types import SimpleNamespace

import numpy as np
import pytest

from equipoise.logs.conditions import RunEnd
from equipoise.model.arms.iiwa import iiwa
from equipoise.outcomes import Outcome
from equipoise.rig.config import RigSettings
from equipoise.safety.rules import POSITION_MARGIN
from tests.faults.harness import ArmObservation, ReceivedMessage
from tests.faults.injection import FAULTS, run_fault
from tests.faults.real_time import REAL_TIME
from tests.faults.table import Fault
from tests.faults.verdicts import (
    Sent,
    check_limits,
    check_stop,
    judge,
    setpoints_of,
)

pytestmark = pytest.mark.compiled_only

ARM = RigSettings().described_arm
HOME = np.array(ARM.home)

ISSUE = """
encoder unplugged, encoder frozen, count jump, slow count loss, wrong sign, wrong counts: half,
zeroed while swinging, zero error, stale samples, malformed lines, wall clock stepped, late tick,
CPU load, TCP drop, half-open link, command backlog, nak, robot not following, E-stop, mode change,
contact, joint limit, velocity limit, track limit, near singularity, flange drift,
flange pitch error, first command away from the measured pose, reconnect in mid-run, second client,
NaN from the encoder's line, NaN from the robot's line, NaN in a setpoint, NaN in the policy,
release too early, release too late, push, policy of another rig, corrupt policy, bad settings,
unit slip, disk full, power cut in the log, control process killed
"""
"""What the list has to hold."""

QUICK = (
    "encoder unplugged in the self-test",
    "robot not following",
    "infinity in a setpoint",
    "key: homing",
    "near singularity",
    "first command away from the measured pose",
    "TCP drop",
    "corrupt policy",
    "bad settings",
)
"""A subset: something of most kinds, and little to wait for."""


def fault(name):
    return next(one for one in FAULTS if one.name == name)


def test_the_list_holds_what_it_has_to():
    names = {one.name for one in (*FAULTS, *REAL_TIME)}
    wanted = {name.strip() for name in ISSUE.replace("\n", " ").split(",")}
    assert wanted <= names
    signals = [one.name for one in REAL_TIME if one.name.startswith(("SIGINT", "SIGTERM"))]
    assert len(signals) >= 4


def test_each_fault_has_a_name_of_its_own_and_says_what_should_happen():
    everything = (*FAULTS, *REAL_TIME)
    assert len({one.name for one in everything}) == len(everything)
    assert all(one.injected and one.should for one in everything)


@pytest.mark.parametrize("name", QUICK)
def test_a_fault_ends_as_it_should(name):
    did, problems = run_fault(fault(name))
    assert problems == [], did


@pytest.mark.slow
@pytest.mark.parametrize("name", [one.name for one in FAULTS if one.name not in QUICK])
def test_each_other_fault_ends_as_it_should(name):
    did, problems = run_fault(fault(name))
    assert problems == [], did


@pytest.mark.slow
@pytest.mark.parametrize("live", REAL_TIME, ids=lambda live: live.name)
def test_each_fault_in_real_time_ends_as_it_should(live):
    did, problems = run_fault(live)
    assert problems == [], did


def test_a_fault_that_ends_otherwise_is_found():
    # What is injected is a key; what is expected is that the run lasts.
    wrong = fault("key: homing")._replace(ends=frozenset({Outcome.LASTED}))
    _, problems = run_fault(wrong)
    assert any("it ended with operator" in problem for problem in problems)


# The judge, on courses written by hand: 5 ms apart, joint 1 moves.


def course(*speeds, begin=0.0):
    """Setpoints that begin at home and move joint 1 at these speeds [rad/s]."""
    sent = [Sent(begin, tuple(HOME))]
    for speed in speeds:
        q = np.array(sent[-1].q)
        q[0] += speed * 0.005
        sent.append(Sent(sent[-1].time + 0.005, tuple(q.tolist())))
    return sent


SLOWING = (0.4, 0.4, 0.4, 0.3, 0.2, 0.1, 0.0, 0.0)


def test_a_ramp_that_begins_at_once_is_rest():
    # The stop is told with the fourth setpoint that moves.
    assert check_stop(ARM, course(*SLOWING), 0.020) == []


@pytest.mark.parametrize(
    ("speeds", "saying"),
    [
        ((0.4, 0.4, 0.4, 0.41, 0.2, 0.1, 0.0, 0.0), "no slower"),
        ((0.4, 0.4, 0.4, 0.3, 0.2, 0.25, 0.0, 0.0), "no slower"),
        ((0.4, 0.4, 0.4, 0.3, 0.2, 0.1, 0.0, 1.0), "sent away"),
        ((*SLOWING, *(-0.1,) * 40, 0.0), "left the reach"),
        ((0.4, 0.4, 0.4, 0.3, 0.2, 0.1), "still moves"),
        ((0.4, 0.4, 0.4), "no setpoint was sent"),
    ],
)
def test_a_stop_that_is_none_is_found(speeds, saying):
    assert any(saying in problem for problem in check_stop(ARM, course(*speeds), 0.020))


def test_a_way_back_in_the_reach_of_the_ramp_is_rest():
    assert check_stop(ARM, course(*SLOWING, *(-0.1,) * 6, 0.0), 0.020) == []


def test_a_stop_that_begins_late_is_found():
    late = [one._replace(time=one.time + 0.05) for one in course(*SLOWING)]
    assert any("came 0.0" in problem for problem in check_stop(ARM, late, 0.020))


@pytest.mark.parametrize("number", [nan, inf, -inf])
def test_a_setpoint_that_is_no_number_is_found(number):
    assert check_limits(ARM, [Sent(0.0, (number, *HOME[1:]))])


def test_a_setpoint_beyond_a_limit_is_found():
    for i, joint in enumerate(ARM.joints):
        for end in (joint.lower + POSITION_MARGIN - 1e-3, joint.upper - POSITION_MARGIN + 1e-3):
            q = HOME.copy()
            q[i] = end
            assert check_limits(ARM, [Sent(0.0, tuple(q))])
    assert check_limits(ARM, [Sent(0.0, tuple(HOME))]) == []
    assert check_limits(ARM, [Sent(0.0, tuple(HOME[:6]))])


def test_a_setpoint_faster_than_a_joint_is_found():
    velocity = ARM.joints[0].velocity
    assert check_limits(ARM, course(0.999 * velocity)) == []
    assert check_limits(ARM, course(1.001 * velocity))


def test_setpoints_are_read_from_the_bytes():
    # As iiwaPy3 writes them; another command is none.
    lines = [
        (0.1, b"jpJP_1.0_2.0_3.0_4.0_5.0_6.0_7.0_\n"),
        (0.2, b"stopDirectServoJoints\n"),
        (0.3, b"jpExT_1.0_2.0_3.0_4.0_5.0_6.0_-7.5e-05_\n"),
        (0.4, b"jRelVel_0.1_\n"),
    ]
    read = setpoints_of(lines)
    assert [one.time for one in read] == [0.1, 0.3]
    assert read[1].q[-1] == -7.5e-05


class Seen:
    """What a stage shows to the judge, written by hand: a stop as it should be."""

    def __init__(self):
        self.scenario = SimpleNamespace(settings=RigSettings(), out=None)
        text = "_".join
        sent = [
            (one.time, f"jpJP_{text(f'{angle:.9g}' for angle in one.q)}_\n".encode())
            for one in course(*SLOWING, *(0.0,) * 20)
        ]
        self.robot_tap = SimpleNamespace(sent=sent)
        self.injected_at, self.held_at_start = 0.012, False
        self.messages = [
            ReceivedMessage(-1.0, "home", ""),
            ReceivedMessage(0.020, "stopping", "look at the cable"),
        ]
        self.observations = [ArmObservation(0.002 * i, 0.1, tuple(HOME)) for i in range(500)]


ENDED = RunEnd(outcome=Outcome.ENCODER_STALE, evidence={"text": "old"})


def judged(seen, outcome=ENDED, **changes):
    expected = {
        "ends": frozenset({Outcome.ENCODER_STALE}),
        "within": 0.01,
        "stoppable": True,
        "says": "cable",
    }
    return judge(seen, outcome, Fault("", "", "", **expected | changes))


def test_a_stop_as_it_should_be_has_no_problems():
    assert judged(Seen()) == []


def test_the_judge_finds_each_thing_that_is_wrong():
    assert any("ended with" in one for one in judged(Seen(), RunEnd(outcome=Outcome.TICK)))
    assert any("no message contains" in one for one in judged(Seen(), says="coupling"))
    assert any("after the fault" in one for one in judged(Seen(), within=0.005))

    seen = Seen()
    seen.held_at_start = True
    assert any("the hand held" in one for one in judged(seen))
    assert judged(seen, held_at_start=True) == []

    seen = Seen()
    seen.messages.append(ReceivedMessage(0.5, "balancing", ""))
    assert any("went on after its stop" in one for one in judged(seen))

    seen = Seen()
    seen.observations[-1] = ArmObservation(1.0, 0.1, tuple(HOME + 0.02))
    assert any("at the end" in one for one in judged(seen))

    seen = Seen()
    seen.observations[100] = ArmObservation(0.2, 0.23, tuple(HOME))
    assert any("from home" in one for one in judged(seen))

    seen = Seen()
    seen.robot_tap.sent.insert(-3, (0.06, b"stopDirectServoJoints\n"))
    assert any("after the servo had ended" in one for one in judged(seen))

    seen = Seen()
    seen.injected_at = None
    assert any("ended before the fault" in one for one in judged(seen))

    seen = Seen()
    seen.observations[400:] = [ArmObservation(0.8, 0.1, tuple(HOME + 0.1))] * 100
    assert any("moved by 0.100 rad after the stop" in one for one in judged(seen))

    assert any("software can stop" in one for one in judged(Seen(), stoppable=False))

    seen = Seen()
    del seen.messages[1:]
    assert any("received no message" in one for one in judged(seen, says=""))


def test_a_lost_robot_has_to_be_told_within_100_ms():
    words = "software cannot stop the robot: press the E-stop"
    lost = RunEnd(outcome=Outcome.ENCODER_STALE, stoppable=False)
    for late, good in ((0.099, True), (0.101, False)):
        seen = Seen()
        seen.messages[1] = ReceivedMessage(seen.injected_at + late, "fault", words)
        assert (judged(seen, lost, stoppable=False, says="", within=1.0) == []) is good
    seen = Seen()
    seen.messages[1] = ReceivedMessage(0.02, "fault", "the link is gone")
    assert any("no message says" in one for one in judged(seen, lost, stoppable=False, says=""))


def test_a_refused_run_sends_nothing():
    seen = Seen()
    refused = {"ends": frozenset({Outcome.ERROR}), "says": ""}
    assert any("setpoints were sent" in one for one in judged(seen, RunEnd(), **refused))
    del seen.robot_tap.sent[1:]
    assert judged(seen, RunEnd(), **refused) == []


def test_the_arm_of_the_faults_is_the_one_that_the_policy_knows():
    assert ARM.digest == iiwa(7).digest
