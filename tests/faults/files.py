"""Faults of the machine and of files: full disk, power loss, date, damaged input files."""

import re
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, Final

from equipoise.control.policy import TabularPolicy, shipped_policy
from equipoise.errors import EquipoiseError
from equipoise.logs.run_log import RunLog
from equipoise.outcomes import Outcome
from equipoise.rig.config import read_rig
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


# Input files.


def _refused(read: Callable[[Path], Any], name: str, text: str, says: str) -> list[str]:
    """Return the problems of a file that has to be refused."""
    with tempfile.TemporaryDirectory(prefix="equipoise-") as folder:
        path = Path(folder) / name
        path.write_text(text)
        try:
            read(path)
        except EquipoiseError as error:
            text = str(error)
            return [] if says in text else [f"the refusal {text!r} does not contain {says!r}"]
    return ["the file was accepted"]


def _change_digit(text: str) -> str:
    """Change the first digit well inside the table."""
    place = next(i for i in range(text.index('"Q"') + 20, len(text)) if text[i].isdigit())
    return text[:place] + ("7" if text[place] != "7" else "3") + text[place + 1 :]


def _nan_action(text: str) -> str:
    return re.sub(r'("actions":\s*\[\s*)[^],]+', r"\1NaN", text, count=1)


def _damaged(name: str, injected: str, read: Callable[[], list[str]]) -> Fault:
    """Return a fault of an input file, given a function that reads it and returns the problems."""

    def play() -> tuple[str, list[str]]:
        problems = read()
        return "" if problems else "it was refused", problems

    return Fault(name, injected, "it is refused, and nothing is connected", play=play)


def _damaged_policy(
    name: str, injected: str, damage: Callable[[str], str], says: str = "policy.json"
) -> Fault:
    """Return a fault of the shipped policy's file."""

    def read() -> list[str]:
        with tempfile.TemporaryDirectory(prefix="equipoise-") as folder:
            path = Path(folder) / "policy.json"
            shipped_policy().save(path, command="test", inputs={})
            text = path.read_text()
        return _refused(TabularPolicy.load, "policy.json", damage(text), says)

    return _damaged(name, injected, read)


BAD_SETTINGS: Final = {
    "counts_per_revolution = 8192\n": "known:",
    "counts_per_rev = nan\n": "counts_per_rev",
    "home_deg = [90, 200, 0, -70, 0, 80, 0]\n": "rig.toml",
}
"""Invalid lines of `rig.toml`, and the required words of each refusal."""


def _read_bad_settings() -> list[str]:
    refused = (_refused(read_rig, "rig.toml", *item) for item in BAD_SETTINGS.items())
    return list(chain(*refused))


LASTED: Final = frozenset({Outcome.LASTED})


def _with_log(name: str, injected: str, should: str, inject: Inject, suffix: str) -> Fault:
    """Return a fault while balancing with a log, of which the file with a suffix is checked."""
    moment, check = Trigger("balancing", 1.5), _readable(suffix)
    return Fault(name, injected, should, LASTED, inject, moment, _with_a_log, check=check)


FILES: Final = (
    _with_log(
        "disk full",
        "the disk takes no more, while balancing",
        "the run goes on; the log is sound to its last chunk",
        _fill_the_disk,
        ".mcap",
    ),
    _with_log(
        "power cut in the log",
        "the log on the disk is copied while balancing",
        "every reader reads the copy, to its last chunk",
        _cut_the_power,
        ".cut",
    ),
    Fault(
        "wall clock stepped",
        "the date goes back by an hour, while balancing",
        "nothing happens",
        LASTED,
        _step_the_date,
    ),
    _damaged_policy("corrupt policy", "a digit of its table has changed", _change_digit, "digest"),
    _damaged_policy(
        "policy cut short", "half of its file is missing", lambda text: text[: len(text) // 2]
    ),
    _damaged_policy("NaN in the policy", "one of its accelerations is NaN", _nan_action),
    _damaged(
        "bad settings",
        "rig.toml with an unknown name, with NaN, with a home out of reach",
        _read_bad_settings,
    ),
)
"""Faults of files and of the date."""
