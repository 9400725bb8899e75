"""What one run went through, tick by tick, and the MCAP file that carries it.

A tick is one decision of the policy: the state that it saw, the box of that state, the acceleration
that it commanded, and what the arm did until the next tick. The file has three topics, which
Foxglove opens and plots; log time counts from the start of the run::

    /run    once, first     the conditions of the run
    /tick   once per tick   the row, by the names of `RunLog`
    /end    once, last      how long the run lasted and how it ended

Messages are JSON, compressed with zstd. The digest covers conditions and rows, so that a file that
was cut, damaged or edited is refused with one sentence. It is written whole or not at all.
"""

import hashlib
import io
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, Self, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from equipoise.artefacts import DIGEST_PREFIX, Provenance, Value, write_whole
from equipoise.errors import ArtefactError
from equipoise.settings import Settings

FORMAT: Final = "equipoise-run"
VERSION: Final = 1

Array: TypeAlias = npt.NDArray[np.float64]


class RunConditions(Value):
    """Where a run took place, and what decided about it."""

    policy: str
    """Digest of the policy that ran."""
    world: str
    """What stood in for the robot and the pendulum."""
    arm: str
    """Name of the arm."""
    joints: tuple[str, ...]
    """Names of its joints, from the base to the flange."""
    held_joint: int | None
    """The joint that does not move, counted from one."""
    pendulum: dict[str, float]
    """Numbers of the pendulum that really swung: w2 [1/s^2], k [1/m], c [1/s], coulomb [1/s^2],
    drag [1/rad]."""
    start: tuple[float, float, float, float]
    """x [m], x_dot [m/s], phi [rad], phi_dot [rad/s] at the release."""
    h: float
    """Time between ticks [s]."""
    duration: float
    """How long the run was to last [s]."""
    seed: int
    """Master seed of pendulum, start and noise."""
    settings: Settings
    """Resolved settings: gains, noise, ranges of the start."""
    cause: str
    """How the run ended: lasted, angle, track, joint limit."""


