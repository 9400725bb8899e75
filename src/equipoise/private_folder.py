"""Folders that nobody else may write in, for files that are run as code when they are read.

Machine code is cached in pickles, and a pickle runs code. A cache folder is used only if it and all
that leads to it, links included, belong to this user or to the system, and nobody else may write
there: then nobody else can have put a file into it. Windows has no such bits; nothing is checked
there.
"""

import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final

MOST_LINKS: Final = 40
"""Limit on the symbolic links in a path, as Linux has it."""
OTHERS: Final = stat.S_IWGRP | stat.S_IWOTH
"""Permission of others to write."""


def make_private_folder(path: Path) -> None:
    """Make a folder, and those above it, for this user alone; leave one that exists as it is.

    Raises:
        OSError: It cannot be made.
    """
    for folder in (*reversed(path.parents), path):
        try:
            folder.mkdir(mode=0o700)
        except OSError:
            if not folder.is_dir():
                raise


def writable_by_others(folder: Path, *, contents: bool = True) -> str:
    """Return why somebody else might have written in a folder; empty if nobody else can.

    Args:
        folder: A folder that exists.
        contents: Look at what is in it as well.

    Raises:
        OSError: It cannot be looked at.
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
            continue  # nobody else gets as far as its permissions
        if fault := _fault(place, status, sticky=False):
            return fault
    return ""


def _steps(path: Path) -> Iterator[Path]:
    """Yield every folder and every link that a path leads through, and last where it ends."""
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
        if links > MOST_LINKS:
            raise OSError(f"too many symbolic links in {path}")
        target = step.readlink()
        if target.is_absolute():
            here = Path(target.anchor)
        left += reversed(target.parts[1:] if target.is_absolute() else target.parts)
    yield here


def _fault(place: Path, status: os.stat_result, *, sticky: bool) -> str:
    """Return why others might replace or change a file, link or folder.

    Args:
        place: Where it is.
        status: Its own, not that of what it links to.
        sticky: Others may write in a folder whose sticky bit keeps them from replacing what is
            there.
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
    """Return whether a group has no member but this user, as many systems give each user one."""
    import grp
    import pwd

    try:
        me = pwd.getpwuid(os.geteuid())
        members = set(grp.getgrgid(group).gr_mem)
    except KeyError:
        return False
    members |= {user.pw_name for user in pwd.getpwall() if user.pw_gid == group}
    return members <= {me.pw_name}
