r"""Lines of the KST server, the KUKA Sunrise Toolbox's program on the cabinet: both directions.

The client sends lines of ASCII over TCP, each a command whose fields are joined by `_`; the server
answers most of them with one line. There is no length, no checksum, no sequence number and no
watchdog::

    getJointsPositions\n             0.0_0.4364_0.0_-1.3962_0.0_1.309_0.0_\n
    startDirectServoJoints\n         done\n
    jpJP_<seven numbers>_\n          1.5855032851556873E-4_0.4364_ ... _0.0_\n
    jpExT_<seven numbers>_\n         0.5_-1.25_1.0E-4_0.0_0.0_0.0_0.125_\n
    stopDirectServoJoints\n          done\n
    end\n                            (the server closes the connection and its program ends)

Angles are in radians, torques in N m, lengths in mm. Numbers of the server are those of Java's
`Double.toString`, each with a trailing `_`; a command that fails in the server's main thread is
answered `nak`, most other mistakes are not answered at all.
"""

import math
import re
from collections.abc import Sequence
from decimal import Decimal
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from equipoise.errors import InputError, LinkError

PORT: Final = 30001
"""TCP port of the KST server."""
JOINTS: Final = 7
"""Joints of an iiwa. An emulated arm may have another number, and its lines as many fields."""
DIGITS: Final = 9
"""Significant digits of the numbers that are sent, 1 nrad in 1 rad: at 100 Hz the five digits of
the official clients make steps of 1 rad/s^2 in the second difference."""
LONGEST: Final = 1024
"""Longest line that is accepted [bytes]; seven numbers of Java's take less than 190."""

Asked = Literal["done", "joints", "external", "measured", "pose", "force", "nothing"]
"""What a setpoint asks for: an acknowledgement, measured joints [rad], external or measured torques
[N m], the end effector's pose [mm, rad] or force [N], or nothing."""

SETPOINTS: Final[dict[Asked, str]] = {
    "done": "jp",
    "joints": "jpJP",
    "external": "jpExT",
    "measured": "jpMT",
    "pose": "jpEEfP",
    "force": "jpEEfFrelEEF",
    "nothing": "jf",
}
"""Commands that set the target of the joint servo, by what they ask for."""
VELOCITIES: Final[dict[Asked, str]] = {
    "done": "velJDC",
    "joints": "velJDCJP",
    "external": "velJDCExT",
    "measured": "velJDCMT",
    "pose": "velJDCEEfP",
}
"""Commands that set the velocity of the velocity servo, by what they ask for."""

GET_JOINTS: Final = b"getJointsPositions\n"
"""Asks for the measured joints, at any time."""
GET_EXTERNAL: Final = b"Torques_ext_J\n"
"""Asks for the external torques; never answered while a servo runs."""
GET_MEASURED: Final = b"Torques_m_J\n"
"""Asks for the measured torques; never answered while a servo runs."""
GET_POSE: Final = b"Eef_pos\n"
"""Asks for the end effector's pose; never answered while a servo runs."""
START_SERVO: Final = b"startDirectServoJoints\n"
"""Starts the joint servo; acknowledged before it runs."""
START_VELOCITY: Final = b"stVelDcJoint_\n"
"""Starts the velocity servo, which integrates the last velocity for ever: no driver here uses it,
since a client that is lost leaves the arm moving."""
STOP_SERVO: Final = b"stopDirectServoJoints\n"
"""Stops any servo; acknowledged at once, obeyed a few milliseconds later."""
MOVE: Final = b"doPTPinJS\n"
"""Starts a point-to-point motion to the last setpoint; acknowledged at once, and again when it
ends. Nothing that is sent in between stops it."""
END: Final = b"end\n"
"""Ends servo, connection and server, which an operator has to start again; not answered."""

Word = Literal["done", "nak", "interrupted"]
WORDS: Final[dict[bytes, Word]] = {b"done": "done", b"nak": "nak", b"interrupted": "interrupted"}
_NUMBER = re.compile(rb"-?[0-9]+\.[0-9]+(?:E-?[0-9]+)?")
_DOUBLE = re.compile(
    r"[+-]?(?:NaN|Infinity|(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?[fFdD]?)"
)


class KstLineSplitter:
    """What a stream of bytes holds of lines; it ends where a line grows too long."""

    def __init__(self, longest: int = LONGEST) -> None:
        """Begin with nothing; no line may have more than `longest` bytes."""
        self._longest = longest
        self._rest = b""
        self._broken = False

    def feed(self, data: bytes) -> list[bytes]:
        r"""Take bytes, and return the lines that they complete, without their ends.

        Lines end in \n or \r\n; empty ones are left out.

        Raises:
            LinkError: A line is too long, now or before.
        """
        *lines, self._rest = (self._rest + data).split(b"\n")
        if self._broken or any(len(line) > self._longest for line in (*lines, self._rest)):
            self._broken, self._rest = True, b""
            raise LinkError(
                f"expected lines of at most {self._longest} bytes, and more came without a line "
                "end; is this a KST server?"
            )
        return [line for line in (line.removesuffix(b"\r") for line in lines) if line]


def setpoint(
    q: Sequence[float] | npt.NDArray[np.float64], asked: Asked = "joints", *, joints: int = JOINTS
) -> bytes:
    """Return the line that sets the target of the joint servo.

    Args:
        q: All joints [rad], shape (joints,).
        asked: The answer that the server sends.
        joints: Number of joints.

    Raises:
        InputError: `q` is not one finite number for each joint.
    """
    return _line(SETPOINTS[asked], _finite(q, joints, "a setpoint"))


