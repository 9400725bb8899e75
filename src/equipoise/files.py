"""Files of Equipoise: readable JSON with format, digest and provenance.

A file is `{format, digest, provenance, body}`. The body is a frozen pydantic model. The digest is
the SHA-256 of its canonical JSON, so that a truncated, damaged or edited body is rejected (it
detects corruption, not forgery, and does not cover the provenance). NaN, infinity and bodies with
other fields are rejected. Files are written atomically.
"""

import errno
import hashlib
import json
import os
import platform
import re
import sys
import threading
from collections.abc import Generator, Iterable, Mapping
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, BinaryIO, ClassVar, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from equipoise.errors import ArtefactError, InputError, OutsideError

StrPath = str | os.PathLike[str]
"""Type of a path of a file or folder in public functions."""

DIGEST_PREFIX = "sha256:"
"""Prefix of a digest, which names its algorithm."""
MEBIBYTE: Final = 2**20
"""Bytes per mebibyte."""
MAX_FILE_SIZE: Final = 128 * MEBIBYTE
"""Size limit of a file of Equipoise [bytes]: an evaluation of a million trials with its baselines
takes about 100 MB."""
MAX_QUOTE_LENGTH: Final = 60
"""Length limit of a quoted value in a message [characters]: a line of a terminal."""


