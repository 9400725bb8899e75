r"""Escaping of untrusted text from files and networks for display.

An escape sequence moves a terminal's cursor or changes its title, a bidirectional override reorders
a name, a line break forges a line. Each such character is replaced by its Python escape, `\x1b`.
Escaping is idempotent.
"""

from typing import Final

SPACES: Final = "\N{NO-BREAK SPACE}\N{NARROW NO-BREAK SPACE}\N{THIN SPACE}"
"""Spaces in texts of Equipoise, which `str.isprintable` rejects."""
LAYOUT: Final = "\n\t"
"""Line breaks and tabs, which are kept in multi-line text."""


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
