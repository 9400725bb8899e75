"""A run over a real port and a pseudo-terminal, in real time, as the first pages show it."""

import re

import pytest

from equipoise import RunLog, shipped_policy
from equipoise.outcomes import Outcome
from equipoise.rig.config import RigSettings
from tests.program import LONGEST, program, wait_until

ANSWERS = ((r"Type (\w+)\.", r"\1"), ("y or n", "y"))
"""Prompts of the run, and what an operator types there."""
HAND = (("button", "press"), ("Lift the pendulum", "lift"), ("Armed", "release"))
"""Prompts of the run, and what a hand does at the emulated rig."""


@pytest.mark.full
@pytest.mark.real_time
def test_a_policy_balances_over_the_wires_of_the_emulated_rig(tmp_path):
    balances(tmp_path, "iiwa7", "--port", "0")


def balances(tmp_path, arm, *words):
    """Balance with the shipped policy on an arm over the wires of an emulated rig.

    A shared machine may take the processor away for longer than a run tolerates: such a run is
    tried again, twice.
    """
    for attempt in range(3):
        run, lines = balance(tmp_path / f"run{attempt}.mcap", arm, *words)
        if run.end.outcome is not Outcome.STALLS:
            break
    assert run.end.outcome is Outcome.SURVIVED, "\n".join(lines)


def balance(log, arm, *words):
    """Return the log of a run of 3 s, and the lines that it prints."""
    policy = log.with_suffix(".json")
    described = RigSettings(arm=arm).described_arm
    shipped_policy().model_copy(update={"arm": described}).save(policy)
    with program("rig", "emulate", "--arm", arm, *words, "--seed", "3") as rig:
        robot, encoder = (rig.find(rf"{name} +(\S+://\S+)")[1] for name in ("robot", "encoder"))
        links = ("--robot", robot, "--encoder", encoder, "--arm", arm)
        with program("deploy", str(policy), *links, "--duration", "3", "--out", str(log)) as run:
            read = 0

            def over():
                nonlocal read
                while read < len(run.lines):
                    for prompts, other in ((ANSWERS, run), (HAND, rig)):
                        for pattern, word in prompts:
                            if asked := re.search(pattern, run.lines[read]):
                                other.process.stdin.write(asked.expand(word) + "\n")
                                other.process.stdin.flush()
                    read += 1
                return run.process.poll() is not None

            wait_until(over, "end of the run", 2.0 * LONGEST)
    return RunLog.load(log), run.lines
