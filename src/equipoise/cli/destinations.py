"""Names of the files that a verb writes: an existing file is kept unless `--force` is given.

One rule for all verbs. A default name that exists is kept, and the next free number is taken
(`policy-2.json`). A name that the user gave and that exists is refused before the work begins.
`--force` replaces in both cases. Files that belong together carry the same number.

A name is chosen at the start and claimed by exclusive creation when the result is written. If
another program took the name in the meantime, the next free number is written.
"""

import os
import tempfile
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

from equipoise.cli.output import Output
from equipoise.errors import InputError, OutsideError


def _none(_: Path) -> tuple[Path, ...]:
    return ()


@dataclass(frozen=True)
class Destination:
    """File or folder that a verb writes, with the files beside it, under one number."""

    name: Path
    """Name without a number."""
    number: int = 1
    """Number in the name; 1 is not written."""
    folder: bool = False
    """Whether the result is a folder."""
    force: bool = False
    """Whether an existing result is replaced."""
    beside: Callable[[Path], Iterable[Path]] = _none
    """Returns the files that belong to a result, from its name."""

    @property
    def path(self) -> Path:
        """Name with its number."""
        if self.number == 1:
            return self.name
        stem, suffix = (self.name.name, "") if self.folder else (self.name.stem, self.name.suffix)
        return self.name.with_name(f"{stem}-{self.number}{suffix}")

    @contextmanager
    def claimed(self) -> Generator[Path]:
        """Create the files exclusively and yield the name to write.

        Files that are still empty at the end are removed: those that were not needed, or all of
        them after an error.

        Raises:
            OutsideError: The files cannot be created.
        """
        try:
            tried = ((one.path, one._create()) for one in self.numbered())
            path, made = next((path, made) for path, made in tried if made is not None)
        except OSError as error:
            raise OutsideError(f"cannot write {self.path}: {error.strerror or error}") from None
        try:
            yield path
        except OutsideError as error:
            whole = [str(file) for file in made if file.is_file() and file.stat().st_size]
            if not whole:
                raise
            raise OutsideError(f"{error}; {' and '.join(whole)} was written before") from None
        finally:
            for file in made:
                with suppress(OSError):
                    if self.folder:
                        file.rmdir()  # fails where it has files
                    elif file.stat().st_size == 0:
                        file.unlink()

    def existing(self) -> Path | None:
        """Return the first file that would be replaced; None for a free name."""
        files = (self.path, *self.beside(self.path))
        return next((file for file in files if self._taken(file)), None)

    def numbered(self) -> Iterator["Destination"]:
        """Yield this destination, then those with the numbers that follow."""
        return (replace(self, number=number) for number in count(self.number))

    def _taken(self, file: Path) -> bool:
        empty_folder = self.folder and file.is_dir() and not any(file.iterdir())
        return os.path.lexists(file) and not empty_folder

    def _create(self) -> list[Path] | None:
        """Create the files exclusively; return those created, or None if another file exists."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.folder:
            if self.existing() and not self.force:
                return None
            self.path.mkdir(exist_ok=True)
            return [self.path]
        made: list[Path] = []
        for file in (self.path, *self.beside(self.path)):
            try:
                os.close(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644))
            except FileExistsError:
                if self.force:
                    continue
                for mine in made:
                    mine.unlink(missing_ok=True)
                return None
            made.append(file)
        return made


def choose_file(
    output: Output,
    given: Path | None,
    default: str | Path,
    *inputs: Path | None,
    force: bool,
    beside: Callable[[Path], Iterable[Path]] = _none,
    suffix: str = ".json",
    option: str = "--out",
) -> Destination:
    """Choose the file or folder that a verb writes, before its work begins.

    Args:
        output: Reports which default name is kept.
        given: Name that the user gave; None for the default.
        default: Default name.
        inputs: Files that the verb reads; they are never written.
        force: Whether existing files are replaced.
        beside: Returns the files that belong to the result, from its name.
        suffix: Required end of the name; empty for a folder. An empty folder is free.
        option: Option that gives the name.

    Raises:
        InputError: The name has another suffix, it exists or is an input, or nothing can be
            written there.
    """
    name, folder = Path(default) if given is None else given, not suffix
    _check_name(name, option)
    if not folder:
        _check_suffix(name, suffix, option)  # names beside a folder's cannot be made
    chosen = Destination(name, folder=folder, force=force, beside=beside)
    there = None if force else chosen.existing()
    if there is not None and given is None:
        chosen = next(one for one in chosen.numbered() if one.existing() is None)
        output.say(f"{there} exists and is kept; the result goes to {chosen.path}")
    if folder:
        check_folder(chosen.path, option=option)
    else:
        for path in (chosen.path, *beside(chosen.path)):
            check_output(path, *inputs, suffix=path.suffix, option=option)
    if there is not None and given is not None:
        what = "exists and is not empty" if folder else "exists"
        raise InputError(f"{there} {what}; give another {option}, or --force to replace it")
    return chosen


def pictures(path: Path) -> tuple[Path, Path]:
    """Return the names of the figure beside a file."""
    return path.with_suffix(".svg"), path.with_suffix(".png")


def check_output(
    path: Path, *inputs: Path | None, suffix: str = ".json", option: str = "--out"
) -> None:
    """Check before the work begins that `path` can be written and differs from the inputs.

    Raises:
        InputError: The name has another suffix, is that of a folder or an input, or nothing can
            be written there.
    """
    _check_suffix(path, suffix, option)
    _check_name(path, option)
    if path.is_dir():
        raise InputError(f"{path} is a folder; give the name of a file to write")
    for given in inputs:
        if given is not None and path.exists() and os.path.exists(given) and path.samefile(given):
            raise InputError(f"{path} is read and would be written over; give another {option}")
    check_folder(path.parent, option=option)


def check_folder(folder: Path, *, option: str = "--out") -> None:
    """Check before the work begins that files can be written in `folder`, which may be new.

    Raises:
        InputError: They cannot.
    """
    _check_name(folder, option)
    if os.path.lexists(folder) and not folder.is_dir():
        raise InputError(f"{folder} is a file; give the name of a folder")
    there = folder.absolute()
    while not os.path.lexists(there):
        there = there.parent
    try:
        tempfile.TemporaryFile(dir=there).close()
    except OSError as error:
        raise InputError(
            f"cannot write in {there} ({error.strerror}); give another {option}"
        ) from None


def _check_suffix(path: Path, suffix: str, option: str) -> None:
    if path.suffix.lower() != suffix:
        raise InputError(f"{option} is {path}; give a name that ends in {suffix}")


def _check_name(path: Path, option: str) -> None:
    """Check that the file system accepts a name; one of 300 characters is too long.

    Raises:
        InputError: It does not.
    """
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        raise InputError(f"cannot write {path} ({error.strerror}); give another {option}") from None
