"""Runs on the emulated rig with two to four faults at random times: what holds whatever fails."""

from math import radians

import numpy as np
import pytest

from tests.conftest import tiers
from tests.faults.harness import START, FaultHarness, Scenario, Trigger
from tests.faults.table import TABLE, freeze_joints, run_off, slow_link
from tests.faults.verdicts import check_run

PHASES = {
    "homing": 1.0, "home": 0.3, "hang": 2.0, "reference": 0.5, "swing": 6.0, "excitation": 9.0,
    "lift": 3.0, "armed": 0.5, "swing-up": 5.0, "balancing": 2.5, "damping": 25.0,
}  # fmt: skip
"""Messages that a phase begins with, and the time after them within which it fails [s]."""
LISTED = [fault for fault in TABLE if fault.trigger.event != START]
"""Faults of the table that strike in a run."""


def drawn(random):
    """Return a fault whose numbers are drawn."""
    sign, part = random.choice((-1.0, 1.0)), int(random.integers(7))
    rate, most = sign * 10.0 ** random.uniform(-1.0, 1.2), 10.0 ** random.uniform(-2.0, 0.3)
    trip, held = random.uniform(0.005, 0.09), random.uniform(0.005, 0.1)
    force = random.uniform(20, 150)
    turn, counts = radians(random.uniform(5.0, 250.0)), int(random.integers(2, 300))
    kinds = {
        "run off": run_off(part, rate, most),
        "shifted": run_off(part, sign * 1e6, most),
        "frozen": freeze_joints,
        "slow link": slow_link(trip),
        "stall": lambda harness: harness.clock.stalls.append(held),
        "stops": lambda harness: harness.bench.body.stop("emergency stop"),
        "push": lambda harness: harness.bench.push(sign * turn),
        "touch": lambda harness: harness.bench.touch((sign * force, 0.0, 0.0)),
        "jump": lambda harness: setattr(harness.board, "slipped", counts),
        "key": lambda harness: harness.typed.append(str(random.choice(("stop", "", "y", "n")))),
    }
    name = str(random.choice(list(kinds)))
    return name, kinds[name]


def end_badly(seed, folder):
    """Run the faults of a seed; return its faults, its end and its problems."""
    random = np.random.default_rng([seed, 29])
    faults, names = [], []
    identify = bool(random.random() < 0.15)
    start = str(random.choice(("hand", "hanging")))
    runs = int(random.integers(1, 3)) if start == "hanging" else 1
    left_out = {"swing-up"} if start == "hand" else {"lift", "armed"}
    left_out |= set() if identify else {"excitation"}
    left_out |= set() if runs > 1 else {"damping"}
    phases = [name for name in PHASES if name not in left_out]
    last = str(random.choice(phases))
    for _ in range(int(random.integers(2, 5))):
        name, inject = drawn(random)
        if random.random() < 0.4:
            listed = LISTED[int(random.integers(len(LISTED)))]
            name, inject = listed.name, listed.inject
        # Most strike at about the same time; some long before.
        phase = last if random.random() < 0.7 else str(random.choice(phases))
        trigger = Trigger(phase, float(random.uniform(0.0, PHASES[phase])))
        faults.append((trigger, inject))
        names.append(f"{name} at {phase} + {trigger.after:.2f} s")
    words = bool(random.random() < 0.3)
    scenario = Scenario(identify=identify, start=start, runs=runs, out=folder / "run.mcap")
    harness = FaultHarness(scenario, *faults, words_after_stop=words, seed=seed)
    end = harness.run()
    return names, end.outcome, end.reason, check_run(harness, end)


@pytest.mark.parametrize("seed", tiers(range(1000), [0], range(1, 10)))
def test_whatever_fails_the_arm_stops_in_the_reach_of_its_ramp_and_says_why(seed, tmp_path):
    *run, problems = end_badly(seed, tmp_path)
    assert problems == [], run
