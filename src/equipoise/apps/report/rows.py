"""Rows of the report's tables: the paper beside both recipes, the task, and the settings."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from equipoise import paper
from equipoise.artefacts import Value
from equipoise.logs.motion import truth
from equipoise.model.worlds import MODEL, TwinSettings
from equipoise.outcomes import Outcome
from equipoise.printable import plus_minus
from equipoise.reproduction.results import RecipeResults, Results
from equipoise.settings import BoxSettings, Settings
from equipoise.worlds.evaluation import Evaluation, exact_interval

Row = tuple[str, ...]


def comparison(results: Results) -> dict[str, dict[str, Any]]:
    """Return the figures of the paper's robot and of both recipes, by names that end in the unit.

    An interval is that of the share of trials that stood for the time above it.
    """
    seconds = paper.SECONDS_BALANCED
    robot = {
        "robot_or_twin_trials": 1,
        "robot_or_twin_median_s": seconds,
        f"robot_or_twin_stood_{seconds:g}s": 1,
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
    run, true, on_twin = recipe.run, truth(recipe.run), recipe.twin_evaluation
    there = _trials("robot_or_twin", on_twin, paper.SECONDS_BALANCED) if on_twin else {}
    return {
        "delay_in_training_ms": round(1e3 * recipe.policy.actuator.delay.value, 1),
        **_trials("simulation", recipe.evaluation, recipe.evaluation.duration),
        **there,
        "run_s": run.lasted,
        "run_ended_by": run.outcome,
        "lean_at_its_end_deg": round(float(np.rad2deg(true.phi[-1])), 2),
        "x_at_its_end_m": round(float(true.x[-1]), 3),
    }


def _trials(where: str, evaluation: Evaluation, seconds: float) -> dict[str, Any]:
    """Return the figures of trials: their median, and how many stood for a time [s]."""
    summary = evaluation.results.summary()
    stood = sum(survival >= seconds for survival in evaluation.results.survival)
    return {
        f"{where}_trials": summary.trials,
        f"{where}_median_s": summary.median,
        f"{where}_stood_{seconds:g}s": stood,
        f"{where}_interval_95": exact_interval(stood, summary.trials),
        f"{where}_ended_by": summary.outcomes,
    }


def task(results: Results) -> Iterator[Row]:
    """Yield quantity, section of the paper, the paper's value, and that of the reproduction."""
    policy, world = results.default.policy, results.default.run.conditions.world
    where = "in simulation" if world == MODEL else f"on the twin {world}"
    yield "Robot", "3, 4.3", "a real seven-joint arm", f"a simulated {policy.arm.name}, {where}"
    period = f"{results.pendulum.period:.4f} s"
    yield "Period of the free swing", "3.2", f"around {paper.FREE_SWING_PERIOD:g} s", period
    pendulum = results.pendulum
    for name, one in {"w2 = m g l / I [1/s²]": pendulum.w2, "c = b / I [1/s]": pendulum.c}.items():
        yield name, "3.2", "not stated", plus_minus(one.value, one.interval)
    boxes, actions = BoxSettings().count, len(paper.ACTIONS)
    ours = f"{len(policy.Q)} boxes × {len(policy.actions)} accelerations"
    yield "Table", "4.1", f"{boxes} boxes × {actions} accelerations", ours
    failure = f"|φ| reaches {paper.PHI_LIMIT_DEG:g}° or |x| reaches {paper.X_LIMIT:g} m"
    yield "Failure", "4.1", failure, "the same, or a joint exceeds its limits"
    yield "Control period", "4.2", f"{paper.STEP:g} s", f"{policy.h:g} s"
    yield "Training episodes", "4.2", f"{paper.EPISODES:,}", f"{policy.episodes:,}"
    wall = results.record.training_s
    yield "Training time", "4.4", "“few minutes”", f"{wall:.3g} s for {policy.steps:,} steps"
    recipes = f"literal: {results.literal.policy.recipe}; default: {policy.recipe}"
    yield "Recipes", "4.2", "learning rate, exploration and reward not stated", recipes


def settings(results: Results) -> Iterator[tuple[str, list[Row]]]:
    """Yield title and rows of each section: name, value, reason.

    Unit and reason of a setting stand in the docstring of its field.
    """
    for section in Settings.model_fields:
        values = getattr(results.default.policy.settings, section)
        title = (type(values).__doc__ or "").strip().splitlines()[0].rstrip(".")
        yield title, list(_fields(values, f"{section}."))
    conditions = results.default.run.conditions
    if conditions.world_settings:
        world = TwinSettings.model_validate(conditions.world_settings)
        yield f"World of the recorded run: {conditions.world}", list(_fields(world, ""))


def _fields(values: Value, prefix: str) -> Iterator[Row]:
    for key, field in type(values).model_fields.items():
        reason, value = " ".join((field.description or "").split()), getattr(values, key)
        items: Any = value if isinstance(value, tuple) else (value,)
        text = ", ".join(f"{one:.4g}" if isinstance(one, float) else f"{one}" for one in items)
        yield f"`{prefix}{key}`", text, reason
