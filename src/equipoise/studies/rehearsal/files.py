"""Faults of files and of the machine around a run: disk, power, date, and input files."""

import io
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from equipoise.control.policy import TabularPolicy, shipped_policy
from equipoise.errors import EquipoiseError, OutsideError
from equipoise.logs.run_log import RunLog
from equipoise.rigs import read_rig
from equipoise.studies.rehearsal.fault_harness import FaultHarness, Scenario, Trigger, on
from equipoise.studies.rehearsal.faults import BALANCING, Fault

MAX_LOG_LOSS: Final = 2.0
"""Maximum time missing at the end of a log [s]: an open chunk, and rows not yet drained."""
HOUR: Final = 3600.0


def _with_a_log(scenario: Scenario) -> Scenario:
    return on(scenario, out=Path(tempfile.mkdtemp(prefix="equipoise-")) / "run.mcap")


def _log(harness: FaultHarness) -> Path:
    path = harness.scenario.out
    return Path() if path is None else path


# The disk.


def _fill_the_disk(harness: FaultHarness) -> None:
    """Forbid all files of this process to grow, as a full disk does."""
    try:
        import resource
    except ImportError:
        raise OutsideError(
            f"{sys.platform} cannot limit the size of files as a full disk does; rehearse on Linux"
        ) from None
    size = _log(harness).stat().st_size
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    harness.undo.append(lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limits))
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))


def _cut_the_power(harness: FaultHarness) -> None:
    shutil.copy(_log(harness), _log(harness).with_suffix(".cut"))


def _readable(suffix: str) -> Callable[[FaultHarness], Sequence[str]]:
    """Return a check that a log reaches to just before the fault."""

    def check(harness: FaultHarness) -> Sequence[str]:
        from mcap.exceptions import McapError
        from mcap.stream_reader import StreamReader

        path = _log(harness).with_suffix(suffix)
        try:
            # MCAP's own reader is strict.
            for _ in StreamReader(io.BytesIO(path.read_bytes()), validate_crcs=True).records:
                pass
            ticks = RunLog.load(path, damaged=True).tables["tick"]["time"]
        except (EquipoiseError, McapError) as error:
            return (f"the log cannot be read: {error}",)
        finally:
            shutil.rmtree(path.parent)
        last, fault = float(ticks[-1]), harness.broken_at or 0.0
        return (f"the log ends {fault - last:.1f} s early",) if last < fault - MAX_LOG_LOSS else ()

    return check


# The date.


def _step_the_date(harness: FaultHarness) -> None:
    real = time.time
    harness.undo.append(lambda: setattr(time, "time", real))
    time.time = lambda: real() - HOUR


# Input files.


@contextmanager
def _file(name: str, text: str) -> Generator[Path]:
    with tempfile.TemporaryDirectory(prefix="equipoise-") as folder:
        path = Path(folder) / name
        path.write_text(text)
        yield path


def _refused(read: Callable[[Path], Any], name: str, text: str, says: str) -> list[str]:
    """Return the problems of a file that has to be refused."""
    with _file(name, text) as path:
        try:
            read(path)
        except EquipoiseError as error:
            return [] if says in str(error) else [f"the operator read {str(error)!r}"]
    return ["the file was taken"]


def _policy_text() -> str:
    with tempfile.TemporaryDirectory(prefix="equipoise-") as folder:
        path = Path(folder) / "policy.json"
        shipped_policy().save(path, command="rehearse", inputs={})
        return path.read_text()


def _corrupt_policy() -> list[str]:
    text = _policy_text()
    place = text.index('"Q"') + 20
    digit = next(i for i in range(place, len(text)) if text[i].isdigit())
    other = "7" if text[digit] != "7" else "3"
    changed = text[:digit] + other + text[digit + 1 :]
    return _refused(TabularPolicy.load, "policy.json", changed, "digest")


def _cut_policy() -> list[str]:
    text = _policy_text()
    return _refused(TabularPolicy.load, "policy.json", text[: len(text) // 2], "policy.json")


def _nan_policy() -> list[str]:
    text = _policy_text()
    begin = text.index("[", text.index('"actions"')) + 1
    end = min(text.index(mark, begin) for mark in ",]")
    changed = text[:begin] + "NaN" + text[end:]
    return _refused(TabularPolicy.load, "policy.json", changed, "policy.json")


def _bad_settings() -> list[str]:
    return [
        *_refused(read_rig, "rig.toml", "counts_per_revolution = 8192\n", "known:"),
        *_refused(read_rig, "rig.toml", "counts_per_rev = nan\n", "counts_per_rev"),
        *_refused(read_rig, "rig.toml", "home_deg = [90, 200, 0, -70, 0, 80, 0]\n", "rig.toml"),
    ]


def _read(name: str, injected: str, play: Callable[[], list[str]]) -> Fault:
    refused = frozenset({"refused"})
    should = "it is refused, and nothing is connected"
    return Fault(name, "input", injected, should, refused, play=play)


FILES: Final = (
    Fault(
        "disk full",
        "machine",
        "the disk takes no more, while balancing",
        "the run goes on; the log is sound to its last chunk",
        frozenset({"lasted"}),
        _fill_the_disk,
        Trigger("balancing", 1.5),
        _with_a_log,
        check=_readable(".mcap"),
    ),
    Fault(
        "power cut in the log",
        "machine",
        "the log as it lies on the disk in the middle of a balance",
        "every reader takes it, to its last chunk",
        frozenset({"lasted"}),
        _cut_the_power,
        Trigger("balancing", 1.5),
        _with_a_log,
        check=_readable(".cut"),
    ),
    Fault(
        "wall clock stepped",
        "machine",
        "the date goes back by an hour, while balancing",
        "nothing happens",
        frozenset({"lasted"}),
        _step_the_date,
        BALANCING,
    ),
    _read("corrupt policy", "a digit of its table has changed", _corrupt_policy),
    _read("policy cut short", "half of its file is missing", _cut_policy),
    _read("NaN in the policy", "one of its accelerations is NaN", _nan_policy),
    _read(
        "bad settings",
        "rig.toml with an unknown name, with NaN, with a home out of reach",
        _bad_settings,
    ),
)
"""Faults of files and of the date."""
