"""Style of all figures, and their export to SVG and PNG.

Colours are the colour-blind-safe palette of Okabe and Ito. Lines that share a panel also differ in
lightness and dashes, for prints in grey. Figures are made without pyplot: no global state, no
screen. Equal input gives equal SVG.
"""

import functools
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, ParamSpec

from equipoise.artefacts import write_whole
from equipoise.printable import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

P = ParamSpec("P")
Offset = tuple[float, float]

INK: Final = "#222222"
BLUE: Final = "#0072B2"
SKY: Final = "#56B4E9"
VERMILION: Final = "#D55E00"
ORANGE: Final = "#E69F00"
GREEN: Final = "#009E73"
PURPLE: Final = "#CC79A7"
GREY: Final = "#767676"
PALE: Final = "#E4E4E4"

WIDTH: Final = 7.4
"""Width of every figure [inch]."""
DPI: Final = 160
"""Resolution of the PNG files."""

STYLE: Final[dict[str, Any]] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.titlesize": 8.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": PALE,
    "grid.linewidth": 0.6,
    **{f"{axis}tick.color": INK for axis in "xy"},
    **{f"{axis}tick.labelsize": 8.0 for axis in "xy"},
    **{f"{axis}tick.major.width": 0.7 for axis in "xy"},
    "text.color": INK,
    "axes.labelcolor": INK,
    "lines.linewidth": 1.1,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "figure.titlesize": 10.0,
    "figure.titleweight": "bold",
    "figure.facecolor": "white",
    "figure.constrained_layout.use": True,
    "hatch.linewidth": 0.6,
    "path.simplify": True,
    "svg.fonttype": "path",
    "svg.hashsalt": "equipoise",
}


def drawn(draw: Callable[P, "Figure"]) -> Callable[P, "Figure"]:
    """Make `draw` use our style, independent of the caller's matplotlib settings."""

    @functools.wraps(draw)
    def in_style(*args: P.args, **kwargs: P.kwargs) -> "Figure":
        from matplotlib import style

        with style.context(STYLE, after_reset=True):
            return draw(*args, **kwargs)

    return in_style


def new_figure(height: float, title: str) -> "Figure":
    """Return an empty figure of the common width.

    Args:
        height: Height [inch].
        title: Title of the figure, with its number in the paper if it has one.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, height))
    figure.suptitle(plain(title), x=0.01, ha="left")
    return figure


def plain(text: str) -> str:
    """Escape a text from a file for Matplotlib: a dollar sign begins no formula."""
    return printable(text).replace("$", r"\$")


def limit_lines(axes: "Axes", values: Sequence[float], label: str = "") -> None:
    """Draw the failure limits; the label stands above the highest, on the left."""
    for value in values:
        axes.axhline(value, color=INK, linewidth=1.0, linestyle=(0, (6, 2)))
    if label:
        remark(axes, label, (0.0, max(values)), (3, 2), 7.5)


def remark(
    axes: "Axes", text: str, place: tuple[float, float], offset: Offset, size: float, **look: Any
) -> None:
    """Write a text at an x in shares of the axes and a y of the data, with an offset [pt]."""
    frame: Any = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
    axes.annotate(text, place, offset, fontsize=size, **frame, **look)


def edge_lines(axes: "Axes", values: Sequence[float]) -> None:
    """Draw the inner edges of the boxes."""
    for value in values:
        axes.axhline(value, color=GREY, linewidth=0.6, linestyle=(0, (1, 2)))


def to_svg(figure: "Figure") -> str:
    """Return a figure as SVG; equal figures give equal text."""
    return _rendered(figure, "svg").decode()


def to_png(figure: "Figure") -> bytes:
    """Return a figure as PNG."""
    return _rendered(figure, "png")


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
    svg, png = (stem.with_name(f"{stem.name}.{ending}") for ending in ("svg", "png"))
    write_whole(svg, to_svg(figure))
    write_whole(png, to_png(figure))
    return svg, png


def _rendered(figure: "Figure", kind: str) -> bytes:
    from matplotlib import style

    stream = io.BytesIO()
    # Omit date and version of the software: equal figures give equal files.
    omitted = {"Date": None, "Creator": None} if kind == "svg" else {"Software": None}
    with style.context(STYLE, after_reset=True):
        figure.savefig(stream, format=kind, dpi=DPI, metadata=omitted)
    return stream.getvalue()
