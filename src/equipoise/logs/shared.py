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
from typing import Annotated, BinaryIO, Final

from pydantic import Field

from equipoise.artefacts import Name, Value
from equipoise.errors import OutsideError
from equipoise.logs.recorder import Recorder
from equipoise.model.arms.arm import Arm
from equipoise.outcomes import Phase

FOLDER: Final = Path("/dev/shm")
"""Folder for files without a disk on Linux; elsewhere the folder of temporary files serves."""
MEMORY: Final = "memory"
INFO: Final = "run.json"
ALIVE: Final = "alive"
"""File that the process of the run has locked."""
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
    """Phases by their number in the ticks' column `state`; empty for an emulated rig."""
    duration: float | None = None
    """Requested duration of the balancing [s]."""
    actions: Annotated[tuple[Name, ...], Field(max_length=64)] = ()
    """Words that trigger an action at any time; empty for a run, which asks questions."""
    stop: Name = "stop"
    """Word that STOP sends."""


@contextmanager
def share(info: RunInfo) -> Generator[Path]:
    """Create the memory of a run, and remove it at the end.

    Yields:
        The folder, for `open_recorder` in this process and in others.

    Raises:
        OutsideError: The memory cannot be created.
    """
    remove_leftovers()
    try:
        begun = Path(tempfile.mkdtemp(prefix=".equipoise-", dir=_parent()))
    except OSError as error:
        raise OutsideError(f"cannot create shared memory in {_parent()}: {error}") from None
    folder = begun
    try:
        with (begun / ALIVE).open("wb") as alive:
            lock(alive)
            size = Recorder.buffer_size(len(info.arm.joints))
            try:
                (begun / MEMORY).write_bytes(bytes(size))  # not sparse: a full disk shows here
                (begun / CONSOLE).touch()
                (begun / INFO).write_text(info.model_dump_json(), encoding="utf-8")
                # Complete under its name, so that an observer never sees a part of it.
                folder = begun.rename(begun.with_name(f"{_prefix()}{begun.name[11:]}"))
            except OSError as error:
                raise OutsideError(
                    f"cannot create {size} bytes of shared memory in {_parent()}: {error}"
                ) from None
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
    with (folder / MEMORY).open("r+b") as file:
        return Recorder(joints, memoryview(mmap.mmap(file.fileno(), 0)))


def read_info(folder: Path) -> RunInfo:
    """Return the description of a run.

    Raises:
        OSError: The run has ended.
        ValueError: The run is one of another version of Equipoise.
    """
    return RunInfo.model_validate_json((folder / INFO).read_text(encoding="utf-8"))


def live_runs() -> list[Path]:
    """Return the folders of this user's runs on this machine, the newest first."""
    found: list[tuple[float, Path]] = []
    for folder in _parent().glob(f"{_prefix()}*"):
        with suppress(OSError):
            status = folder.lstat()
            own = status.st_uid == _user() and stat.S_ISDIR(status.st_mode)
            if own and not status.st_mode & 0o077 and is_alive(folder):
                found.append((status.st_ctime, folder))
    return [folder for _, folder in sorted(found, reverse=True)]


def is_alive(folder: Path) -> bool:
    """Return whether the process of a run is alive."""
    try:
        with (folder / ALIVE).open("rb") as file:
            return not lock(file)
    except OSError:
        return False


def remove_leftovers() -> None:
    """Remove the memory of runs whose processes were killed."""
    for folder in _parent().glob(f"{_prefix()}*"):
        with suppress(OSError):
            if folder.lstat().st_uid == _user() and not is_alive(folder):
                shutil.rmtree(folder, ignore_errors=True)


def lock(file: BinaryIO) -> bool:
    """Lock a file until it is closed; return whether no other process had locked it."""
    try:
        import fcntl
    except ImportError:
        return True  # no rig runs on a system without file locks
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _parent() -> Path:
    return FOLDER if FOLDER.is_dir() else Path(tempfile.gettempdir())


def _prefix() -> str:
    return f"equipoise-{_user()}-"


def _user() -> int:
    return os.getuid() if hasattr(os, "getuid") else 0
