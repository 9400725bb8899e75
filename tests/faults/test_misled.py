"""Wrong joints, wrong starts and repeated stalls at random, on an emulated KST server."""

import numpy as np
import pytest

from equipoise.outcomes import Outcome
from equipoise.rig.run_controller import MAX_ROUND_TRIP
from equipoise.safety.monitors import MAX_REPEATS, REPEAT_WINDOW
from equipoise.safety.rules import FIRST_LIMIT
from tests.conftest import tiers
from tests.faults.harness import FaultHarness, Scenario, Trigger
from tests.faults.table import change_replies, run_off
from tests.faults.verdicts import check_run, setpoints_of, stop_time

pytestmark = pytest.mark.compiled_only

SEEDS = tiers(range(200), [0], [1])
MOVING = {"homing": 0.8, "swing": 2.5, "balancing": 0.8}
"""Messages that a motion begins with, and the time after them within which a fault begins [s]."""


def run(seed, kind, event, after, inject):
    """Run with a fault, and return the harness and the end; the run keeps all limits."""
    fault = Trigger(event, after), inject
    scenario, words = Scenario(duration=1.0), bool(seed % 2)
    harness = FaultHarness(scenario, fault, words_after_stop=words, seed=seed)
    end = harness.run()
    assert check_run(harness, end) == [], (seed, kind, end.outcome, end.reason)
    return harness, end


@pytest.mark.parametrize("seed", SEEDS)
def test_wrong_joints_at_and_after_a_stop_move_the_arm_no_further_than_its_ramp(seed):
    random = np.random.default_rng([seed, 441])
    joint, sign = int(random.integers(7)), random.choice((-1.0, 1.0))
    rate, most = sign * 10.0 ** random.uniform(-0.5, 1.2), 10.0 ** random.uniform(-1.5, 0.5)
    away, last = np.eye(7)[joint] * sign * most, []

    def shifted(reply):
        return reply if reply.q is None else reply._replace(q=tuple((reply.q + away).tolist()))

    def frozen(reply):
        last.append(reply.q) if reply.q and not last else None
        return reply._replace(q=last[0]) if reply.q else reply

    kinds = {
        "runs off": run_off(joint, rate, most),
        "shifted": change_replies(shifted),
        "frozen": change_replies(frozen),
    }
    kind, stops = str(random.choice(list(kinds))), random.uniform(-0.3, 0.3)

    def inject(harness):
        harness.after(max(stops, 0.0), lambda: harness.typed.append("stop"))
        harness.after(max(-stops, 0.0), lambda: kinds[kind](harness))

    event = str(random.choice(list(MOVING)))
    _, end = run(seed, kind, event, random.uniform(0.05, MOVING[event]), inject)
    assert end.stoppable


@pytest.mark.parametrize("seed", SEEDS)
def test_nothing_is_sent_at_a_start_that_two_agreeing_readings_do_not_confirm(seed):
    random = np.random.default_rng([seed, 442])
    joint, sign = int(random.integers(7)), random.choice((-1.0, 1.0))
    size, begin = sign * 10.0 ** random.uniform(-2.5, 1.0), random.uniform(0.0, 1.5)
    # Half a second lies between the readings: no error here spoils both alike.
    duration, rate = random.choice((0.02, 0.2, 0.4)), sign * 10.0 ** random.uniform(-2.0, 0.0)
    kind, readings = str(random.choice(("wrong", "drifts"))), []

    def inject(harness):
        bench, clock, asked = harness.bench, harness.clock, harness.clock.now()
        target, measure = bench.twin.state.servo.target, bench.body.measured

        def read():
            q = np.array(measure())
            if kind == "wrong" and 0.0 <= clock.now() - asked - begin < duration:
                q[joint] += size
            readings.append((clock.now(), q))
            return tuple(q.tolist())

        def drift(since):
            if kind == "drifts" and since < 3.0 and harness.messages[-1].name == "move":
                target[joint] += 1e-3 * rate

        bench.body.measured = read
        harness.each(drift)
        harness.after(4.0, lambda: harness.typed.append("stop"))

    harness, end = run(seed, kind, "move", 0.0, inject)
    sent = setpoints_of(harness.robot_tap.sent)
    # The server measures once more while a setpoint is on its way.
    before = [q for time, q in readings if not sent or time < sent[0].time][-2:]
    agrees = np.abs(before[1] - before[0]).max() <= FIRST_LIMIT
    refused = not agrees or "its limits" in end.reason
    assert bool(sent) is not refused, (kind, end.outcome, end.reason)
    if sent:
        assert np.abs(sent[0].q - before[1]).max() <= FIRST_LIMIT
    else:
        assert end.outcome is Outcome.ERROR
        assert "nothing was sent" in end.reason


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.full
def test_at_most_three_stalls_a_second_are_bridged(seed):
    random = np.random.default_rng([seed, 443])
    kind, begun = str(random.choice(("loop", "link", "both"))), []
    pause, event = random.uniform(0.03, 0.7), str(random.choice(list(MOVING)))

    def inject(harness):
        ends = (harness.robot.link, harness.robot.link.other)
        usual, state = ends[0].delay, {"next": 0.0, "until": -1.0}

        def stall(since):
            held = max(usual, state["until"] - since)
            for link in ends:
                link.delay = held
            if since < state["next"]:
                return
            part = kind if kind != "both" else str(random.choice(("loop", "link")))
            duration = random.uniform(0.012, 0.065)
            if part == "loop":
                harness.clock.stalls.append(duration)
            else:
                duration = max(duration, MAX_ROUND_TRIP + 0.005)
                state["until"] = since + duration
            begun.append(harness.clock.now())
            state["next"] = since + duration + pause * random.uniform(0.7, 1.3)

        harness.each(stall)
        harness.after(4.0, lambda: harness.typed.append("stop"))

    harness, end = run(seed, kind, event, random.uniform(0.05, 0.5 * MOVING[event]), inject)
    times = [time for time in begun if time <= stop_time(harness) and moves(harness, time)]
    most = max((sum(0.0 <= t - u <= REPEAT_WINDOW for t in times) for u in times), default=0)
    assert most <= MAX_REPEATS, (kind, pause, end.outcome, end.reason)


def moves(harness, time):
    """Return whether the arm moves at a time [s], by the messages before."""
    named = [message.name for message in harness.messages if message.time <= time]
    known = [name for name in named if name in (*MOVING, "home", "hang", "lift", "stopping")]
    return bool(known) and known[-1] in MOVING
