"""Study and result of a sweep: ranges of settings, and the trials with their values."""

import json
from collections.abc import Mapping
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal, Self

from pydantic import Field, ValidationError, model_validator

from equipoise.artefacts import (
    Artefact,
    Count,
    Name,
    Number,
    Seed,
    Sentence,
    Share,
    StrPath,
    Value,
    first_fault,
)
from equipoise.errors import SettingsError
from equipoise.model.worlds import MODEL
from equipoise.settings import LONGEST_TRIAL, MOST_TRIALS, Settings, read_toml, resolve
from equipoise.worlds import find_world
from equipoise.worlds.evaluation import exact_interval

if TYPE_CHECKING:
    import optuna

MAX_TRIALS: Final = 100_000
"""Limit on the number of trials of a sweep: TPE compares each proposal with all trials before."""
MAX_PARAMETERS: Final = 64
"""Limit on the number of parameters of a sweep."""
MAX_CHOICES: Final = 1000
"""Limit on the number of choices of a parameter."""
UNUSED_SECTIONS: Final = ("identification", "evaluation")
"""Sections of the settings that do not affect a training."""

IntArray = Annotated[int, Field(ge=-(2**53), le=2**53)]
"""Integer end of an interval."""
Choices = Annotated[tuple[Any, ...], Field(min_length=1, max_length=MAX_CHOICES)]


class ParameterRange(Value):
    """Values of one setting in a sweep: `choices`, or an interval from `low` to `high`."""

    choices: Choices | None = None
    """Values of any type, such as the inner ends of intervals."""
    low: IntArray | Number | None = None
    """Lower end of the interval, in the unit of the setting."""
    high: IntArray | Number | None = None
    """Upper end of the interval, included."""
    step: Annotated[float, Field(gt=0.0)] | None = None
    """Distance of the values from `low` on; without it the interval is continuous."""
    log: bool = False
    """Whether values are drawn uniformly in their logarithm."""

    @property
    def whole(self) -> bool:
        """Whether the values are integers, as both ends are."""
        return isinstance(self.low, int) and isinstance(self.high, int)

    @model_validator(mode="after")
    def _is_one_of_both(self) -> Self:
        if self.choices is not None:
            if (self.low, self.high, self.step, self.log) != (None, None, None, False):
                raise ValueError("choices go without low, high, step and log")
            return self
        if self.low is None or self.high is None:
            raise ValueError("expected choices, or low and high")
        if self.low >= self.high:
            raise ValueError(f"low must be below high, got {self.low:g} and {self.high:g}")
        if self.log and self.low <= 0.0:
            raise ValueError(f"low must be positive with log, got {self.low:g}")
        if self.log and self.step is not None:
            raise ValueError("log goes without step")
        if self.whole and self.step is not None and not self.step.is_integer():
            raise ValueError(f"step must be an integer like both ends, got {self.step:g}")
        return self

    def grid(self) -> tuple[Any, ...] | None:
        """Return all values, or None for a continuous interval."""
        if self.choices is not None:
            return self.choices
        low, high = float(self.low or 0.0), float(self.high or 0.0)
        step = self.step or (1.0 if self.whole and not self.log else None)
        if step is None:
            return None
        values = [low + i * step for i in range(int((high - low) / step + 1e-9) + 1)]
        return tuple(round(value) for value in values) if self.whole else tuple(values)

    def distribution(self) -> "optuna.distributions.BaseDistribution":
        """Return the distribution for Optuna; choices are drawn by their index."""
        from optuna.distributions import (
            CategoricalDistribution,
            FloatDistribution,
            IntDistribution,
        )

        if self.choices is not None:
            return CategoricalDistribution(list(range(len(self.choices))))
        low, high = float(self.low or 0.0), float(self.high or 0.0)
        if self.whole:
            return IntDistribution(int(low), int(high), self.log, int(self.step or 1))
        return FloatDistribution(low, high, self.log, self.step)

    def value(self, drawn: Any) -> Any:
        """Return the value of the setting that a drawn number stands for."""
        return drawn if self.choices is None else self.choices[drawn]

    def extremes(self) -> tuple[Any, ...]:
        """Return the values that are validated before a sweep: all choices, or both ends."""
        return self.choices or (self.value(self._end(self.low)), self.value(self._end(self.high)))

    def _end(self, end: float | None) -> float:
        return int(end or 0) if self.whole else float(end or 0.0)


