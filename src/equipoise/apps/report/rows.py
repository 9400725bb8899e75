"""Rows of the report's tables: the paper beside the reproduction, and the settings."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from equipoise import paper
from equipoise.artefacts import Value
from equipoise.logs.motion import truth
from equipoise.model.worlds import MODEL, TwinSettings
from equipoise.outcomes import Outcome
from equipoise.reproduction.results import Results
from equipoise.settings import BoxSettings, Settings
from equipoise.worlds.formatting import format_end, percent, plus_minus

Row = tuple[str, ...]


def comparison(results: Results) -> Iterator[Row]:
    """Yield quantity, section of the paper, the paper's value, and that of the reproduction."""
    policy, run, evaluation = results.policy, results.run, results.evaluation
    trials, world = evaluation.results, run.conditions.world
    where = "on the training plant" if world == MODEL else f"on the twin {world}"
    yield "Robot", "3, 4.3", "a real seven-joint arm", f"a simulated {policy.arm.name}, {where}"
    period = f"{results.pendulum.period:.4f} s"
    yield "Period of the free swing", "3.2", f"around {paper.FREE_SWING_PERIOD:g} s", period
    pendulum = results.pendulum
    for name, one in {"w2 = m g l / I [1/s²]": pendulum.w2, "c = b / I [1/s]": pendulum.c}.items():
        yield name, "3.2", "not given", plus_minus(one.value, one.interval)
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


def settings(results: Results) -> Iterator[tuple[str, list[Row]]]:
    """Yield title and rows of each section: name, value, reason.

    Unit and reason of a setting stand in the docstring of its field.
    """
    for section in Settings.model_fields:
        values = getattr(results.policy.settings, section)
        title = (type(values).__doc__ or "").strip().splitlines()[0].rstrip(".")
        yield title, list(_fields(values, f"{section}."))
    conditions = results.run.conditions
    if conditions.world_settings:
        world = TwinSettings.model_validate(conditions.world_settings)
        yield f"World of the recorded run: {conditions.world}", list(_fields(world, ""))


def _fields(values: Value, prefix: str) -> Iterator[Row]:
    for key, field in type(values).model_fields.items():
        reason, value = " ".join((field.description or "").split()), getattr(values, key)
        items: Any = value if isinstance(value, tuple) else (value,)
        text = ", ".join(f"{one:.4g}" if isinstance(one, float) else f"{one}" for one in items)
        yield f"`{prefix}{key}`", text, reason
