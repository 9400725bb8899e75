r"""Text for display: escapes in untrusted text from files and networks, names and values of fields.

An escape sequence moves a terminal's cursor or changes its title, a bidirectional override reorders
a name, a line break forges a line. Each such character is replaced by its Python escape, `\x1b`.
Escaping is idempotent.
"""

import re
from collections.abc import Mapping
from math import floor, log10
from typing import Any


def printable(text: str, *, layout: bool = False) -> str:
    r"""Return `text` with escapes in place of control, format and undecodable characters.

    Args:
        text: Any text.
        layout: Keep line breaks and tabs.

    Example:
        >>> printable("fell\x1b[2J")
        'fell\\x1b[2J'
    """
    if text.isprintable():
        return text
    # Spaces in texts of Equipoise, which `str.isprintable` rejects.
    kept = "\N{NO-BREAK SPACE}\N{NARROW NO-BREAK SPACE}\N{THIN SPACE}"
    if layout:
        kept += "\n\t"
    return "".join(
        char if char.isprintable() or char in kept else char.encode("unicode_escape").decode()
        for char in text
    )


def label(name: str) -> str:
    """Return the name of a field, with its unit in brackets, or its level of confidence.

    Example:
        >>> label("fit_percent"), label("speed_m_s"), label("interval_95"), label("gap_at_start")
        ('fit [percent]', 'speed [m/s]', 'interval (95 %)', 'gap at start')
    """
    name, unit = name.replace("_95", " (95 %)"), "_(rad_s|m_s|s|ms|deg|mm|m|percent)$"
    return re.sub(unit, lambda of: f" [{of[1].replace('_', '/')}]", name).replace("_", " ")


def plus_minus(value: float, interval: tuple[float, float]) -> str:
    """Return a value with the half width of its interval, to two digits of the latter."""
    half = max(interval[1] - value, value - interval[0])
    if half <= 0.0:
        return f"{value:.4g}"
    digits = max(0, 1 - floor(log10(half)))
    return f"{value:.{digits}f} ± {half:.{digits}f}"


def as_text(value: Any) -> str:
    """Return a value as text; empty for None and for one without entries."""
    match value:
        case None:
            return ""
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.4g}"
        case Mapping():
            known = ((printable(str(k)), as_text(v)) for k, v in value.items() if v is not None)
            return ", ".join(map(" ".join, known))
        case (float(low), float(high)):
            return f"{low:.4g} to {high:.4g}"
        case list() | tuple():
            return "\n".join(map(as_text, value))
        case _ if hasattr(value, "source"):
            level = "95 %, " if value.low < value.high else ""
            return f"{plus_minus(value.value, value.interval)} ({level}{value.source})"
        case _:
            return printable(str(value))
