"""The report: one self-contained HTML file, drawn from the files of a reproduction.

`build` draws every figure into `figures/` and embeds all of them in `report.html`. The page fetches
no file and runs no script; it can be printed, mailed and archived.
"""

from collections.abc import Callable, Mapping
from functools import partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Final

from equipoise.apps.report import figures
from equipoise.apps.report.appendix import assumptions, provenance_section
from equipoise.apps.report.markup import Missing, Part, Pictures, escape, picture
from equipoise.apps.report.pictures import Animation, animation, strip
from equipoise.apps.report.sections_results import sections_results
from equipoise.apps.report.sections_training import sections_training
from equipoise.apps.report.style import save
from equipoise.artefacts import Provenance, read_document, write_whole
from equipoise.errors import OutsideError
from equipoise.reproduction.results import RECORD, Results, estimates_zero, load

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE: Final = "report.html"
FIGURES: Final = "figures"
FILM: Final = "figure-3-film.webp"
"""The animation among the figures."""
FILM_WEIGHT: Final = 4
"""Time to draw the animation, in units of the mean time per figure; for the progress display."""

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
"""Drawing functions of every report, by the names of their files."""


def drawings(results: Results) -> Mapping[str, Draw]:
    """Return the drawing functions for a reproduction, by the names of their files."""
    draw: dict[str, Draw] = dict(DRAWINGS)
    if estimates_zero(results.run):
        draw["encoder-zero"] = lambda r: figures.encoder_zero(r.run)
    return draw


def build(out: Path, report: Callable[[str, float], None] = lambda _, __: None) -> Path:
    """Draw the figures of a reproduction and write its report.

    Args:
        out: Output folder of `reproduce`.
        report: Progress callback; receives the name of each figure and the fraction done.

    Returns:
        The path of the page.

    Raises:
        ArtefactError: A file is missing, corrupt, or belongs to another reproduction.
        OutsideError: Writing fails.
    """
    results = load(out)
    pictures: dict[str, str | Missing] = {}
    wanted = drawings(results)
    total = len(wanted) + FILM_WEIGHT
    for done, (name, draw) in enumerate(wanted.items()):
        report(name, done / total)
        try:
            figure = draw(results)
        except OutsideError as error:  # frames need OpenGL, which may be missing
            pictures[name] = Missing(str(error))
            continue
        svg, _ = save(figure, out / FIGURES / name)
        pictures[name] = svg.read_text(encoding="utf-8")
    try:
        film = animation(
            results.run,
            results.policy.arm,
            report=lambda share: report(FILM, (len(wanted) + FILM_WEIGHT * share) / total),
        )
    except OutsideError as error:
        film = Missing(str(error))
    else:
        write_whole(out / FIGURES / FILM, film.webp)
    provenance = Provenance.model_validate(read_document(out / RECORD)["provenance"])
    write_whole(out / PAGE, page(results, pictures, film, provenance))
    report(PAGE, 1.0)
    return out / PAGE


def page(
    results: Results, pictures: Pictures, film: Animation | Missing, provenance: Provenance
) -> str:
    """Return the report as HTML.

    Args:
        results: Results of the reproduction.
        pictures: Each figure of `drawings` as SVG, by its name.
        film: Animation of the first seconds of the run.
        provenance: Time and software versions of the reproduction.
    """
    css = resources.files("equipoise.apps.report").joinpath("page.css").read_text(encoding="utf-8")
    embed = partial(picture, pictures)
    parts: list[Part] = [
        *sections_training(results, embed, film),
        *sections_results(results, embed),
        assumptions(results),
        provenance_section(results, provenance),
    ]
    links = "".join(f'<a href="#{part.name}">{escape(part.title)}</a> ' for part in parts)
    quick = " Quick run, with fewer episodes and trials." if results.record.quick else ""
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
of robot inverted pendulum balancing</cite> (Intelligent Systems with Applications), reproduced in
simulation with Equipoise {escape(provenance.software.get("equipoise", ""))}.{quick}</p>
<nav aria-label="Contents">{links}</nav>
</header>
<main>
{"".join(part.html for part in parts)}</main>
<footer>Generated by Equipoise on {escape(provenance.created[:10])} from the files in its folder,
which hold all measured numbers.</footer>
</body>
</html>
"""
