"""Rehearse: everything that may go wrong on a rig goes wrong, and is judged by how it ends.

In virtual time the whole course of `equipoise deploy` runs, from the first byte on, on an emulated
rig on which one thing is broken (`stage`, `faults`, `files`). What is sent and what really moves
decides whether it ended as it should (`judgement`).
"""

from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ProcessPoolExecutor
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
"""All that can be shown in virtual time."""


class Result(NamedTuple):
    """How a fault ended."""

    name: str
    """Which fault."""
    kind: str
    """What it is a fault of."""
    injected: str
    """What went wrong, and when."""
    should: str
    """What had to happen."""
    did: str
    """What did."""
    problems: tuple[str, ...]
    """What was not as it should be."""
    ran: bool = True
    """Whether it was tried at all."""

    @property
    def good(self) -> bool:
        """Whether it ended as it should, or was not tried."""
        return not self.problems


def rehearse(fault: Fault) -> Result:
    """Let a fault happen in virtual time, and judge how it ends."""
    told = (fault.name, fault.kind, fault.injected, fault.should)
    if fault.play is not None:
        problems = fault.play()
        return Result(*told, "it was refused" if not problems else "", tuple(problems))
    stage = FaultHarness(fault.scene(Scenario()), fault.moment, fault.inject)
    outcome = stage.run()
    problems = [
        *judge(
            stage,
            outcome,
            ends=fault.ends,
            within=fault.within,
            stoppable=fault.stoppable,
            says=fault.says,
            held_at_start=fault.held_at_start,
        ),
        *fault.check(stage),
    ]
    if isinstance(outcome, EquipoiseError):
        did = f"refused: {outcome}"
    else:
        did = f"{outcome.cause}: {outcome.reason}"
    words = [one.time for one in stage.told if one.name in ("stopping", "fault")]
    if fault.within is not None and words and stage.broken_at is not None:
        did += f" ({1e3 * (words[0] - stage.broken_at):.0f} ms after the fault)"
    return Result(*told, did, tuple(problems))


def choose(only: Sequence[str]) -> tuple[list[Fault], list[LiveFault]]:
    """Return the faults of these names or kinds; all if none is given.

    Raises:
        InputError: There is none of that name.
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
    real_time: bool = False,
    workers: int = 1,
    begin: Callable[[str], None] = lambda _: None,
) -> Generator[Result]:
    """Yield how each fault ends, in the order of the list.

    Args:
        only: Names or kinds; all if empty.
        real_time: Whether faults that need real time are tried too.
        workers: Processes for those in virtual time.
        begin: Is told the name of the fault that is waited for.

    Raises:
        InputError: There is no fault of that name.
    """
    virtual, live = choose(only)
    names = [fault.name for fault in virtual]
    workers = min(workers, len(names))
    if workers > 1:
        with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
            for name, result in zip(names, pool.map(_rehearse_named, names), strict=True):
                begin(name)
                yield result
    else:
        for fault in virtual:
            begin(fault.name)
            yield rehearse(fault)
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


def _rehearse_named(name: str) -> Result:
    return rehearse(next(fault for fault in FAULTS if fault.name == name))


__all__ = ["FAULTS", "REAL_TIME", "Fault", "Result", "choose", "rehearse", "rehearse_all"]
