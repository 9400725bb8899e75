"""Memory of a run that a console of the same user may watch.

The rings of a run (`equipoise.logs.recorder`) lie in a file without a disk behind it, in a folder
that only this user can enter. An observer maps the same file: it reads rows without taking them,
and writes to one ring of words, so that the run never waits for an observer and cannot tell whether
one is alive. Two file locks, which the system releases when a process ends in any way, mark the run
as alive and its ring of words as taken.
"""

import mmap
import os
import shutil
import stat
import tempfile
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Final

from pydantic import Field

from equipoise.artefacts import Name, Value, lock, write_whole
from equipoise.errors import OutsideError
from equipoise.logs.recorder import Recorder
from equipoise.model.arms.arm import Arm
from equipoise.outcomes import Phase

FOLDER: Final = Path("/dev/shm") if Path("/dev/shm").is_dir() else Path(tempfile.gettempdir())
"""Folder for files without a disk on Linux; elsewhere that of temporary files."""
PREFIX: Final = f"equipoise-{os.getuid() if hasattr(os, 'getuid') else 0}-"
"""Begin of the names of this user's runs."""
CONSOLE: Final = "console"
"""File that the console with the ring of words has locked."""


class RunInfo(Value):
    """Description of a run for its observers."""

    title: Name
    """Robot, policy or world, for the heading."""
    pid: int
    """Process that owns the run."""
    arm: Arm
    """The arm."""
    phases: Annotated[tuple[Phase, ...], Field(max_length=64)] = ()
    """Phases by their number in the ticks' column `state`."""
    duration: float | None = None
    """Requested duration of the balancing [s]."""


@contextmanager
def share(info: RunInfo) -> Generator[Path]:
    """Create the memory of a run, and remove it at the end.

    Yields:
        The folder, for `open_recorder` in this process and in others.

    Raises:
        OutsideError: The memory cannot be created.
    """
    for leftover in _folders():
        if (leftover / "alive").exists() and not is_alive(leftover):  # its process was killed
            shutil.rmtree(leftover, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=FOLDER))
    try:
        with (folder / "alive").open("wb") as alive:
            lock(alive)
            size = Recorder.buffer_size(len(info.arm.joints))
            try:
                (folder / "memory").write_bytes(bytes(size))  # not sparse: a full disk shows here
                (folder / CONSOLE).touch()
                # An observer waits for this file.
                write_whole(folder / "run.json", info.model_dump_json())
            except OSError as error:
                message = f"cannot create {size} bytes of shared memory in {FOLDER}: {error}"
                raise OutsideError(message) from None
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def open_recorder(folder: Path, joints: int) -> Recorder:
    """Map the rings of a run into this process.

    Args:
        folder: Folder from `share`.
        joints: Number of joints of the arm.

    Raises:
        OSError: The run has ended.
    """
    with (folder / "memory").open("r+b") as file:
        return Recorder(joints, memoryview(mmap.mmap(file.fileno(), 0)))


def read_info(folder: Path) -> RunInfo:
    """Return the description of a run.

    Raises:
        OSError: The run has ended.
        ValueError: The run is one of another version of Equipoise.
    """
    return RunInfo.model_validate_json((folder / "run.json").read_text(encoding="utf-8"))


def live_runs() -> list[Path]:
    """Return the folders of this user's runs on this machine, the newest first."""
    return [folder for folder in _folders() if is_alive(folder) and (folder / "run.json").exists()]


def _folders() -> list[Path]:
    """Return the folders of this user's runs, alive or not, the newest first."""
    found: list[tuple[float, Path]] = []
    for folder in FOLDER.glob(f"{PREFIX}*"):
        with suppress(OSError):
            status = folder.lstat()
            own = not hasattr(os, "getuid") or status.st_uid == os.getuid()
            if own and stat.S_ISDIR(status.st_mode) and not status.st_mode & 0o077:
                found.append((status.st_ctime, folder))
    return [folder for _, folder in sorted(found, reverse=True)]


def is_alive(folder: Path) -> bool:
    """Return whether the process of a run is alive."""
    try:
        with (folder / "alive").open("rb") as file:
            return not lock(file)
    except OSError:
        return False
