"""Validation of cache folders that only this user can write to.

Machine code is cached in pickles, and loading a pickle runs code. A cache folder is used only if
its whole path, links included, belongs to this user or to the system and is not writable by others,
so that no other user can add a file. Windows has no such permission bits; nothing is checked there.
"""

import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final

MAX_LINKS: Final = 40
"""Limit on the symbolic links in a path, as in Linux."""
OTHERS: Final = stat.S_IWGRP | stat.S_IWOTH
"""Permission bits for writing by others."""


def make_private_folder(path: Path) -> None:
    """Create a folder and its missing parents with access for this user alone.

    Raises:
        OSError: A folder cannot be created.
    """
    for folder in (*reversed(path.parents), path):
        try:
            folder.mkdir(mode=0o700)
        except OSError:
            if not folder.is_dir():
                raise


def writable_by_others(folder: Path, *, contents: bool = True) -> str:
    """Return the reason why others can write to a folder; empty if they cannot.

    Args:
        folder: An existing folder.
        contents: Check the contents as well.

    Raises:
        OSError: The folder cannot be read.
    """
    if os.name != "posix":
        return ""
    steps = list(_steps(folder.absolute()))
    for place in steps:
        status = place.lstat()
        if fault := _fault(place, status, sticky=place != steps[-1]):
            return fault
    if not contents:
        return ""
    shut = not steps[-1].lstat().st_mode & 0o077
    for place in sorted(steps[-1].rglob("*")):
        try:
            status = place.lstat()
        except FileNotFoundError:
            continue  # another process has renamed it
        if stat.S_ISLNK(status.st_mode):
            return f"{place} is a symbolic link"
        if shut and status.st_uid in (0, os.geteuid()):
            continue  # the folder is closed to others, so permissions of its files do not matter
        if fault := _fault(place, status, sticky=False):
            return fault
    return ""


def _steps(path: Path) -> Iterator[Path]:
    """Yield every folder and link on a path, and finally its target."""
    here, links = Path(path.anchor), 0
    left = list(reversed(path.parts[1:]))
    yield here
    while left:
        name = left.pop()
        step = here.parent if name == ".." else here / name
        if not step.is_symlink():
            here = step
            yield here
            continue
        yield step
        links += 1
        if links > MAX_LINKS:
            raise OSError(f"too many symbolic links in {path}")
        target = step.readlink()
        if target.is_absolute():
            here = Path(target.anchor)
        left += reversed(target.parts[1:] if target.is_absolute() else target.parts)
    yield here


def _fault(place: Path, status: os.stat_result, *, sticky: bool) -> str:
    """Return the reason why others can replace or change a file, link or folder.

    Args:
        place: Path of the file, link or folder.
        status: Status of `place`, not of the target of a link.
        sticky: Accept a folder that is writable by others if its sticky bit protects the contents.
    """
    if status.st_uid not in (0, os.geteuid()):
        return f"{place} belongs to another user"
    mode = status.st_mode
    if stat.S_ISLNK(mode) or not mode & OTHERS or (sticky and mode & stat.S_ISVTX):
        return ""
    if mode & stat.S_IWOTH or not _is_own_group(status.st_gid):
        return f"others may write to {place}"
    return ""


def _is_own_group(group: int) -> bool:
    """Return whether this user is the only member of a group, as in many default configurations."""
    import grp
    import pwd

    try:
        me = pwd.getpwuid(os.geteuid())
        members = set(grp.getgrgid(group).gr_mem)
    except KeyError:
        return False
    members |= {user.pw_name for user in pwd.getpwall() if user.pw_gid == group}
    return members <= {me.pw_name}