class SweepStudy(Value):
    """Content of a study file."""

    trials: Annotated[int, Field(ge=1, le=MAX_TRIALS)] | None = None
    """Number of trials; may be left out for a grid."""
    seed: Seed = 0
    """Master seed of proposals, trainings and evaluations."""
    sampler: Literal["tpe", "random", "grid"] = "tpe"
    """Source of the parameters: Optuna's tree-structured Parzen estimator, independent draws, or
    all combinations."""
    batch: Annotated[int, Field(ge=1, le=10_000)] = 8
    """Number of trials that `tpe` proposes together, which then run in parallel."""
    objective: Literal["survival", "duration"] = "survival"
    """Maximized quantity: share of tests that last, or mean duration of a test."""
    world: Name = MODEL
    """World of the tests."""
    tests: Annotated[int, Field(ge=1, le=MOST_TRIALS)] = 200
    """Number of tests of each policy."""
    duration: Annotated[float, Field(ge=0.01, le=LONGEST_TRIAL)] = 60.0
    """Length of a test [s]."""
    recipe: Literal["robust", "fine", "paper"] = "robust"
    """Recipe of the settings."""
    settings: dict[Name, dict[Name, Any]] = Field(default={})
    """Settings that all trials share, a table for each section."""
    parameters: Annotated[
        dict[Name, dict[Name, ParameterRange]], Field(min_length=1, max_length=MAX_PARAMETERS)
    ]
    """Ranges of the settings that are searched, a table for each section."""

    @property
    def ranges(self) -> dict[str, ParameterRange]:
        """Ranges by the dotted names of their settings, in alphabetical order."""
        return dict(
            sorted(
                (f"{section}.{key}", found)
                for section, keys in self.parameters.items()
                for key, found in keys.items()
            )
        )

    @property
    def count(self) -> int:
        """Number of trials."""
        if self.sampler != "grid":
            return self.trials or 0
        size = prod(len(found.grid() or ()) for found in self.ranges.values())
        return min(size, self.trials or size)

    def resolved(self, parameters: Mapping[str, Any] | None = None) -> Settings:
        """Return the settings with the values of parameters.

        Args:
            parameters: Values by the dotted names of the settings; by default none.

        Raises:
            SettingsError: A name is unknown or a value is invalid.
        """
        shared = {f"{s}.{key}": v for s, keys in self.settings.items() for key, v in keys.items()}
        values = {**shared, **(parameters or {})}
        return resolve(self.recipe, None, [f"{k}={json.dumps(v)}" for k, v in values.items()])


def read_study(path: StrPath) -> SweepStudy:
    """Read and validate a study file.

    Args:
        path: TOML file, see `SweepStudy`.

    Raises:
        SettingsError: The file is missing or not TOML, a field or a setting is unknown, or a value
            or an end of a range is invalid.
    """
    data = read_toml(Path(path), "a study")
    try:
        study = SweepStudy.model_validate(data)
    except ValidationError as error:
        fault = first_fault(error)
        raise SettingsError(f"{path}: {fault.where or 'study'}: {fault.what}") from None
    try:
        _check(study)
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from None
    return study


def _check(study: SweepStudy) -> None:
    ranges = study.ranges
    find_world(study.world)
    study.resolved()
    for name, found in ranges.items():
        section, _, key = name.partition(".")
        if section in UNUSED_SECTIONS:
            raise SettingsError(
                f"{name} does not affect a training; choose another parameter, and the tests by "
                "world, tests and duration"
            )
        if key in study.settings.get(section, {}):
            raise SettingsError(f"{name} is in settings and in parameters; give it once")
        for value in found.extremes():
            study.resolved({name: value})
    if study.sampler == "grid":
        if endless := [name for name, found in ranges.items() if found.grid() is None]:
            raise SettingsError(
                f"a grid needs a step or choices for {', '.join(endless)}; add them, or take the "
                "sampler tpe or random"
            )
        if study.count > MAX_TRIALS:
            raise SettingsError(
                f"the grid has {study.count:,} trials, at most {MAX_TRIALS:,} are allowed; give "
                "fewer values, or trials"
            )
    elif study.trials is None:
        raise SettingsError(f"trials is missing, expected a number with {study.sampler}; add it")


class SweepTrial(Value):
    """Result of one trial of a sweep."""

    index: Count
    """Index of the trial, from 0."""
    parameters: dict[Name, Any]
    """Values of the searched settings, by their dotted names."""
    tests: Count = 0
    """Number of tests; 0 for invalid settings."""
    survived: Count = 0
    """Number of tests that lasted."""
    duration: Annotated[float, Field(ge=0.0, le=LONGEST_TRIAL)] = 0.0
    """Mean duration of a test [s]."""
    error: Sentence = ""
    """Reason why these settings cannot be trained or tested; empty for a valid trial."""

    @property
    def survival(self) -> Share:
        """Share of tests that lasted."""
        return self.survived / self.tests if self.tests else 0.0

    @property
    def interval(self) -> tuple[float, float]:
        """Exact 95 % interval of that share."""
        return exact_interval(self.survived, self.tests) if self.tests else (0.0, 1.0)


class Sweep(Artefact):
    """All trials of a sweep."""

    FORMAT: ClassVar[str] = "equipoise-sweep"
    VERSION: ClassVar[int] = 1

    study: SweepStudy
    """The study."""
    pendulum: Name
    """Digest of the pendulum."""
    arm: Name
    """Digest of the arm."""
    actuators: tuple[Name, ...]
    """Digests of the given actuators; empty for the default of the settings."""
    trials: Annotated[tuple[SweepTrial, ...], Field(min_length=1, max_length=MAX_TRIALS)]
    """Trials in the order of their indices."""

    def value(self, trial: SweepTrial) -> float:
        """Return the objective of a trial: share of tests, or mean duration [s]."""
        return objective(self.study, trial)

    @property
    def ranking(self) -> list[SweepTrial]:
        """Valid trials from best to worst; of equal ones the lowest index first."""
        valid = [trial for trial in self.trials if not trial.error]
        return sorted(valid, key=lambda trial: (-self.value(trial), trial.index))


def objective(study: SweepStudy, trial: SweepTrial) -> float:
    """Return the maximized quantity of a trial: share of tests, or mean duration [s]."""
    return trial.survival if study.objective == "survival" else trial.duration
