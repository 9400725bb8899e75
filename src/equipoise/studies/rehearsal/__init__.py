"""Rehearsal: injection of each fault of a rig into a run, with a verdict on the end of the run.

The whole of `equipoise deploy` runs in virtual time on an emulated rig with one fault
(`fault_harness`, `faults`, `files`). The bytes that are sent and the motion of the twin decide
whether the run ended as required (`verdicts`).
"""

from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from itertools import repeat
from multiprocessing import get_context
from typing import Final, NamedTuple

from equipoise.errors import InputError
from equipoise.studies.rehearsal.fault_harness import FaultHarness, Scenario
from equipoise.studies.rehearsal.faults import FAULTS as VIRTUAL_FAULTS
from equipoise.studies.rehearsal.faults import Fault
from equipoise.studies.rehearsal.files import FILES
from equipoise.studies.rehearsal.real_time import REAL_TIME
from equipoise.studies.rehearsal.verdicts import judge

FAULTS: Final[tuple[Fault, ...]] = (*VIRTUAL_FAULTS, *FILES)
"""Faults that can be rehearsed in virtual time."""


class Result(NamedTuple):
    """End of one fault's run."""

    name: str
    """Name of the fault."""
    kind: str
    """Subject of the fault."""
    injected: str
    """Description of the fault and its time."""
    should: str
    """Description of the required end."""
    did: str
    """Description of the actual end."""
    problems: tuple[str, ...] = ()
    """Differences between the actual and the required end."""
    ran: bool = True
    """Whether the rehearsal of the fault took place."""

    @property
    def good(self) -> bool:
        """Whether the run ended as required, or did not take place."""
        return not self.problems


def rehearse(fault: Fault, scenario: Scenario | None = None) -> Result:
    """Rehearse a fault, and judge the end.

    Args:
        fault: The fault.
        scenario: Policy and rig in virtual time (default: the shipped policy on an iiwa 7).
    """
    try:
        did, problems = fault.play() if fault.play else _run(fault, scenario or Scenario())
    except TimeoutError as error:
        did, problems = "", [str(error)]
    return _result(fault, did)._replace(problems=tuple(problems))


def _result(fault: Fault, did: str) -> Result:
    return Result(fault.name, fault.kind, fault.injected, fault.should, did)


def _run(fault: Fault, scenario: Scenario) -> tuple[str, list[str]]:
    """Run a fault in virtual time; return a description of the end, and its problems."""
    harness = FaultHarness(
        fault.scenario(scenario),
        (fault.trigger, fault.inject),
        words_after_stop=fault.words_after_stop,
    )
    outcome = harness.run()
    did = f"{outcome.cause}: {outcome.reason}"
    stops = [one.time for one in harness.messages if one.name in ("stopping", "fault")]
    if fault.within is not None and stops and harness.injected_at is not None:
        did += f" ({1e3 * (stops[0] - harness.injected_at):.0f} ms after the fault)"
    return did, [*judge(harness, outcome, fault), *fault.check(harness)]


def choose(only: Sequence[str]) -> list[Fault]:
    """Return the faults of these names or kinds (default: all); those in real time come last.

    Raises:
        InputError: A name is unknown.
    """
    known = {word for fault in (*FAULTS, *REAL_TIME) for word in (fault.name, fault.kind)}
    for word in only:
        if word not in known:
            raise InputError(
                f"there is no fault {word!r}; equipoise rig rehearse --list shows them all"
            )
    return [
        fault
        for fault in (*FAULTS, *REAL_TIME)
        if not only or fault.name in only or fault.kind in only
    ]


def rehearse_all(
    only: Sequence[str] = (),
    *,
    scenario: Scenario | None = None,
    real_time: bool = False,
    workers: int = 1,
    begin: Callable[[str], None] = lambda _: None,
) -> Generator[Result]:
    """Yield the result of each fault, in the order of the list.

    Args:
        only: Names or kinds (default: all).
        scenario: Policy and rig of the faults in virtual time (default: the shipped policy on an
            iiwa 7).
        real_time: Whether to rehearse the faults that need real time.
        workers: Number of processes for the faults in virtual time.
        begin: Receives the name of the fault that begins.

    Raises:
        InputError: A name is unknown.
    """
    faults = choose(only)
    names = [fault.name for fault in faults if not fault.real_time]
    workers = min(workers, len(names))
    with ExitStack() as stack:
        apply = map
        if workers > 1:
            pool = ProcessPoolExecutor(workers, get_context("spawn"))
            apply = stack.enter_context(pool).map
        results = apply(_rehearse_named, names, repeat(scenario))
        for fault in faults:
            if fault.real_time and not real_time:
                yield _result(fault, "needs --real-time")._replace(ran=False)
                continue
            begin(fault.name)
            yield rehearse(fault) if fault.real_time else next(results)


def _rehearse_named(name: str, scenario: Scenario | None) -> Result:
    return rehearse(next(fault for fault in FAULTS if fault.name == name), scenario)


__all__ = [
    "FAULTS",
    "REAL_TIME",
    "Fault",
    "Result",
    "Scenario",
    "choose",
    "rehearse",
    "rehearse_all",
]
