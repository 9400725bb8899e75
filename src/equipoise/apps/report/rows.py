"""Rows of the report's tables: the paper beside the reproduction, estimates, trials, settings."""

import re
from collections.abc import Iterator
from math import degrees
from typing import Any

import numpy as np

from equipoise import paper
from equipoise.artefacts import Provenance, Value
from equipoise.model.worlds import MODEL, TwinSettings
from equipoise.outcomes import Outcome
from equipoise.reproduction.results import Results, truth
from equipoise.reproduction.synthetic_swing import SIMULATED_C
from equipoise.settings import BoxSettings, Settings, closest_recipe, resolve
from equipoise.worlds.evaluation import Evaluation
from equipoise.worlds.formatting import (
    format_end,
    format_failures,
    percent,
    plus_minus,
)

Row = tuple[str, ...]


def comparison(results: Results) -> Iterator[Row]:
    """Yield quantity, section of the paper, the paper's value, and that of the reproduction."""
    policy, run, evaluation = results.policy, results.run, results.evaluation
    trials, world = evaluation.results, run.conditions.world
    where = "on the training plant" if world == MODEL else f"on the twin {world}"
    yield "Robot", "3, 4.3", "a real seven-joint arm", f"a simulated {policy.arm.name}, {where}"
    period = f"{results.pendulum.period:.4f} s"
    yield "Period of the free swing", "3.2", f"around {paper.FREE_SWING_PERIOD:g} s", period
    boxes, actions = BoxSettings().count, len(paper.ACTIONS)
    ours = f"{len(policy.Q)} boxes × {len(policy.actions)} accelerations"
    yield "Table", "4.1", f"{boxes} boxes × {actions} accelerations", ours
    failure = f"|φ| reaches {paper.PHI_LIMIT_DEG:g}° or |x| reaches {paper.X_LIMIT:g} m"
    yield "Failure", "4.1", failure, "the same, or a joint exceeds its limits"
    yield "Control period", "4.2", f"{paper.STEP:g} s", f"{policy.h:g} s"
    latency = f"{1e3 * policy.actuator.delay.value:.1f} ms and the servo's lag in training"
    if policy.actuator.kind == "ideal":
        latency = "no delay in training"
    unknown = "no delay in simulation; not given for the robot"
    yield "Latency from command to motion", "4.2, 4.3", unknown, latency
    yield "Training episodes", "4.2", f"{paper.EPISODES:,}", f"{policy.episodes:,}"
    wall = results.record.stages.get("train", 0.0)
    yield "Training time", "4.4", "“few minutes”", f"{wall:.3g} s for {policy.steps:,} steps"
    seconds = f"{paper.SECONDS_BALANCED:g} s"
    runs = f"{len(trials.survival)} trials on the training plant and one recorded run"
    yield "Reported runs", "4.3", "one", runs
    longer = [
        survival >= paper.SECONDS_BALANCED or outcome == Outcome.LASTED
        for survival, outcome in zip(trials.survival, trials.outcomes, strict=True)
    ]
    yield f"Trials that stood {seconds}", "4.3", "one of one", percent(float(np.mean(longer)))
    true = truth(run)
    end = f"{format_end(run.outcome)} after {run.lasted:g} s, x = {true.x[-1]:.3f} m, φ = "
    end += f"{np.rad2deg(true.phi[-1]):.2f}°"
    published = (
        f"x passed {paper.X_AT_FAILURE:g} m after {seconds}, φ = {paper.PHI_AT_FAILURE_DEG}°"
    )
    yield "End of the run", "4.3", published, end


def estimates(results: Results) -> Iterator[Row]:
    """Yield each parameter of the pendulum: symbol, unit, estimate, and the simulated value."""
    pendulum, known = results.pendulum, dict[str, float]()
    if results.record.simulated:
        w2 = (2.0 * np.pi / paper.FREE_SWING_PERIOD) ** 2
        known = {"w2 = m g l / I": w2, "k = m l / I": w2 / pendulum.g, "c = b / I": SIMULATED_C}
    parameters = {
        ("w2 = m g l / I", "1/s²"): pendulum.w2,
        ("k = m l / I", "1/m"): pendulum.k,
        ("c = b / I", "1/s"): pendulum.c,
        ("dry friction / I", "1/s²"): pendulum.coulomb,
        ("quadratic drag / I", "1/rad"): pendulum.drag,
        ("I", "kg m²"): pendulum.inertia,
        ("b", "N m s"): pendulum.friction,
    }
    for (name, unit), estimate in parameters.items():
        if estimate and estimate.value:
            true = f"{known[name]:.6g}" if name in known else ""
            yield name, unit, plus_minus(estimate.value, estimate.interval), true


