r"""Codec of the KST server, the program of the KUKA Sunrise Toolbox on the cabinet.

The client sends ASCII lines over TCP, each a command whose fields are joined by `_`. The server
answers most of them with one line. The protocol has no length, checksum, sequence number or
watchdog::

    getJointsPositions\n             0.0_0.4364_0.0_-1.3962_0.0_1.309_0.0_\n
    startDirectServoJoints\n         done\n
    jpJP_<seven numbers>_\n          1.5855032851556873E-4_0.4364_ ... _0.0_\n
    jpExT_<seven numbers>_\n         0.5_-1.25_1.0E-4_0.0_0.0_0.0_0.125_\n
    stopDirectServoJoints\n          done\n
    end\n                            (the server closes the connection and its program ends)

Angles are in radians, torques in N m, lengths in mm. The server writes numbers as Java's
`Double.toString`, each with a trailing `_`. It answers `nak` to a command that fails in its main
thread, and does not answer most other mistakes.
"""

import math
import re
from collections.abc import Sequence
from decimal import Decimal
from typing import Final

from equipoise.arrays import Array
from equipoise.errors import InputError, LinkError
from equipoise.rig.interfaces import checked_setpoint

PORT: Final = 30001
"""TCP port of the KST server."""
JOINTS: Final = 7
"""Number of joints of an iiwa. Lines of an emulated arm have one field for each of its joints."""
DIGITS: Final = 9
"""Significant digits of the numbers sent, 1 nrad in 1 rad. At 100 Hz the five digits of the
official clients cause steps of 1 rad/s^2 in the second difference."""
MAX_LINE: Final = 1024
"""Maximum accepted line length [bytes]; seven Java numbers take less than 190."""

GET_JOINTS: Final = "getJointsPositions"
"""Request for the measured joints, at any time."""
START_SERVO: Final = "startDirectServoJoints"
"""Start of the joint servo; acknowledged before it runs."""
STOP_SERVO: Final = "stopDirectServoJoints"
"""Stop of the servo; acknowledged at once, obeyed a few milliseconds later."""
END: Final = "end"
"""End of servo, connection and server, which an operator has to start again; not answered."""

_NUMBER = re.compile(rb"-?[0-9]+\.[0-9]+(?:E-?[0-9]+)?")
_DOUBLE = re.compile(
    r"[+-]?(?:NaN|Infinity|(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?[fFdD]?)"
)


def split_lines(data: bytes) -> tuple[list[bytes], bytes]:
    r"""Return the complete lines of received bytes without their ends, and the incomplete rest.

    Lines end in \n or \r\n; empty lines are left out.

    Raises:
        LinkError: A line is too long; the stream is not to be read further.
    """
    *lines, rest = data.split(b"\n")
    if any(len(line) > MAX_LINE for line in (*lines, rest)):
        raise LinkError(
            f"expected lines of at most {MAX_LINE} bytes, and more came without a line "
            "end; is this a KST server?"
        )
    return [line for line in (line.removesuffix(b"\r") for line in lines) if line], rest


def setpoint(q: Sequence[float] | Array, *, torque: bool = False, joints: int = JOINTS) -> bytes:
    """Return the line that sets the target of the joint servo.

    Args:
        q: All joints [rad], shape (joints,).
        torque: Whether to request external torques [N m] as the reply, or measured joints [rad].
        joints: Number of joints.

    Raises:
        InputError: `q` is not one finite number for each joint.
    """
    fields = "".join(f"{value:.{DIGITS}g}_" for value in checked_setpoint(q, joints).tolist())
    return f"{'jpExT' if torque else 'jpJP'}_{fields}\n".encode()


def expect_done(line: bytes, command: str) -> None:
    """Check that a line acknowledges a command, named in the message.

    Raises:
        LinkError: The line is anything else.
    """
    if line != b"done":
        raise _out_of_step(line, "done", command)


def expect_numbers(line: bytes, count: int, command: str) -> tuple[float, ...]:
    """Return the numbers in the reply to a command, named in the message.

    Args:
        line: The line without its end.
        count: Number of numbers.
        command: Name of the command.

    Raises:
        LinkError: The line does not hold `count` finite Java numbers, each with a trailing `_`.
    """
    *fields, last = line.split(b"_")
    if len(fields) == count and not last and all(map(_NUMBER.fullmatch, fields)):
        values = tuple(map(float, fields))
        if all(map(math.isfinite, values)):
            return values
    raise _out_of_step(line, f"{count} finite numbers that end in _", command)


def java_double(text: str) -> float:
    """Parse a number as Java's `Double.parseDouble` does, except for hexadecimal numbers.

    Java accepts `NaN` and `Infinity`, but neither `nan` nor `inf`.

    Raises:
        InputError: Java rejects the text.
    """
    stripped = text.strip("".join(map(chr, range(33))))
    if _DOUBLE.fullmatch(stripped) is None:
        raise InputError(f"{text[:40]!r} is no number for the server; send a decimal number")
    return float(stripped.rstrip("fFdD"))


def java_number(value: float) -> str:
    """Format a number as Java's `Double.toString` does, in the fewest digits that identify it.

    Example:
        >>> java_number(0.0001), java_number(-1.3962), java_number(100.0)
        ('1.0E-4', '-1.3962', '100.0')
    """
    if math.isnan(value):
        return "NaN"
    if math.isinf(value):
        return "Infinity" if value > 0.0 else "-Infinity"
    if value == 0.0 or 1e-3 <= abs(value) < 1e7:
        return repr(float(value))
    text = f"{Decimal(repr(float(value))).normalize():E}"
    # Java writes at least two digits: where one is enough, the nearest two.
    text = text if "." in text else f"{value:.1E}"
    mantissa, _, exponent = text.partition("E")
    return f"{mantissa}E{int(exponent)}"


def numbers_reply(values: Sequence[float]) -> bytes:
    """Return the server's reply with numbers."""
    return "".join(f"{java_number(value)}_" for value in values).encode() + b"\n"


def _out_of_step(line: bytes, expected: str, command: str) -> LinkError:
    return LinkError(
        f"expected {expected} as the answer to {command}, got {line[:120].decode('latin-1')!r}; "
        "look at the message on the smartPAD, then start the server and connect again"
    )
