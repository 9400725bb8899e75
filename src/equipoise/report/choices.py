"""What the paper leaves open and what we chose, read from where the choices live.

`equipoise.settings` is their one home: the docstring of each field holds its unit, in brackets, and
its reason. Nothing is repeated here. Where a choice departs from what the paper says or surely did,
`departures` names it.
"""

import re
from collections.abc import Iterator
from math import degrees
from typing import Any, Final, NamedTuple

from equipoise.artefacts import Value
from equipoise.model.elementary import BATCH_SIZE
from equipoise.settings import RECIPES, LearningSettings, Settings

UNIT: Final = re.compile(r"\s*\[([^\]]+)\]")


DIFFERENT: Final = frozenset(name for recipe in RECIPES.values() for name in recipe)
"""The settings in which the recipes differ."""


class Choice(NamedTuple):
    """One setting."""

    name: str
    """As one types it: `learning.gamma`."""
    value: str
    """With its unit."""
    otherwise: str
    """The value in another recipe, where that differs."""
    reason: str
    """Why."""


class Chapter(NamedTuple):
    """A section of the settings."""

    title: str
    """What it is about."""
    choices: tuple[Choice, ...]
    """Its settings."""


def chapters(settings: Settings, other: Settings) -> Iterator[Chapter]:
    """Return all settings, section by section, with their reasons.

    Args:
        settings: What was used.
        other: Another recipe's settings, shown where recipes differ.
    """
    for section in Settings.model_fields:
        yield chapter(getattr(settings, section), section, getattr(other, section))


def chapter(values: Value, section: str = "", other: Value | None = None) -> Chapter:
    """Return the fields of one section.

    Args:
        values: The section, with a docstring under each field.
        section: Its name in the settings, if it is one of them.
        other: The same section in another recipe.
    """
    found: list[Choice] = []
    for key, field in type(values).model_fields.items():
        name = f"{section}.{key}" if section else key
        reason = " ".join((field.description or "").split())
        unit = match[1] if (match := UNIT.search(reason)) else ""
        value = _written(getattr(values, key), unit)
        otherwise = _written(getattr(other, key), unit) if name in DIFFERENT else ""
        found.append(
            Choice(
                name=name,
                value=value,
                otherwise="" if otherwise == value else otherwise,
                reason=UNIT.sub("", reason, count=1),
            )
        )
    title = (type(values).__doc__ or "").strip().splitlines()[0]
    return Chapter(title=title, choices=tuple(found))


def departures(settings: Settings) -> Iterator[str]:
    """Return where settings depart from the paper, in words."""
    plant, learning, selection = settings.plant, settings.learning, settings.selection
    controller = settings.controller
    if not plant.linearised:
        yield "The pendulum is nonlinear, in training and test (equation 7 is linear)."
    yield "A joint beyond its limits is a failure too (section 4.1: angle and track)."
    if not plant.ideal:
        yield (
            "The policy is trained behind a sensor and on an arm that follows late, as identified "
            "(section 4.2: the state is known, and the arm follows at once)."
        )
        if controller.predict:
            yield "It sees a prediction: the state at the moment when its command takes effect."
        if controller.estimate_bias:
            yield "The error of the encoder's zero is estimated while balancing, and taken off."
    yield (
        f"{BATCH_SIZE} episodes learn at once on one table, for speed (the paper, surely, had one "
        "after the other)."
    )
    paper = LearningSettings()
    if learning.learner != paper.learner:
        yield f"The learner is `{learning.learner}` (section 4.2: Q-learning, equation 1)."
    if learning.reward != paper.reward:
        yield f"The reward is `{learning.reward}`, not that of a failure alone."
    if learning.mirrored:
        yield "Every update is made for its mirror image as well: the task is symmetric."
    if learning.hold_action:
        yield (
            "An action is held until the state leaves its box, and updated then; equation 1 does "
            "so in each step."
        )
    if learning.start_x > 0.0:
        yield "Episodes start in many states, also off the middle and moving."
    if learning.alpha_decay > 0.0:
        yield "The learning rate falls with the visits of a pair."
    if learning.epsilon_until > 0.0:
        yield "Exploration fades out in the course of the training."
    if selection.every > 0:
        average = " a running average of" if selection.averaging < 1.0 else ""
        yield (
            f"The policy is not the last table: of{average} the tables of the training, the one "
            "that did best in trials of its own is kept."
        )
    yield "The simulator is ours (the paper: V-REP with MATLAB)."


def _written(value: Any, unit: str) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple):
        return ", ".join(_written(item, unit) for item in value)
    if not isinstance(value, float):
        return f"{value:,} {unit}".strip() if isinstance(value, int) else str(value)
    text = f"{value:.4g} {unit}".strip()
    if unit in ("rad", "rad/s") and value:
        text += f" ({degrees(value):,.4g}{unit.replace('rad', '°')})"
    return text
