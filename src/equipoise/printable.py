r"""Text from files and wires, made safe to show.

An escape sequence moves a terminal's cursor or changes its title, a bidirectional override shows a
name in another order, a line break forges a line. Each such character is replaced by its escape as
Python writes it, `\x1b`; the result contains none, so that escaping twice changes nothing.
"""

from typing import Final

SPACES: Final = "\N{NO-BREAK SPACE}\N{NARROW NO-BREAK SPACE}\N{THIN SPACE}"
"""Spaces of our own texts, which `str.isprintable` rejects."""
LAYOUT: Final = "\n\t"
"""Line breaks and tabs, which a text of several lines keeps."""


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
    kept = SPACES + LAYOUT if layout else SPACES
    return "".join(
        one if one.isprintable() or one in kept else one.encode("unicode_escape").decode()
        for one in text
    )
