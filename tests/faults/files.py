"""Faults of the machine: full disk, power loss, date."""

import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from equipoise.errors import EquipoiseError
from equipoise.logs.run_log import RunLog
from equipoise.outcomes import Outcome
from tests.faults.harness import FaultHarness, Scenario, Trigger
from tests.faults.table import Fault, Inject

MAX_LOG_LOSS: Final = 2.0
"""Maximum time missing at the end of a log [s]: an open chunk, and rows not yet drained."""
HOUR: Final = 3600.0
"""Step of the date [s]."""


def _with_a_log(scenario: Scenario) -> Scenario:
    return replace(scenario, out=Path(tempfile.mkdtemp(prefix="equipoise-")) / "run.mcap")


def _log(harness: FaultHarness) -> Path:
    path = harness.scenario.out
    return Path() if path is None else path


# The disk.


def _fill_the_disk(harness: FaultHarness) -> None:
    """Forbid all files of this process to grow, as a full disk does."""
    import resource  # Unix only

    size = _log(harness).stat().st_size
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    harness.undo.append(lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limits))
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    harness.disk_is_full = True


def _cut_the_power(harness: FaultHarness) -> None:
    shutil.copy(_log(harness), _log(harness).with_suffix(".cut"))


def _readable(suffix: str) -> Callable[[FaultHarness], Sequence[str]]:
    """Return a check that a log reaches to just before the fault."""

    def check(harness: FaultHarness) -> Sequence[str]:
        path = _log(harness).with_suffix(suffix)
        try:
            ticks = RunLog.load(path, damaged=True).tables["tick"]["time"]
        except EquipoiseError as error:
            return (f"the log cannot be read: {error}",)
        finally:
            shutil.rmtree(path.parent)
        last, fault = float(ticks[-1]), harness.injected_at or 0.0
        return (f"the log ends {fault - last:.1f} s early",) if last < fault - MAX_LOG_LOSS else ()

    return check


# The date.


def _step_the_date(harness: FaultHarness) -> None:
    real = time.time
    harness.undo.append(lambda: setattr(time, "time", real))
    time.time = lambda: real() - HOUR


LASTED: Final = frozenset({Outcome.LASTED})


def _with_log(name: str, inject: Inject, suffix: str) -> Fault:
    """Return a fault while balancing with a log, of which the file with a suffix is checked."""
    moment, check = Trigger("balancing", 1.5), _readable(suffix)
    return Fault(name, LASTED, inject, moment, _with_a_log, check=check)


FILES: Final = (
    _with_log("disk full", _fill_the_disk, ".mcap"),
    _with_log("power cut in the log", _cut_the_power, ".cut"),
    Fault("wall clock stepped", LASTED, _step_the_date),
)
"""Faults of files and of the date."""
