"""The report: one self-contained HTML file, drawn from the files of a reproduction.

`build` draws every figure into `figures/` and embeds all of them in `report.html`. The page fetches
no file and runs no script; it can be printed, mailed and archived.
"""

import base64
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import jinja2
import numpy as np
from markupsafe import Markup, escape

from equipoise import paper
from equipoise.apps.report import figures, rows
from equipoise.apps.style import save
from equipoise.artefacts import Provenance, read_document, write_whole
from equipoise.errors import OutsideError
from equipoise.film import write_film
from equipoise.printable import as_text, label, printable
from equipoise.reproduction.results import RECORD, Results, load

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE: Final = "report.html"
FILM_SECONDS: Final = 8.0
"""Maximum length of the film on the page [s]; the paper's run took 5 s."""
FIGURES: Final[dict[str, Callable[[Results], "Figure"]]] = {
    "swing": lambda r: figures.free_swing(r.swing, r.pendulum),
    "learning-curve": lambda r: figures.learning_curve(r.default.policy),
    "survival": lambda r: figures.survival(r.default.evaluation),
    "policy": lambda r: figures.policy_picture(r.default.policy, r.default.run),
    "literal-run": lambda r: figures.run_figure("Literal recipe", r.literal.run, r.default.run),
    "run": lambda r: figures.run_figure("Default recipe", r.default.run, r.literal.run),
}
"""Drawing functions of the figures, by the names of their files."""


def build(out: Path) -> Path:
    """Draw the figures of a reproduction and write its report.

    Args:
        out: Output folder of `reproduce`.

    Returns:
        The path of the page.

    Raises:
        ArtefactError: A file is missing, corrupt, or belongs to another reproduction.
        OutsideError: Writing fails.
    """
    results, images = load(out), dict[str, str]()
    for name, draw in FIGURES.items():
        svg, _ = save(draw(results), out / "figures" / name)
        images[name] = _data_uri("svg+xml", svg.read_bytes())
    film, missing = out / "figures" / "film.webp", ""
    try:
        run = results.default.run
        write_film(run, film, end=min(run.lasted, FILM_SECONDS))
        images["film"] = _data_uri("webp", film.read_bytes())
    except OutsideError as error:  # OpenGL may be missing
        missing = str(error)
    provenance = Provenance.model_validate(read_document(out / RECORD)["provenance"])
    write_whole(out / PAGE, page(results, images, provenance, missing))
    return out / PAGE


def page(
    results: Results, images: dict[str, str], provenance: Provenance, missing: str = ""
) -> str:
    """Return the report as HTML.

    Args:
        results: Results of the reproduction.
        images: Addresses of the figures of `FIGURES`, and of the film, by their names.
        provenance: Time and software versions of the reproduction.
        missing: Reason why there is no film.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("equipoise.apps.report", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        finalize=_printable,
    )
    environment.filters["prose"] = _prose
    return environment.get_template("report.html.j2").render(
        results=results,
        run=results.default.run,
        policy=results.default.policy,
        settings=results.default.policy.settings,
        provenance=provenance,
        images=images,
        missing=missing,
        paper=paper,
        rows=rows,
        compared=[
            (label(name), *map(as_text, cells.values()))
            for name, cells in rows.comparison(results).items()
        ],
        degrees=np.rad2deg,
    )


def _data_uri(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def _printable(value: Any) -> Any:
    """Escape the control characters of a text, whose markup the template engine escapes."""
    return printable(value, layout=True) if type(value) is str else value


def _prose(text: str) -> Markup:
    """Return a text with code between backticks, which breaks after dots and underscores only."""

    def code(found: re.Match[str]) -> str:
        return f"<code>{re.sub('(?<=[._])', '<wbr>', found[1])}</code>"

    return Markup(re.sub("`([^`]+)`", code, str(escape(printable(text)))))
