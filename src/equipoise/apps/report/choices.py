"""Settings with their values and reasons, and deviations from the paper.

The docstring of each field in `equipoise.settings` holds its unit, in brackets, and its reason.
They are read from there and not repeated here. `departures` lists the settings that contradict the
paper.
"""

import re
from collections.abc import Iterator
from math import degrees
from typing import Any, Final, NamedTuple

from equipoise.artefacts import Value
from equipoise.model.elementary import BATCH_SIZE
from equipoise.settings import RECIPES, BoxSettings, LearningSettings, Settings

UNIT: Final = re.compile(r"\s*\[([^\]]+)\]")
DIFFERENT: Final = frozenset(name for recipe in RECIPES.values() for name in recipe)
"""Names of the settings that differ between recipes."""


class Choice(NamedTuple):
    """One setting."""

    name: str
    """Name on the command line: `learning.gamma`."""
    value: str
    """Value with its unit."""
    otherwise: str
    """Value in the other recipe; empty if equal."""
    reason: str
    """Reason for the value."""


class Chapter(NamedTuple):
    """A section of the settings."""

    title: str
    """Heading."""
    choices: tuple[Choice, ...]
    """Settings of the section."""


def chapters(settings: Settings, other: Settings) -> Iterator[Chapter]:
    """Return all settings, section by section, with their reasons.

    Args:
        settings: Settings of the reproduction.
        other: Settings of the other recipe, shown where the recipes differ.
    """
    for section in Settings.model_fields:
        yield chapter(getattr(settings, section), section, getattr(other, section))


def chapter(values: Value, section: str = "", other: Value | None = None) -> Chapter:
    """Return the fields of one section.

    Args:
        values: The section, with a docstring under each field.
        section: Name of the section in the settings; empty for other values.
        other: The same section in the other recipe.
    """
    found: list[Choice] = []
    for key, field in type(values).model_fields.items():
        name = f"{section}.{key}" if section else key
        reason = " ".join((field.description or "").split())
        unit = match[1] if (match := UNIT.search(reason)) else ""
        value = _format_value(getattr(values, key), unit)
        otherwise = _format_value(getattr(other, key), unit) if name in DIFFERENT else ""
        otherwise = "" if otherwise == value else otherwise
        found.append(Choice(name, value, otherwise, UNIT.sub("", reason, count=1)))
    title = (type(values).__doc__ or "").strip().splitlines()[0]
    return Chapter(title=title, choices=tuple(found))


def departures(settings: Settings) -> Iterator[str]:
    """Return the deviations of settings from the paper, one sentence each."""
    plant, learning, selection = settings.plant, settings.learning, settings.selection
    controller, paper = settings.controller, LearningSettings()
    if not plant.linearised:
        yield "The pendulum is nonlinear, in training and test (equation 7 is linear)."
    yield "Exceeding a joint limit is a failure too (section 4.1: angle and track)."
    if not plant.ideal:
        yield (
            "The training plant has a sensor, and an arm with delay and lag, as identified "
            "(section 4.2: the state is known, and the arm follows at once)."
        )
        if controller.predict:
            yield "The table receives a prediction of the state at which its command takes effect."
        if controller.estimate_bias:
            yield "The error of the encoder's zero is estimated while balancing, and subtracted."
    if not settings.boxes.same_ends(BoxSettings()):
        yield f"The table has {settings.boxes.count} boxes (section 4.1: 270)."
    if settings.boxes.look_ahead > 0.0:
        yield (
            f"The x that selects a box is continued over {settings.boxes.look_ahead:g} s at the "
            "velocity of the pendulum's centre of percussion."
        )
    yield (
        f"{BATCH_SIZE} episodes learn at once on one table, for speed (the paper: presumably one "
        "after the other)."
    )
    if learning.learner != paper.learner:
        yield f"The learner is `{learning.learner}` (section 4.2: Q-learning, equation 1)."
    if learning.reward != paper.reward:
        yield f"The reward is `{learning.reward}`, not that of a failure alone."
    if learning.mirrored:
        yield "Every update is also made for its mirror image: the task is symmetric."
    if learning.hold_action:
        yield "An action is held until the state leaves its box; equation 1 updates in each step."
    if learning.start_x > 0.0:
        yield "Episodes start in many states, also away from the middle and moving."
    if learning.alpha_decay > 0.0:
        yield "The learning rate falls with the visits of a pair."
    if learning.epsilon_until > 0.0:
        yield "Exploration decays in the course of the training."
    if selection.every > 0:
        average = " a running average of" if selection.averaging < 1.0 else ""
        yield (
            f"The policy is not the last table: of{average} the late tables of the training, the "
            "one with the best result in separate trials is kept."
        )
    yield "The simulator is ours (the paper: V-REP with MATLAB)."


def _format_value(value: Any, unit: str) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple):
        return ", ".join(_format_value(item, unit) for item in value)
    if not isinstance(value, float):
        return f"{value:,} {unit}".strip() if isinstance(value, int) else str(value)
    text = f"{value:.4g} {unit}".strip()
    if unit in ("rad", "rad/s") and value:
        text += f" ({degrees(value):,.4g}{unit.replace('rad', '°')})"
    return text
