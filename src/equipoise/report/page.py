"""The report: one self-contained HTML file, drawn from the results of a reproduction.

`build` draws every figure into `figures/` and embeds all of them in `report.html`. The page fetches
no file and runs no script; it can be printed, mailed and archived.
"""

import base64
import re
from collections.abc import Callable, Iterator
from importlib.metadata import metadata
from pathlib import Path
from typing import Any, Final

import jinja2
import numpy as np
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from equipoise import paper
from equipoise.errors import OutsideError
from equipoise.files import Provenance, Value, write_atomically
from equipoise.film import write_film
from equipoise.model.worlds import MODEL, TwinSettings
from equipoise.outcomes import Outcome
from equipoise.printable import as_text, label, plus_minus, printable
from equipoise.report import figures
from equipoise.report.style import save
from equipoise.reproduction.results import SWING, RecipeResults, Results
from equipoise.settings import BoxSettings, Settings
from equipoise.simulation.evaluation import Evaluation, exact_interval

PAGE: Final = "report.html"
FIGURES: Final[dict[str, Callable[[Results], Figure]]] = {
    "swing": lambda r: figures.free_swing(r.swing, r.pendulum),
    "learning-curve": lambda r: figures.learning_curve(r.default.policy),
    "survival": lambda r: figures.survival(r.default.evaluation),
    "policy": lambda r: figures.policy_picture(r.default.policy),
    "literal-run": lambda r: figures.run_figure("Literal recipe", r.literal.run, r.default.run),
    "run": lambda r: figures.run_figure("Default recipe", r.default.run, r.literal.run),
    "swing-up": lambda r: figures.swing_up(r.swing_up),
}
"""Drawing functions of the figures, by the names of their files."""


def build(results: Results, out: Path) -> Path:
    """Draw the figures of a reproduction and write its report.

    Args:
        results: Results of the reproduction.
        out: Folder of the page, and of the folder `figures`.

    Returns:
        The path of the page.

    Raises:
        OutsideError: Writing fails.
    """
    images = dict[str, str]()
    for name, draw in FIGURES.items():
        svg, _ = save(draw(results), out / "figures" / name)
        images[name] = _data_uri("svg+xml", svg.read_bytes())
    film, missing = out / "figures" / "film.webp", ""
    try:
        run = results.default.run
        write_film(run, film, end=min(run.survival, 8.0))  # [s]; the paper's run took 5 s
        images["film"] = _data_uri("webp", film.read_bytes())
    except OutsideError as error:  # OpenGL may be missing
        missing = str(error)
    provenance = Provenance.now("reproduce", None)
    write_atomically(out / PAGE, page(results, images, provenance, missing))
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
        loader=jinja2.PackageLoader("equipoise.report", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        finalize=_printable,
    )
    environment.filters["prose"] = _prose
    addresses = dict(line.split(", ") for line in metadata("equipoise").get_all("Project-URL", ()))
    return environment.get_template("report.html.j2").render(
        results=results,
        run=results.default.run,
        policy=results.default.policy,
        repository=addresses["Repository"],
        settings=results.default.policy.settings,
        provenance=provenance,
        digests={SWING: results.swing.sha256}
        | {name: value.digest for name, value in results.files().items()},
        images=images,
        missing=missing,
        paper=paper,
        task=_task(results),
        sections_of_settings=_settings(results),
        compared=[
            (label(name), *map(as_text, cells.values()))
            for name, cells in comparison(results).items()
        ],
        degrees=np.rad2deg,
    )


