"""Rehearsal: each fault of a rig is injected into a run, and the end of the run is judged.

The whole of `equipoise deploy` runs in virtual time on an emulated rig with one fault
(`fault_harness`, `faults`, `files`). The bytes that are sent and the motion of the twin decide
whether the run ended as required (`verdicts`).
"""

from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from multiprocessing import get_context
from typing import Final, NamedTuple

from equipoise.errors import EquipoiseError, InputError
from equipoise.studies.rehearsal.fault_harness import FaultHarness, Scenario
from equipoise.studies.rehearsal.faults import FAULTS as ON_STAGE
from equipoise.studies.rehearsal.faults import Fault
from equipoise.studies.rehearsal.files import FILES
from equipoise.studies.rehearsal.real_time import REAL_TIME, LiveFault
from equipoise.studies.rehearsal.verdicts import judge

FAULTS: Final[tuple[Fault, ...]] = (*ON_STAGE, *FILES)
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
    problems: tuple[str, ...]
    """Differences between both."""
    ran: bool = True
    """Whether the fault was rehearsed at all."""

    @property
    def good(self) -> bool:
        """Whether the run ended as required, or did not take place."""
        return not self.problems


def rehearse(fault: Fault, scenario: Scenario | None = None) -> Result:
    """Rehearse a fault in virtual time, and judge the end.

    Args:
        fault: The fault.
        scenario: Policy and rig (default: the shipped policy on an iiwa 7).
    """
    told = (fault.name, fault.kind, fault.injected, fault.should)
    if fault.play is not None:
        problems = fault.play()
        return Result(*told, "it was refused" if not problems else "", tuple(problems))
    harness = FaultHarness(fault.scenario(scenario or Scenario()), fault.trigger, fault.inject)
    outcome = harness.run()
    problems = [
        *judge(
            harness,
            outcome,
            ends=fault.ends,
            within=fault.within,
            stoppable=fault.stoppable,
            says=fault.says,
            held_at_start=fault.held_at_start,
        ),
        *fault.check(harness),
    ]
    if isinstance(outcome, EquipoiseError):
        did = f"refused: {outcome}"
    else:
        did = f"{outcome.cause}: {outcome.reason}"
    words = [one.time for one in harness.told if one.name in ("stopping", "fault")]
    if fault.within is not None and words and harness.broken_at is not None:
        did += f" ({1e3 * (words[0] - harness.broken_at):.0f} ms after the fault)"
    return Result(*told, did, tuple(problems))


def choose(only: Sequence[str]) -> tuple[list[Fault], list[LiveFault]]:
    """Return the faults of these names or kinds (default: all).

    Raises:
        InputError: A name is unknown.
    """
    everything = (*FAULTS, *REAL_TIME)
    known = {word for fault in everything for word in (fault.name, fault.kind)}
    for word in only:
        if word not in known:
            raise InputError(
                f"there is no fault {word!r}; equipoise rig rehearse --list shows them all"
            )

    def wanted(fault: Fault | LiveFault) -> bool:
        return not only or fault.name in only or fault.kind in only

    return [one for one in FAULTS if wanted(one)], [one for one in REAL_TIME if wanted(one)]


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
    virtual, live = choose(only)
    names = [fault.name for fault in virtual]
    workers = min(workers, len(names))
    if workers > 1:
        with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
            results = pool.map(_rehearse_named, names, repeat(scenario))
            for name, result in zip(names, results, strict=True):
                begin(name)
                yield result
    else:
        for fault in virtual:
            begin(fault.name)
            yield rehearse(fault, scenario)
    for fault in live:
        told = (fault.name, fault.kind, fault.injected, fault.should)
        if not real_time:
            yield Result(*told, "needs --real-time", (), ran=False)
            continue
        begin(fault.name)
        try:
            did, problems = fault.play()
        except TimeoutError as error:
            did, problems = "", [str(error)]
        yield Result(*told, did, tuple(problems))


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
