"""Injection of a fault into a run, with a verdict on the end of the run.

The whole of `equipoise deploy` runs in virtual time on an emulated rig with one fault (`harness`,
`table`, `files`). The bytes that are sent and the motion of the twin decide whether the run ended
as required (`verdicts`). Faults of real ports and processes run in real time (`real_time`).
"""

from typing import Final

from tests.faults.files import FILES
from tests.faults.harness import FaultHarness, Scenario
from tests.faults.table import FAULTS as HARNESS_FAULTS
from tests.faults.table import Fault
from tests.faults.verdicts import judge

FAULTS: Final[tuple[Fault, ...]] = (*HARNESS_FAULTS, *FILES)
"""Faults that are injected in virtual time."""


def run_fault(fault: Fault, scenario: Scenario | None = None) -> tuple[str, list[str]]:
    """Run a fault; return a description of the end, and its differences from the required end.

    Args:
        fault: The fault.
        scenario: Policy and rig in virtual time (default: the shipped policy on an iiwa 7).
    """
    harness = FaultHarness(
        fault.scenario(scenario or Scenario()),
        (fault.trigger, fault.inject),
        words_after_stop=fault.words_after_stop,
    )
    outcome = harness.run()
    problems = [*judge(harness, outcome, fault), *fault.check(harness)]
    return f"{outcome.outcome}: {outcome.reason}", problems
