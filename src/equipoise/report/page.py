"""The report: one HTML file that needs nothing else, drawn from what a reproduction left.

`build` draws every figure into `figures/` beside the values, and puts all of it into `report.html`.
No file is fetched, no script runs; the page can be printed, mailed and read in ten years.
"""

from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Final

from equipoise.artefacts import Provenance, read_document, write_whole
from equipoise.errors import OutsideError
from equipoise.report import figures
from equipoise.report.appendix import assumptions, provenance_section
from equipoise.report.markup import Missing, Part, Pictures, escape
from equipoise.report.pictures import Animation, animation, strip
from equipoise.report.sections_results import sections_results
from equipoise.report.sections_training import sections_training
from equipoise.report.style import save
from equipoise.studies.results import RECORD, Results, estimates_zero, load

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE: Final = "report.html"
FIGURES: Final = "figures"
FILM: Final = "figure-3-film.webp"
"""The animation among the figures."""
FILM_WEIGHT: Final = 4
"""Time that the animation takes, in figures."""

Draw = Callable[[Results], "Figure"]

DRAWINGS: Final[Mapping[str, Draw]] = {
    "figure-2-free-swing": lambda r: figures.free_swing(r.swing, r.pendulum),
    "learning-curve": lambda r: figures.learning_curve(r.policy),
    "policy": lambda r: figures.policy_picture(r.policy, r.run),
    "survival": lambda r: figures.survival(r.evaluation),
    "figure-3-frames": lambda r: strip(r.run, r.policy.arm),
    "figure-4-commands": lambda r: figures.commands(r.run),
    "figure-5-joints": lambda r: figures.joints(r.run),
    "figure-6-pendulum": lambda r: figures.pendulum(r.run),
    "figure-7-flange": lambda r: figures.flange(r.run),
}
"""The figures of every report, by the names of their files."""


def drawings(results: Results) -> Mapping[str, Draw]:
    """Return what is drawn of a reproduction, by the names of the files."""
    draw: dict[str, Draw] = dict(DRAWINGS)
    gap = results.gap
    if estimates_zero(results.run):
        draw["encoder-zero"] = lambda r: figures.encoder_zero(r.run)
    if gap is not None:
        draw["gap"] = lambda _: figures.gap_figure(gap)
    return draw


def build(out: Path, report: Callable[[str, float], None] = lambda _, __: None) -> Path:
    """Draw the figures of a reproduction and write its report.

    Args:
        out: The folder that `reproduce` left.
        report: Called with the name of each figure and the share of the work that is done.

    Returns:
        The page.

    Raises:
        ArtefactError: A file is missing, corrupt, or belongs to another reproduction.
        OutsideError: The disk refuses.
    """
    results = load(out)
    pictures: dict[str, str | Missing] = {}
    wanted = drawings(results)
    total = len(wanted) + FILM_WEIGHT
    for done, (name, draw) in enumerate(wanted.items()):
        report(name, done / total)
        try:
            figure = draw(results)
        except OutsideError as error:  # frames need OpenGL, which a machine may not have
            pictures[name] = Missing(str(error))
            continue
        svg, _ = save(figure, out / FIGURES / name)
        pictures[name] = svg.read_text(encoding="utf-8")
    film = _film(results, lambda share: report(FILM, (len(wanted) + FILM_WEIGHT * share) / total))
    if not isinstance(film, Missing):
        write_whole(out / FIGURES / FILM, film.webp)
    provenance = Provenance.model_validate(read_document(out / RECORD)["provenance"])
    write_whole(out / PAGE, page(results, pictures, film, provenance))
    report(PAGE, 1.0)
    return out / PAGE


def _film(results: Results, report: Callable[[float], None]) -> Animation | Missing:
    try:
        return animation(results.run, results.policy.arm, report=report)
    except OutsideError as error:
        return Missing(str(error))


def page(
    results: Results, pictures: Pictures, film: Animation | Missing, provenance: Provenance
) -> str:
    """Return the report as HTML.

    Args:
        results: What the reproduction found.
        pictures: Each figure of `drawings` as SVG, by its name.
        film: The beginning of the run.
        provenance: When and with what it was made.
    """
    css = resources.files("equipoise.report").joinpath("page.css").read_text(encoding="utf-8")
    parts: list[Part] = [
        *sections_training(results, pictures, film),
        *sections_results(results, pictures),
        assumptions(results),
        provenance_section(results, provenance),
    ]
    links = "".join(f'<a href="#{part.name}">{escape(part.title)}</a> ' for part in parts)
    quick = " A quick look, with fewer episodes and trials." if results.record.quick else ""
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Equipoise: a robot arm learns to balance a pendulum</title>
<style>
{css}</style>
</head>
<body>
<header>
<h1>A robot arm learns to balance a pendulum</h1>
<p class="subtitle">Safeea &amp; Neto, <cite>A Q-learning approach to the continuous control problem
of robot inverted pendulum balancing</cite> (Intelligent Systems with Applications), repeated in
simulation by Equipoise {escape(provenance.software.get("equipoise", ""))}.{quick}</p>
<nav aria-label="Contents">{links}</nav>
</header>
<main>
{"".join(part.html for part in parts)}</main>
<footer>Made by Equipoise on {escape(provenance.created[:10])} from the files beside it, which hold
every number that was measured here.</footer>
</body>
</html>
"""