class Value(BaseModel):
    """Frozen model of a value in a file; unknown fields, NaN and infinity are rejected."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True
    )

    @classmethod
    def read(cls, tree: Any) -> Self:
        """Return the value of a file's contents; neither true nor a text is a number there.

        Raises:
            ValidationError: A field is unknown or has an invalid value.
        """
        return cls.model_validate_json(json.dumps(tree, default=str), strict=True)


Name = Annotated[str, Field(max_length=1024)]
"""Name, digest or address; no file system allows longer file names."""
Sentence = Annotated[str, Field(max_length=4096)]
"""Text of a warning: a few lines of a terminal."""
Number = Annotated[float, Field(ge=-1e12, le=1e12)]
"""Quantity in SI units without a tighter bound: its square and its products stay finite."""
Count = Annotated[int, Field(ge=0, le=2**53)]
"""Count; a float represents every integer up to the limit."""
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
"""Share or probability."""
Seed = Annotated[int, Field(ge=0, lt=2**63)]
"""Seed of random numbers for compiled code."""


EstimateSource = Literal["identified", "given", "assumed"]
"""Origin of a number: identified from a recording, given by the user, or assumed."""


class Estimate(Value):
    """A number with its uncertainty and its origin."""

    value: Number
    """Best value."""
    low: Number
    """Lower end of the 95 % interval."""
    high: Number
    """Upper end of the 95 % interval."""
    source: EstimateSource
    """Origin of the number."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.low <= self.value <= self.high:
            raise ValueError(
                f"the value {self.value:g} is outside its interval, {self.low:g} to {self.high:g}"
            )
        return self

    @classmethod
    def around(cls, value: float, half_width: float, source: EstimateSource) -> Self:
        """Return an estimate with a symmetric interval."""
        return cls(value=value, low=value - half_width, high=value + half_width, source=source)

    @classmethod
    def normal(cls, value: float, sigma: float, source: EstimateSource) -> Self:
        """Return an estimate whose error is normal with standard deviation `sigma`."""
        return cls.around(value, 1.96 * sigma, source)

    @property
    def half_width(self) -> float:
        """Half the width of the 95 % interval."""
        return (self.high - self.low) / 2.0

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval."""
        return self.low, self.high

    def not_negative(self) -> "Estimate":
        """Return the estimate with value and interval limited to non-negative numbers."""
        ends = {name: max(getattr(self, name), 0.0) for name in ("value", "low", "high")}
        return self.model_copy(update=ends)


def package_versions() -> dict[str, str]:
    """Return the versions of Equipoise and of the libraries that affect numerical results."""
    packages = ("equipoise", "numpy", "numba", "scipy", "mujoco")
    return {name: metadata.version(name) for name in packages}


class Provenance(Value):
    """Provenance of a file."""

    created: str
    """Time of writing, UTC, ISO 8601."""
    command: str
    """Command or function that created the value."""
    software: dict[str, str]
    """Versions of Equipoise, Python and the libraries that affect numerical results."""
    inputs: dict[str, str] = {}
    """Digests of the inputs, by name."""

    @classmethod
    def now(cls, command: str, inputs: Mapping[str, str] | None) -> Self:
        """Return the provenance of a value that this installation creates now."""
        machine = {"python": platform.python_version(), "machine": platform.machine()}
        return cls(
            created=datetime.now(UTC).isoformat(timespec="seconds"),
            command=command,
            software=machine | package_versions() | {"system": sys.platform},
            inputs=dict(inputs or {}),
        )


class Artefact(Value):
    """Value with its own file format."""

    FORMAT: ClassVar[str]
    """Name of the format in the file."""

    @property
    def digest(self) -> str:
        """SHA-256 of the canonical JSON of the value."""
        return _digest(self.model_dump(mode="json"))

    def save(
        self, path: StrPath, *, command: str = "python", inputs: Mapping[str, str] | None = None
    ) -> None:
        """Write the value to `path` atomically.

        Args:
            path: The file; a missing folder is created.
            command: Command or function that created the value.
            inputs: Digests of the inputs, by name.

        Raises:
            OutsideError: The disk rejects the file.
        """
        body = self.model_dump(mode="json")
        document = {
            "format": self.FORMAT,
            "digest": _digest(body),
            "provenance": Provenance.now(command, inputs).model_dump(mode="json"),
            "body": body,
        }
        write_atomically(Path(path), _readable(document) + "\n")

    @classmethod
    def load(cls, path: StrPath) -> Self:
        """Read a value from `path`.

        Raises:
            ArtefactError: The file is missing, corrupt, edited, or of another format.
        """
        document = read_document(Path(path))
        if document["format"] != cls.FORMAT:
            raise ArtefactError(
                f"{path} holds {quoted(document['format'])}, expected {cls.FORMAT!r}; "
                "give a file of that kind"
            )
        try:
            return cls.read(document["body"])
        except ValidationError as error:
            raise ArtefactError(
                f"{path} is not a valid {cls.FORMAT!r} file: {first_fault(error)}; upgrade "
                "Equipoise, or make the file again"  # the digest excludes a damaged file
            ) from None


def read_document(path: Path) -> dict[str, Any]:
    """Read a file of Equipoise of any format and verify its digest.

    Returns:
        The keys format, digest, provenance and body.

    Raises:
        ArtefactError: The file is missing, not of Equipoise, or does not match its digest.
    """
    text = read_text(path, MAX_FILE_SIZE, "a file of Equipoise", ArtefactError)
    kinds = {"format": str, "digest": str, "provenance": dict, "body": dict}
    remedy = "make the file again, or give a file that Equipoise wrote"
    try:
        document: Any = json.loads(text)
        if any(type(document[key]) is not kind for key, kind in kinds.items()):
            raise ValueError(f"expected the keys {', '.join(kinds)}")
        matches = document["digest"] == _digest(document["body"])
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        what = f"is not a file of Equipoise, or was cut short ({shortened(str(error))})"
        raise ArtefactError(f"{path} {what}; {remedy}") from None
    if not matches:
        raise ArtefactError(f"{path} does not match its digest: it was edited or damaged; {remedy}")
    return document


def read_bytes(path: Path, limit: int, kind: str, error: type[InputError]) -> bytes:
    """Read a file of limited size.

    Args:
        path: The file, or a pipe.
        limit: Size limit [bytes], also of the memory use.
        kind: Expected kind of file, with its article, for messages.
        error: Class of the errors.

    Raises:
        InputError: The file is missing, unreadable or too large; an instance of `error`.
    """
    try:
        with Path(path).open("rb") as file:
            data = file.read(limit + 1)
    except FileNotFoundError:
        raise error(f"there is no file {path}; check the path") from None
    except (OSError, ValueError) as refusal:
        reason = getattr(refusal, "strerror", None) or refusal
        raise error(f"cannot read {path}: {reason}; give {kind}") from None
    if len(data) > limit:
        size = f"{limit / MEBIBYTE:.2g} MiB"
        raise error(f"{path} is larger than {size}, the limit for {kind}; give a smaller one")
    return data


def read_text(path: Path, limit: int, kind: str, error: type[InputError]) -> str:
    """Read a text file; arguments and errors are those of `read_bytes` and `decode_text`."""
    return decode_text(read_bytes(path, limit, kind, error), path, kind, error)


def decode_text(data: bytes, path: Path, kind: str, error: type[InputError]) -> str:
    """Return the text of a file in UTF-8, with or without a byte-order mark.

    Args:
        data: Content of the file.
        path: The file, for messages.
        kind: Expected kind of file, with its article, for messages.
        error: Class of the errors.

    Raises:
        InputError: The file is no text in UTF-8; an instance of `error`.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise error(f"{path} is not text in UTF-8; give {kind} in UTF-8")
    return text


