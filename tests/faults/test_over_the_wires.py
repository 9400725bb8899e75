"""A run over a real port and a pseudo-terminal, in real time, as the first pages show it."""

import re

import pytest

from equipoise.control.policy import shipped_policy
from equipoise.log.run_log import RunLog
from equipoise.outcomes import Outcome
from equipoise.rig.config import RigSettings
from tests.program import LONGEST, program, wait_until

ANSWERS = ((r"Type (\w+)\.", r"\1"), ("y or n", "y"))
"""Prompts of the run, and what an operator types there."""
HAND = (("button", "press"), ("Lift the pendulum", "lift"), ("Armed", "release"))
"""Prompts of the run, and what a hand does at the emulated rig."""


@pytest.mark.full
@pytest.mark.compiled_only
def test_a_policy_balances_over_the_wires_of_the_emulated_rig(tmp_path):
    balances(tmp_path, "iiwa7", "--port", "0")


def balances(tmp_path, arm, *words):
    """Balance with the shipped policy on an arm over the wires of an emulated rig."""
    policy, log = tmp_path / "policy.json", tmp_path / "run.mcap"
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
    assert RunLog.load(log).end.outcome is Outcome.SURVIVED, "\n".join(run.lines)