def _data_uri(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def _printable(value: Any) -> Any:
    """Escape the control characters of a text, whose markup the template engine escapes."""
    return printable(value, layout=True) if type(value) is str else value


def _prose(text: str) -> Markup:
    """Return a text with code between backticks."""
    return Markup(re.sub("`([^`]+)`", r"<code>\1</code>", str(escape(printable(text)))))


def comparison(results: Results) -> dict[str, dict[str, Any]]:
    """Return the figures of the paper's robot and of both recipes, by names that end in the unit.

    An interval is that of the fraction of trials that survived the time above it.
    """
    seconds = paper.SECONDS_BALANCED
    robot = {
        "robot_or_twin_trials": 1,
        "robot_or_twin_median_s": seconds,
        f"robot_or_twin_survived_{seconds:g}s": 1,
        "robot_or_twin_ended_by": {Outcome.TRACK: 1},
        "run_s": seconds,
        "run_ended_by": Outcome.TRACK,
        "lean_at_its_end_deg": paper.PHI_AT_FAILURE_DEG,
        "x_at_its_end_m": paper.X_AT_FAILURE,
    }
    columns = {
        "paper's robot": robot,
        "literal recipe": _figures(results.literal),
        "default recipe": (default := _figures(results.default)),
    }
    return {
        name: {title: figures.get(name, "not stated") for title, figures in columns.items()}
        for name in default
    }


def _figures(recipe: RecipeResults) -> dict[str, Any]:
    """Return the figures of a recipe; without a twin, none of its trials there."""
    run, true, on_twin = recipe.run, recipe.run.truth, recipe.twin_evaluation
    there = _trials("robot_or_twin", on_twin, paper.SECONDS_BALANCED) if on_twin else {}
    return {
        "delay_in_training_ms": round(1e3 * recipe.policy.actuator.delay.value, 1),
        **_trials("simulation", recipe.evaluation, recipe.evaluation.duration),
        **there,
        "run_s": run.survival,
        "run_ended_by": run.outcome,
        "lean_at_its_end_deg": round(float(np.rad2deg(true.phi[-1])), 2),
        "x_at_its_end_m": round(float(true.x[-1]), 3),
    }


def _trials(where: str, evaluation: Evaluation, seconds: float) -> dict[str, Any]:
    """Return the figures of trials: their median, and how many survived a time [s]."""
    summary = evaluation.results.summary()
    survived = sum(survival >= seconds for survival in evaluation.results.survival)
    return {
        f"{where}_trials": summary.trials,
        f"{where}_median_s": summary.median,
        f"{where}_survived_{seconds:g}s": survived,
        f"{where}_interval_95": exact_interval(survived, summary.trials),
        f"{where}_ended_by": summary.outcomes,
    }


def _task(results: Results) -> Iterator[tuple[str, ...]]:
    """Yield quantity, section of the paper, the paper's value, and that of the reproduction."""
    policy, world = results.default.policy, results.default.run.conditions.world
    where = "in simulation" if world == MODEL else f"on the twin {world}"
    yield "Robot", "3, 4.3", "a real seven-joint arm", f"a simulated {policy.arm.name}, {where}"
    period, w2, c = results.pendulum.period, results.pendulum.w2, results.pendulum.c
    expected = f"around {paper.FREE_SWING_PERIOD:g} s"
    yield "Period of the free swing", "3.2", expected, f"{period:.4f} s"
    yield "w2 = m g l / I [1/s²]", "3.2", "not stated", plus_minus(w2.value, w2.interval)
    yield "c = b / I [1/s]", "3.2", "not stated", plus_minus(c.value, c.interval)
    boxes, actions = BoxSettings().count, len(paper.ACTIONS)
    ours = f"{len(policy.Q)} boxes × {len(policy.actions)} accelerations"
    yield "Table", "4.1", f"{boxes} boxes × {actions} accelerations", ours
    failure = f"|φ| reaches {paper.PHI_LIMIT_DEG:g}° or |x| reaches {paper.X_LIMIT:g} m"
    yield "Failure", "4.1", failure, "the same, or a joint exceeds its limits"
    yield "Control period", "4.2", f"{paper.STEP:g} s", f"{policy.h:g} s"
    yield "Training episodes", "4.2", f"{paper.EPISODES:,}", f"{policy.episodes:,}"
    wall = results.training_s
    yield "Training time", "4.4", "“few minutes”", f"{wall:.3g} s for {policy.steps:,} steps"
    recipes = f"literal: {results.literal.policy.recipe}; default: {policy.recipe}"
    yield "Recipes", "4.2", "learning rate, exploration and reward not stated", recipes


def _settings(results: Results) -> Iterator[tuple[str, list[tuple[str, ...]]]]:
    """Yield title and rows of each section: name, value, reason.

    Unit and reason of a setting stand in the docstring of its field.
    """
    for section in Settings.model_fields:
        values = getattr(results.default.policy.settings, section)
        title = (type(values).__doc__ or "").strip().splitlines()[0].rstrip(".")
        yield title, list(_setting_rows(values, f"{section}."))
    conditions = results.default.run.conditions
    if conditions.world_settings:
        world = TwinSettings.model_validate(conditions.world_settings)
        yield f"World of the recorded run: {conditions.world}", list(_setting_rows(world, ""))


def _setting_rows(values: Value, prefix: str) -> Iterator[tuple[str, ...]]:
    for key, field in type(values).model_fields.items():
        reason, value = " ".join((field.description or "").split()), getattr(values, key)
        items: Any = value if isinstance(value, tuple) else (value,)
        text = ", ".join(f"{item:.4g}" if isinstance(item, float) else f"{item}" for item in items)
        yield f"`{prefix}{key}`", text, reason
