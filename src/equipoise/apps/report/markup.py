"""HTML fragments of the report page; all text from outside is escaped."""

import base64
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape as html_escape
from typing import TYPE_CHECKING, Final, NamedTuple

from equipoise.printable import printable

if TYPE_CHECKING:
    from equipoise.apps.report.pictures import Animation

CODE: Final = re.compile(r"`([^`]+)`")
BREAK: Final = re.compile(r"(?<=[._])")
TYPESET: Final = (
    (re.compile(r"(?<=\d) deg(?:rees?)?\b"), "°"),
    (re.compile(r"\bphi\b"), "φ"),
    (re.compile(r"\btheta\b"), "θ"),
    (re.compile(r"(?<![\w.\]])-(?=[\d∞])"), "−"),
    (re.compile(r"(?<=\d) (?=%)"), "&nbsp;"),
    (re.compile(r"\^2"), "²"),
)
"""Patterns of terminal text and the symbols that replace them in prose."""
MIN_STACKED_COLUMNS: Final = 3
"""Minimum number of columns of tables that narrow screens show stacked, with labelled cells."""


class Missing(NamedTuple):
    """A figure that could not be drawn."""

    reason: str
    """Reason and remedy, as a clause."""


Pictures = Mapping[str, str | Missing]
"""Figures as SVG, by the names of their files."""
Picture = Callable[[str, str, str], str]
"""Function `picture` with its first argument bound."""


class Part(NamedTuple):
    """A section of the page."""

    name: str
    """Its anchor."""
    title: str
    """Its heading."""
    html: str
    """The section as HTML."""


def escape(text: str) -> str:
    """Escape markup and control characters, so that a text is shown literally."""
    return html_escape(printable(text, layout=True))


def part(name: str, title: str, *html: str) -> Part:
    """Return a section that consists of HTML fragments."""
    inside = f"<h2>{prose(title)}</h2>\n{''.join(html)}"
    return Part(name, title, f'<section id="{escape(name)}">\n{inside}</section>\n')


def prose(text: str) -> str:
    """Return a text as HTML.

    Text between backticks becomes code, which breaks after dots and underscores only. Elsewhere
    numbers are typeset: a minus for a hyphen, ² for ^2, ° for deg, no break before %.
    """
    parts = CODE.split(text)
    # Odd parts were between backticks.
    parts[0::2] = (_typeset(escape(part)) for part in parts[0::2])
    parts[1::2] = (f"<code>{BREAK.sub('<wbr>', escape(part))}</code>" for part in parts[1::2])
    return "".join(parts)


def _typeset(text: str) -> str:
    for pattern, symbol in TYPESET:
        text = pattern.sub(symbol, text)
    return text


def _class(name: str) -> str:
    return f' class="{escape(name)}"' if name else ""


def paragraph(text: str, name: str = "") -> str:
    """Return a paragraph; `name` is its class for the style sheet: `note` or `conclusion`."""
    return f"<p{_class(name)}>{prose(text)}</p>\n"


def heading(text: str) -> str:
    """Return a heading below that of a section."""
    return f"<h3>{prose(text)}</h3>\n"


def bullets(lines: Iterable[str], tag: str = "ul", name: str = "") -> str:
    """Return a list; `tag` is `ul` or `ol`, `name` the class for the style sheet."""
    items = "".join(f"<li>{prose(line)}</li>" for line in lines)
    return f"<{tag}{_class(name)}>{items}</{tag}>\n"


def tiles(*pairs: tuple[str, str]) -> str:
    """Return large numbers, each with its description."""
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
        rows: Texts of each row; the first is the row's name.
        caption: Text above the table.
        numbers: Number of trailing columns that hold numbers, set flush right.
        name: Class of the table, for the style sheet.
    """
    first, stacked = len(head) - numbers, len(head) >= MIN_STACKED_COLUMNS
    names = "".join(_cell("th", text, i >= first) for i, text in enumerate(head))
    kind = " ".join(filter(None, ("table", "stacked" if stacked else "", name)))
    lines = [
        f"<div{_class(kind)}><table>",
        f"<caption>{prose(caption)}</caption>" if caption else "",
        f"<thead><tr>{names}</tr></thead>",
        "<tbody>",
    ]
    for row in rows:
        cells = "".join(
            _cell("td" if i else "th", cell, i >= first, head[i] if stacked and i else "")
            for i, cell in enumerate(row)
        )
        lines.append(f"<tr>{cells}</tr>")
    return "\n".join([*filter(None, lines), "</tbody></table></div>\n"])


def _cell(tag: str, text: str, number: bool, label: str = "") -> str:
    kind = _class("number" if number else "")
    kind += f' data-label="{escape(label.replace("`", ""))}"' if label else ""
    return f"<{tag}{kind}>{prose(text)}</{tag}>"


def picture(pictures: Pictures, name: str, caption: str, alt: str) -> str:
    """Return a figure with an embedded SVG that opens large, without a script.

    The SVG is an `img`, because the ids inside two inline SVGs may collide. The large view is the
    target of the link, so that the browser's back button closes it.

    Args:
        pictures: All pictures; a missing one is replaced by its reason.
        name: Name of the picture in `pictures`.
        caption: Caption of the figure.
        alt: Alternative text.
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
    """Return a figure with an animation; browsers set to reduced motion show its first frame.

    Args:
        animation: The animation, or the reason for its absence.
        caption: Caption of the figure.
        alt: Alternative text.
    """
    if isinstance(animation, Missing):
        return _missing(animation, alt)
    return (
        '<figure class="film"><picture><source media="(prefers-reduced-motion: reduce)" '
        f'srcset="{_data("webp", animation.still)}">'
        f'<img alt="{escape(alt)}" src="{_data("webp", animation.webp)}"></picture>'
        f"<figcaption>{prose(caption)}</figcaption></figure>\n"
    )


def _missing(missing: Missing, alt: str) -> str:
    return paragraph(
        f"Missing figure: {alt[0].lower()}{alt[1:]}. Reason: {missing.reason}.", "note"
    )


def _data(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def listing(lines: Iterable[str]) -> str:
    """Return lines of a shell session."""
    return f"<pre>{escape(chr(10).join(lines))}</pre>\n"
