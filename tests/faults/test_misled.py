"""Wrong joints at a start, at random, on an emulated KST server."""

import numpy as np
import pytest

from equipoise.outcomes import Outcome
from equipoise.safety.rules import FIRST_LIMIT
from tests.conftest import tiers
from tests.faults.harness import FaultHarness, Scenario, Trigger
from tests.faults.verdicts import check_run, setpoints_of


@pytest.mark.parametrize("seed", tiers(range(200), [0], [1]))
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

    fault, words = (Trigger("move"), inject), bool(seed % 2)
    harness = FaultHarness(Scenario(duration=1.0), fault, words_after_stop=words, seed=seed)
    end = harness.run()
    assert check_run(harness, end) == [], (kind, end.outcome, end.reason)
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
