"""Faults of the machine: full disk, power loss, date."""

import shutil
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from equipoise import EquipoiseError, RunLog
from equipoise.outcomes import Outcome
from tests.faults.harness import Trigger
from tests.faults.table import Fault

MAX_LOG_LOSS = 2.0
"""Maximum time missing at the end of a log [s]: an open chunk, and rows not yet drained."""


def _with_a_log(scenario):
    return replace(scenario, out=Path(tempfile.mkdtemp(prefix="equipoise-")) / "run.mcap")


def _fill_the_disk(harness):
    """Forbid all files of this process to grow, as a full disk does."""
    import resource  # Unix only

    size = harness.scenario.out.stat().st_size
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    harness.undo.append(lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limits))
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    harness.disk_is_full = True


def _cut_the_power(harness):
    log = harness.scenario.out
    shutil.copy(log, log.with_suffix(".cut"))


def _readable(suffix):
    """Return a check that a log reaches to just before the fault."""

    def check(harness):
        path = harness.scenario.out.with_suffix(suffix)
        try:
            ticks = RunLog.load(path, damaged=True).tables["tick"]["time"]
        except EquipoiseError as error:
            return (f"the log cannot be read: {error}",)
        finally:
            shutil.rmtree(path.parent)
        late = harness.injected_at - float(ticks[-1])
        return (f"the log ends {late:.1f} s early",) if late > MAX_LOG_LOSS else ()

    return check


def _step_the_date(harness):
    real = time.time
    harness.undo.append(lambda: setattr(time, "time", real))
    time.time = lambda: real() - 3600.0


SURVIVED = frozenset({Outcome.SURVIVED})
MOMENT = Trigger("balancing", 1.5)
# fmt: off
FILES = (
    Fault("disk full", SURVIVED, _fill_the_disk, MOMENT, _with_a_log, check=_readable(".mcap")),
    Fault("power cut in the log", SURVIVED, _cut_the_power, MOMENT, _with_a_log,
          check=_readable(".cut")),
    Fault("wall clock stepped", SURVIVED, _step_the_date),
)
# fmt: on
