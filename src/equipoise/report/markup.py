"""The few pieces of HTML that the page is made of; every text from outside is escaped."""

import base64
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape as html_escape
from typing import TYPE_CHECKING, Final, NamedTuple

from equipoise.printable import printable

if TYPE_CHECKING:
    from equipoise.report.pictures import Animation

CODE: Final = re.compile(r"`([^`]+)`")
SIGN: Final = re.compile(r"(?<![\w.\]])-(?=[\d∞])")
PERCENT: Final = re.compile(r"(?<=\d) (?=%)")
BREAK: Final = re.compile(r"(?<=[._])")
SYMBOLS: Final = (
    (re.compile(r"(?<=\d) deg(?:rees?)?\b"), "°"),
    (re.compile(r"\bphi\b"), "φ"),
    (re.compile(r"\btheta\b"), "θ"),
)
"""What prose sets as a symbol: the terminal writes it out."""
STACKED: Final = 3
"""Tables of so many columns are stacked on narrow screens, each cell below its column's name."""


class Missing(NamedTuple):
    """A figure that could not be drawn."""

    why: str
    """What is to be done about it."""


Pictures = Mapping[str, str | Missing]
"""Figures as SVG, by the names of their files."""


class Part(NamedTuple):
    """A section of the page."""

    name: str
    """Its anchor."""
    title: str
    """Its heading."""
    html: str
    """All of it."""


def escape(text: str) -> str:
    """Return a text that is shown as it is: neither markup nor control characters work in it."""
    return html_escape(printable(text, layout=True))


def part(name: str, title: str, *html: str) -> Part:
    """Return a section made of pieces."""
    inside = f"<h2>{prose(title)}</h2>\n{''.join(html)}"
    return Part(name, title, f'<section id="{escape(name)}">\n{inside}</section>\n')


def prose(text: str) -> str:
    """Return a text as HTML.

    What stands between backticks becomes code, which breaks after dots and underscores only. In the
    rest numbers are set as in print: a minus for a hyphen, ² for ^2, ° for deg, no break before %.
    """
    parts = CODE.split(text)
    # Every other part was between backticks.
    parts[0::2] = (_typeset(escape(part)) for part in parts[0::2])
    parts[1::2] = (f"<code>{BREAK.sub('<wbr>', escape(part))}</code>" for part in parts[1::2])
    return "".join(parts)


def _typeset(text: str) -> str:
    for pattern, symbol in SYMBOLS:
        text = pattern.sub(symbol, text)
    return PERCENT.sub("&nbsp;", SIGN.sub("−", text)).replace("^2", "²")


def paragraph(text: str) -> str:
    """Return a paragraph."""
    return f"<p>{prose(text)}</p>\n"


def heading(text: str) -> str:
    """Return a heading below that of a section."""
    return f"<h3>{prose(text)}</h3>\n"


def note(text: str) -> str:
    """Return a remark that must not be missed."""
    return f'<p class="note">{prose(text)}</p>\n'


def conclusion(text: str) -> str:
    """Return what numbers come to, to be read before them."""
    return f'<p class="conclusion">{prose(text)}</p>\n'


def bullets(lines: Iterable[str]) -> str:
    """Return remarks that stand side by side."""
    return f"<ul>{''.join(f'<li>{prose(line)}</li>' for line in lines)}</ul>\n"


def numbered(lines: Iterable[str]) -> str:
    """Return remarks with numbers."""
    return f"<ol>{''.join(f'<li>{prose(line)}</li>' for line in lines)}</ol>\n"


def verdict_list(lines: Iterable[str]) -> str:
    """Return the lines of a verdict."""
    return f'<ol class="verdict">{"".join(f"<li>{prose(line)}</li>" for line in lines)}</ol>\n'


def tiles(*pairs: tuple[str, str]) -> str:
    """Return a few numbers, large, each with what it is."""
    each = (
        f'<div class="tile"><b>{prose(number)}</b><span>{prose(text)}</span></div>'
        for number, text in pairs
    )
    return f'<div class="tiles">{"".join(each)}</div>\n'


def table(
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    caption: str = "",
    numbers: int = 0,
    name: str = "",
) -> str:
    """Return a table.

    Args:
        head: Names of the columns.
        rows: Texts, one row after the other; the first of each names the row.
        caption: What stands above it.
        numbers: How many of the last columns hold numbers, set flush right.
        name: Class of the table, for the style sheet.
    """
    first = len(head) - numbers
    names = "".join(_cell("th", text, i >= first) for i, text in enumerate(head))
    labels = head if len(head) >= STACKED else [""] * len(head)
    kind = " ".join(filter(None, ("table", "stacked" if len(head) >= STACKED else "", name)))
    lines = [
        f'<div class="{escape(kind)}"><table>',
        f"<caption>{prose(caption)}</caption>" if caption else "",
        f"<thead><tr>{names}</tr></thead>",
        "<tbody>",
    ]
    for row in rows:
        cells = "".join(
            _cell("th" if i == 0 else "td", cell, i >= first, labels[i] if i else "")
            for i, cell in enumerate(row)
        )
        lines.append(f"<tr>{cells}</tr>")
    return "\n".join([*filter(None, lines), "</tbody></table></div>\n"])


def _cell(tag: str, text: str, number: bool, label: str = "") -> str:
    kind = ' class="number"' if number else ""
    kind += f' data-label="{escape(label.replace("`", ""))}"' if label else ""
    return f"<{tag}{kind}>{prose(text)}</{tag}>"


def picture(pictures: Pictures, name: str, caption: str, alt: str) -> str:
    """Return a figure that carries its picture inside and opens large, without a script.

    An image of its own, because the names that one SVG gives its parts may occur in another. The
    large view is the link's target, so that the way back is the browser's own, too.

    Args:
        pictures: All pictures; a missing one leaves its place with the reason.
        name: Its name among them.
        caption: What the reader should see in it.
        alt: What is to be seen, for those who cannot.
    """
    svg = pictures[name]
    if isinstance(svg, Missing):
        return _missing(svg, alt)
    place, large = escape(f"at-{name}"), escape(f"large-{name}")
    image = f'<img alt="{escape(alt)}" src="{_data("svg+xml", svg.encode())}">'
    return (
        f'<figure id="{place}"><div class="zoom" id="{large}">'
        f'<a class="back" href="#{place}">Close</a>'
        f'<a class="open" href="#{large}" title="Open large">{image}</a></div>'
        f"<figcaption>{prose(caption)}</figcaption></figure>\n"
    )


def film(animation: "Animation | Missing", caption: str, alt: str) -> str:
    """Return a figure with moving pictures; who asked for less motion sees the first of them.

    Args:
        animation: The pictures; missing ones leave their place with the reason.
        caption: What the reader should see in them.
        alt: What is to be seen, for those who cannot.
    """
    if isinstance(animation, Missing):
        return _missing(animation, alt)
    return (
        '<figure class="film"><picture><source media="(prefers-reduced-motion: reduce)" '
        f'srcset="{_data("webp", animation.still)}">'
        f'<img alt="{escape(alt)}" src="{_data("webp", animation.webp)}"></picture>'
        f"<figcaption>{prose(caption)}</figcaption></figure>\n"
    )


def _missing(lost: Missing, alt: str) -> str:
    return note(f"Here should be: {alt[0].lower()}{alt[1:]}. It is missing: {lost.why}.")


def _data(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def listing(lines: Iterable[str]) -> str:
    """Return lines to be typed."""
    return f"<pre>{escape(chr(10).join(lines))}</pre>\n"