@dataclass(frozen=True, eq=False)
class RunLog:
    """One run; its arrays cannot be written to."""

    conditions: RunConditions
    """Where it took place, and how it ended."""
    time: Array
    """Start of each tick since the release [s], shape (n,)."""
    x: Array
    """Displacement of the flange from home along base x [m], shape (n,)."""
    x_dot: Array
    """Its velocity [m/s], shape (n,)."""
    phi: Array
    """Angle of the pendulum from upright [rad], shape (n,)."""
    phi_dot: Array
    """Its angular velocity [rad/s], shape (n,)."""
    box: npt.NDArray[np.int64]
    """Box of the table that held the state, shape (n,)."""
    u: Array
    """Commanded acceleration of the flange along x [m/s^2], shape (n,)."""
    tracked: Array
    """Acceleration u' of the flange over the tick [m/s^2], shape (n,)."""
    q: Array
    """All joints at the end of the tick [rad], shape (n, joints)."""
    dq: Array
    """Their velocities [rad/s], shape (n, joints)."""

    def __post_init__(self) -> None:
        """Check the shapes, and freeze the arrays.

        Raises:
            ArtefactError: Shapes that differ, or values that are no finite numbers.
        """
        count = len(self.time)
        for name in COLUMNS:
            values = np.array(getattr(self, name), dtype=np.int64 if name == "box" else np.float64)
            shape = (count, len(self.conditions.joints)) if name in ("q", "dq") else (count,)
            if values.shape != shape:
                raise ArtefactError(
                    f"{name} of a run log has shape {values.shape}, expected {shape}: "
                    "give one row per tick"
                )
            if not np.all(np.isfinite(values)):
                raise ArtefactError(
                    f"{name} of a run log holds values that are not finite; record the run again"
                )
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    @property
    def lasted(self) -> float:
        """How long the run lasted [s]."""
        return round(len(self.time) * self.conditions.h, 9)

    @property
    def digest(self) -> str:
        """SHA-256 of conditions and rows."""
        return self._digest(_json(self.conditions.model_dump(mode="json")))

    def _digest(self, conditions: bytes) -> str:
        digest = hashlib.sha256(conditions)
        for name in COLUMNS:
            values = getattr(self, name)
            digest.update(name.encode() + values.astype(values.dtype.newbyteorder("<")).tobytes())
        return DIGEST_PREFIX + digest.hexdigest()

    def save(self, path: Path, *, command: str, inputs: Mapping[str, str] | None = None) -> None:
        """Write the run to `path`, whole or not at all.

        Args:
            path: The file; its folder is made if it is missing.
            command: The verb or function that made the run.
            inputs: Digests of the values it was made from, by name.

        Raises:
            OutsideError: The disk refuses.
        """
        from mcap.writer import CompressionType, Writer

        provenance = Provenance.now(command, inputs)
        stream = io.BytesIO()
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="", library=FORMAT)
        writer.add_metadata(
            FORMAT,
            {
                "version": str(VERSION),
                "digest": self.digest,
                "provenance": provenance.model_dump_json(),
            },
        )
        channels: dict[str, int] = {}
        for topic, schema in _schemas(len(self.conditions.joints)).items():
            text = json.dumps(schema).encode()
            number = writer.register_schema(f"equipoise{topic}", "jsonschema", text)
            channels[topic] = writer.register_channel(topic, "json", number)
        for sequence, (time, topic, message) in enumerate(self._messages()):
            stamp = round(time * 1e9)
            writer.add_message(channels[topic], stamp, _json(message), stamp, sequence)
        writer.finish()
        write_whole(path, stream.getvalue())

    def _messages(self) -> Iterator[tuple[float, str, dict[str, Any]]]:
        yield 0.0, "/run", self.conditions.model_dump(mode="json")
        for row in zip(*(getattr(self, name).tolist() for name in COLUMNS), strict=True):
            yield row[0], "/tick", dict(zip(COLUMNS, row, strict=True))
        yield self.lasted, "/end", {"lasted": self.lasted, "cause": self.conditions.cause}

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a run from `path`.

        Raises:
            ArtefactError: The file is missing, corrupt, edited, not ours or newer.
        """
        metadata, messages = _read(path)
        rows = messages.get("/tick", [])
        try:
            conditions = RunConditions.model_validate_json(messages["/run"][0], strict=True)
            ticks = [json.loads(row) for row in rows]
            columns: dict[str, Any] = {name: [row[name] for row in ticks] for name in COLUMNS}
            if not ticks:
                columns |= dict.fromkeys(("q", "dq"), np.empty((0, len(conditions.joints))))
            run = cls(conditions=conditions, **columns)
        except (KeyError, IndexError, TypeError, ValueError, ValidationError):
            raise ArtefactError(
                f"{path} is not a valid {FORMAT!r} file: its messages are incomplete; "
                "record the run again"
            ) from None
        if run._digest(messages["/run"][0]) != metadata.get("digest"):
            raise ArtefactError(
                f"{path} does not match its digest: it was edited or damaged after it was "
                "written; record the run again"
            )
        return run


COLUMNS: Final = tuple(field.name for field in fields(RunLog) if field.name != "conditions")
"""Names of the arrays, in the order of a tick."""


def provenance_of(path: Path) -> Provenance:
    """Return where the run in `path` comes from.

    Raises:
        ArtefactError: The file is missing, corrupt, not ours or newer.
    """
    metadata, _ = _read(path)
    try:
        return Provenance.model_validate_json(metadata["provenance"])
    except (KeyError, ValidationError):
        raise ArtefactError(
            f"{path} does not say where it comes from; record the run again"
        ) from None


def _read(path: Path) -> tuple[dict[str, str], dict[str, list[bytes]]]:
    """Return our metadata, and the messages of each topic in their order."""
    from mcap.reader import make_reader

    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ArtefactError(f"there is no file {path}; check the path") from None
    except OSError as error:
        raise ArtefactError(f"cannot read {path}: {error.strerror}") from None
    metadata: dict[str, str] = {}
    messages: dict[str, list[bytes]] = {}
    try:
        reader = make_reader(io.BytesIO(data), validate_crcs=True)
        for record in reader.iter_metadata():
            if record.name == FORMAT:
                metadata = dict(record.metadata)
        for _, channel, message in reader.iter_messages():
            messages.setdefault(channel.topic, []).append(message.data)
    except Exception:  # a damaged length or index makes the reader fail in any way there is
        raise ArtefactError(
            f"{path} is not an MCAP file, or was cut short or damaged; record the run again"
        ) from None
    version = metadata.get("version", "")
    if not version.isdecimal():
        raise ArtefactError(f"{path} is no run log of Equipoise; give a file that it wrote")
    if int(version) > VERSION:
        raise ArtefactError(
            f"{path} has version {version} of {FORMAT!r}, this Equipoise reads up to {VERSION}; "
            "upgrade Equipoise"
        )
    return metadata, messages


def _schemas(joints: int) -> dict[str, dict[str, Any]]:
    """Return the JSON schema of each topic; Foxglove needs one to plot."""
    per_joint = {"type": "array", "items": {"type": "number"}, "minItems": joints}
    kinds: dict[str, Any] = {name: {"type": "number"} for name in COLUMNS}
    kinds |= {"box": {"type": "integer"}, "q": per_joint, "dq": per_joint}
    end = {"lasted": {"type": "number"}, "cause": {"type": "string"}}
    return {
        "/run": RunConditions.model_json_schema(),
        "/tick": {"type": "object", "properties": kinds},
        "/end": {"type": "object", "properties": end},
    }


def _json(value: Any) -> bytes:
    return json.dumps(value, separators=(",", ":"), sort_keys=True, allow_nan=False).encode()