def trials(evaluation: Evaluation) -> Iterator[Row]:
    """Yield the results of the policy and of each baseline."""
    for results in (evaluation.results, *evaluation.baselines):
        summary = results.summary()
        interval = " to ".join(map(percent, summary.interval))
        share, median = f"{summary.survived} of {summary.trials}", f"{summary.median:.3g} s"
        yield results.name, share, interval, median, format_failures(summary.outcomes)


def conditions(results: Results) -> Iterator[Row]:
    """Yield what the policy was trained for and what the recorded run had."""
    known, units = results.pendulum.parameters(), {"w2": "1/s²", "k": "1/m", "c": "1/s"}
    for name, value in results.run.conditions.pendulum.items():
        unit = units.get(name, "1/rad" if name == "drag" else "1/s²")
        yield f"{name} [{unit}]", f"{getattr(known, name):.4g}", f"{value:.4g}"
    if (zero := results.run.conditions.zero_error) is not None:
        yield "error of the encoder's zero", "unknown", f"{np.rad2deg(zero):+.2f}°"
    x, x_dot, *angles = results.run.conditions.start or (0.0,) * 4
    phi, phi_dot = np.rad2deg(angles)
    start = f"x = {x:g} m, dx/dt = {x_dot:g} m/s, φ = {phi:.2f}°, dφ/dt = {phi_dot:.1f}°/s"
    yield "start", "unknown", start
    yield "end", "", f"{format_end(results.run.outcome)}, {results.run.lasted:g} s"


def settings(results: Results) -> Iterator[tuple[str, list[Row]]]:
    """Yield title and rows of each section: name, value, value in the other recipe, reason.

    Unit and reason of a setting stand in the docstring of its field.
    """
    recipe, _ = closest_recipe(results.policy.settings)
    other = resolve("robust" if recipe == "paper" else "paper")
    for section in Settings.model_fields:
        values = getattr(results.policy.settings, section)
        title = (type(values).__doc__ or "").strip().splitlines()[0].rstrip(".")
        yield title, list(_fields(values, f"{section}.", getattr(other, section)))
    conditions = results.run.conditions
    if conditions.world_settings:
        world = TwinSettings.model_validate(conditions.world_settings)
        yield f"World of the recorded run: {conditions.world}", list(_fields(world, "", world))


def _fields(values: Value, prefix: str, other: Value) -> Iterator[Row]:
    for key, field in type(values).model_fields.items():
        reason = " ".join((field.description or "").split())
        unit = found[1] if (found := re.search(r"\s*\[([^\]]+)\]", reason)) else ""
        value, there = (_format(getattr(each, key), unit) for each in (values, other))
        reason = re.sub(r"\s*\[[^\]]+\]", "", reason, count=1)
        yield f"`{prefix}{key}`", value, "" if there == value else there, reason


def _format(value: Any, unit: str) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple):
        items: tuple[Any, ...] = value
        return ", ".join(_format(item, unit) for item in items)
    if not isinstance(value, float):
        return f"{value:,} {unit}".strip() if isinstance(value, int) else str(value)
    text = f"{value:.4g} {unit}".strip()
    if unit in ("rad", "rad/s") and value:
        text += f" ({degrees(value):,.4g}{unit.replace('rad', '°')})"
    return text


def provenance(results: Results, provenance: Provenance) -> Iterator[Row]:
    """Yield seeds, digests of the files, times and versions."""
    record = results.record
    yield "master seed, learner", f"{record.seed}, {results.policy.learner}"
    yield "recipe, arm", f"{results.policy.recipe}, {results.policy.arm.name}"
    yield "swing", "simulated" if record.simulated else f"{record.swing}, {record.swing_sha256}"
    yield from record.files.items()
    for stage, duration in record.stages.items():
        yield f"time of {stage}", f"{duration:.2f} s with {record.workers} threads"
    yield from sorted(provenance.software.items())
    yield "created", provenance.created


def commands(results: Results) -> Iterator[str]:
    """Yield the commands that repeat the reproduction, or one stage from the files."""
    record, world = results.record, results.run.conditions.world
    recipe, _ = closest_recipe(results.policy.settings)
    options = {
        f" --swing {record.swing}": not record.simulated,
        f" --recipe {recipe}": recipe != "robust",
        f" --seed {record.seed}": bool(record.seed),
        " --quick": record.quick,
    }
    yield "equipoise reproduce" + "".join(text for text, given in options.items() if given)
    yield "equipoise identify swing.csv --out pendulum.json"
    yield "equipoise train pendulum.json --out policy.json"
    yield f"equipoise evaluate policy.json --world {world}"
    yield f"equipoise deploy policy.json --world {world}"
    yield "equipoise log explain run.mcap"