def first_fault(error: ValidationError) -> str:
    """Return the first fault of a validation: path of the field, expected and actual value."""
    first = error.errors(include_url=False, include_context=False)[0]
    where = ".".join(shortened(str(part)) for part in first["loc"])
    what = shortened(first["msg"].removeprefix("Value error, "), 5 * MAX_QUOTE_LENGTH)
    if first["type"] == "extra_forbidden":
        what = "there is no such field"
    # A fault of a whole value names its parts.
    got = "" if first["type"] in ("missing", "value_error") else f", got {quoted(first['input'])}"
    return f"{where}: {what}{got}" if where else f"{what}{got}"


def quoted(value: Any) -> str:
    """Return the `repr` of a value from a file, shortened for a message.

    Example:
        >>> quoted(0.97), quoted("off")
        ('0.97', "'off'")
    """
    if isinstance(value, float):
        return f"{value:.10g}"
    return shortened(repr(value), 2 * MAX_QUOTE_LENGTH)


def shortened(text: str, length: int = MAX_QUOTE_LENGTH) -> str:
    """Return a text on one line of at most `length` characters."""
    line = " ".join(text.splitlines())
    return line if len(line) <= length else f"{line[: length - 3]}..."


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file atomically: write a temporary file, then rename it.

    Raises:
        OutsideError: The disk rejects the file.
    """
    if not path.name:
        raise OutsideError(f"cannot write {path}: it names a folder; give the name of a file")
    data = content.encode() if isinstance(content, str) else content
    temporary = temporary_name(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        raise OutsideError(f"cannot write {path}: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def temporary_name(path: Path) -> Path:
    """Return a hidden path in the folder of a file, unique to this process and thread."""
    # File systems limit names to 255 bytes, so a long name is truncated.
    name = os.fsdecode(os.fsencode(path.name)[:150])
    return path.with_name(f".{name}.{os.getpid()}.{threading.get_ident()}.tmp")


@contextmanager
def reserved(paths: Iterable[Path], *, replace: bool = False) -> Generator[None]:
    """Reserve the names of files and folders, so that no other process writes them.

    A reservation is a lock on a hidden file beside, which the system releases when the process ends
    in any way.

    Args:
        paths: Their paths; missing folders above are created.
        replace: Whether existing files are accepted, and folders that have some.

    Raises:
        FileExistsError: A file exists, a folder has one, or another process writes it.
        OSError: A folder cannot be written.
    """
    with ExitStack() as locks:
        for path in paths:
            path.parent.mkdir(parents=True, exist_ok=True)
            marker = path.with_name(f".{path.name}.lock")
            file = locks.enter_context(marker.open("ab"))
            free = lock(file) and os.fstat(file.fileno()).st_nlink > 0
            if free:
                locks.callback(marker.unlink)
            taken = any(path.glob("[!.]*")) if path.is_dir() else path.exists()
            if not free or (taken and not replace):
                raise FileExistsError(errno.EEXIST, "taken", str(path))
        yield


def lock(file: BinaryIO) -> bool:
    """Lock a file until it is closed; return whether no other process had locked it.

    Raises:
        OutsideError: The system is Windows.
    """
    try:
        import fcntl
    except ImportError:
        raise OutsideError(
            "Equipoise has no file locks on Windows; run this command in WSL 2: see "
            "docs/how-to/trouble.md"
        ) from None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True  # this disk has no file locks
    return True


def value_digest(value: BaseModel, *, exclude: dict[str, Any] | None = None) -> str:
    """Return the SHA-256 of the canonical JSON of a frozen value.

    Args:
        value: The value.
        exclude: Excluded fields, in the form of `model_dump`.
    """
    return _digest(value.model_dump(mode="json", exclude=exclude))


def _digest(body: Any) -> str:
    canonical = json.dumps(body, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return DIGEST_PREFIX + hashlib.sha256(canonical.encode()).hexdigest()


def _readable(document: Any) -> str:
    """Return JSON with one line per field, and lists of numbers on one line each."""
    text = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False)
    # No text in JSON holds a raw line break: the pattern matches lists alone.
    return re.sub(
        r"\[\n *([^][{}]*)\n *\]", lambda row: "[" + re.sub(r"\n *", " ", row[1]) + "]", text
    )