def velocity(dq: Sequence[float] | npt.NDArray[np.float64], asked: Asked = "joints") -> bytes:
    """Return the line that sets the velocity of the velocity servo.

    Args:
        dq: Seven joint velocities [rad/s].
        asked: What the server shall answer; not every answer exists.

    Raises:
        InputError: They are not seven finite numbers, or there is no such answer.
    """
    if asked not in VELOCITIES:
        raise InputError(
            f"a velocity cannot ask for {asked!r}; ask for one of {', '.join(VELOCITIES)}"
        )
    return _line(VELOCITIES[asked], _finite(dq, JOINTS, "a velocity"))


def speed(relative: float) -> bytes:
    """Return the line that sets the speed of point-to-point motions.

    Args:
        relative: Share of the joints' speed limits, above 0 and at most 1.

    Raises:
        InputError: It is not such a share.
    """
    if not 0.0 < relative <= 1.0:
        raise InputError(
            f"the relative speed of a motion is above 0 and at most 1, not {relative!r}; "
            "0.1 is a gentle one"
        )
    return _line("jRelVel", (relative,))


def parse_reply(line: bytes) -> Word | tuple[float, ...]:
    """Return what a line of the server says: a word, or finite numbers.

    Args:
        line: The line without its end.

    Raises:
        LinkError: It is neither a word nor numbers of Java's with a trailing `_`, or a number is
            not finite.
    """
    if (word := WORDS.get(line)) is not None:
        return word
    *fields, last = line.split(b"_")
    if not fields or last or not all(_NUMBER.fullmatch(field) for field in fields):
        raise LinkError(
            f"expected done, nak, interrupted or finite numbers that end in _, got {_shown(line)}; "
            "nothing more can be trusted: connect again"
        )
    values = tuple(float(field) for field in fields)
    if not all(math.isfinite(value) for value in values):
        raise LinkError(
            f"expected finite numbers, got {_shown(line)}; nothing more can be trusted: "
            "connect again"
        )
    return values


def expect_done(line: bytes, command: str) -> None:
    """Check that a line acknowledges a command, whose name is for the message.

    Raises:
        LinkError: It says anything else.
    """
    said = parse_reply(line)
    if said == "nak":
        raise LinkError(
            f"the server refused {command} (nak); look at the message on the smartPAD, then start "
            "the server and connect again"
        )
    if said != "done":
        raise LinkError(
            f"expected done as the answer to {command}, got {_shown(line)}; requests and answers "
            "are out of step: connect again"
        )


def expect_numbers(line: bytes, count: int, command: str) -> tuple[float, ...]:
    """Return the numbers that a line answers to a command, whose name is for the message.

    Raises:
        LinkError: It does not hold so many finite numbers.
    """
    said = parse_reply(line)
    if isinstance(said, str) or len(said) != count:
        raise LinkError(
            f"expected {count} numbers as the answer to {command}, got {_shown(line)}; requests "
            "and answers are out of step: connect again"
        )
    return said


def tokens(line: bytes) -> list[str]:
    """Return the fields of a client's line as the server takes them apart, empty ones left out."""
    return [field for field in line.decode("latin-1").split("_") if field]


def java_double(text: str) -> float:
    """Return the number that Java's `Double.parseDouble` reads, hexadecimal ones excepted.

    It knows `NaN` and `Infinity`, but neither `nan` nor `inf`.

    Raises:
        InputError: It reads none.
    """
    stripped = text.strip("".join(map(chr, range(33))))
    if _DOUBLE.fullmatch(stripped) is None:
        raise InputError(f"{text[:40]!r} is no number for the server; send a decimal number")
    return float(stripped.rstrip("fFdD"))


def java_number(value: float) -> str:
    """Return a number as Java's `Double.toString` writes it, in the fewest digits that keep it.

    Example:
        >>> java_number(0.0001), java_number(-1.3962), java_number(100.0)
        ('1.0E-4', '-1.3962', '100.0')
    """
    if math.isnan(value):
        return "NaN"
    if math.isinf(value):
        return "Infinity" if value > 0.0 else "-Infinity"
    sign, digits, exponent = Decimal(repr(float(value))).normalize().as_tuple()
    # Java writes two digits at least: where one is enough, the two that are nearest.
    if len(digits) == 1:
        sign, digits, exponent = Decimal(f"{value:.1e}").as_tuple()
    text, minus = "".join(map(str, digits)), "-" * sign
    point = len(text) + int(exponent)
    if value == 0.0:
        return f"{minus}0.0"
    if not 1e-3 <= abs(value) < 1e7:
        return f"{minus}{text[0]}.{text[1:]}E{point - 1}"
    text, point = "0" * (1 - point) + text, max(point, 1)
    text = text.ljust(point, "0")
    fraction = text[point:].rstrip("0")
    return f"{minus}{text[:point]}.{fraction or '0'}"


def numbers_reply(values: Sequence[float]) -> bytes:
    """Return the server's line of numbers."""
    return "".join(f"{java_number(value)}_" for value in values).encode() + b"\n"


def _line(command: str, values: Sequence[float]) -> bytes:
    fields = "".join(f"{value:.{DIGITS}g}_" for value in values)
    return f"{command}_{fields}\n".encode()


def _finite(
    values: Sequence[float] | npt.NDArray[np.float64], count: int, what: str
) -> list[float]:
    try:
        given = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        given = np.empty(0)
    if given.shape != (count,) or not np.isfinite(given).all():
        raise InputError(
            f"{what} is {count} finite numbers, one for each joint, not {str(values)[:120]}; "
            "nothing was sent"
        )
    return given.tolist()


def _shown(line: bytes) -> str:
    return repr(line[:120].decode("latin-1"))
