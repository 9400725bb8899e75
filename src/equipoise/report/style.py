"""Colours of pages and figures, and the style of all figures.

Colours are the colour-blind-safe palette of Okabe and Ito. Lines that share a panel also differ in
lightness and dashes, for prints in grey. Figures are made without pyplot: no global state, no
screen. Equal input gives equal SVG.
"""

import io
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from equipoise.files import write_atomically
from equipoise.printable import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK: Final = "#222222"
BLUE: Final = "#0072B2"
SKY: Final = "#56B4E9"
VERMILION: Final = "#D55E00"
ORANGE: Final = "#E69F00"
GREEN: Final = "#009E73"
PURPLE: Final = "#CC79A7"
GREY: Final = "#767676"
PALE: Final = "#E4E4E4"

STYLE: Final[dict[str, Any]] = {
    "font.size": 8.5,
    "axes.titlelocation": "left",
    "axes.titlesize": 8.5,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": PALE,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "axes.labelcolor": INK,
    "lines.linewidth": 1.1,
    "legend.frameon": False,
    "figure.titlesize": 10.0,
    "figure.titleweight": "bold",
    "figure.constrained_layout.use": True,
    "svg.hashsalt": "equipoise",
}


@contextmanager
def styled() -> Generator[None]:
    """Apply our style, independent of the caller's matplotlib settings; also a decorator."""
    from matplotlib import style

    with style.context(STYLE, after_reset=True):
        yield


def new_figure(height: float, title: str) -> "Figure":
    """Return an empty figure of the common width.

    Args:
        height: Height [inch].
        title: Title of the figure, with its number in the paper if it has one.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.4, height))
    figure.suptitle(title, x=0.01, ha="left")
    return figure


def plain(text: str) -> str:
    """Escape a text from a file for Matplotlib: a dollar sign begins no formula."""
    return printable(text).replace("$", r"\$")


def typeset(text: str) -> str:
    """Return the text of a number with a minus sign in place of a hyphen."""
    return text.replace("-", "\N{MINUS SIGN}")


def edges(ends: Sequence[float], limit: float) -> list[str]:
    """Return the edges of all intervals between `ends` and a limit on both sides as text."""
    return [typeset(f"{end:g}".replace("inf", "∞")) for end in (-limit, *ends, limit)]


def save(figure: "Figure", stem: Path) -> tuple[Path, Path]:
    """Write a figure as SVG and as PNG.

    Args:
        figure: The figure.
        stem: Path without the extension: `figures/learning`.

    Returns:
        The paths of the SVG and the PNG.

    Raises:
        OutsideError: Writing fails.
    """
    svg, png = (stem.with_name(f"{stem.name}.{kind}") for kind in ("svg", "png"))
    for path in (svg, png):
        write_atomically(path, render(figure, path.suffix[1:]))
    return svg, png


def render(figure: "Figure", kind: str) -> bytes:
    """Return a figure as a file of a `kind`, `svg` or `png`; equal figures give equal bytes."""
    stream = io.BytesIO()
    omitted = {"Date": None, "Creator": None} if kind == "svg" else {"Software": None}
    with styled():
        figure.savefig(stream, format=kind, dpi=160, metadata=omitted)
    return stream.getvalue()
