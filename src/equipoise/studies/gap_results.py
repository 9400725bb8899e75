"""Results of a study of the gap: trials, seconds of balance with intervals, and sentences.

`equipoise.studies.gap` makes them, and describes the comparisons.
"""

from collections.abc import Mapping
from math import degrees, sqrt
from typing import Annotated, ClassVar, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field
from scipy.stats import t as student

from equipoise import paper
from equipoise.artefacts import Artefact, Name, Number, Seed, Value
from equipoise.model.worlds import PivotFriction, TwinSettings
from equipoise.outcomes import Outcome
from equipoise.settings import Settings
from equipoise.worlds.evaluation import CONFIDENCE, TrialResults
from equipoise.worlds.formatting import percent

Array = npt.NDArray[np.float64]
Controller = Literal["cured", "not told", "no prediction", "no bias estimate", "paper"]
Part = Literal["plant", "clean", "world", "delay", "zero", "alone", "without", "named"]

CURED: Final = "cured"
UNTUNED: Final = "not told"
NO_PREDICTION: Final = "no prediction"
NO_BIAS: Final = "no bias estimate"
PAPER: Final = "paper"

LABELS: Final[Mapping[Controller, str]] = {
    CURED: "with its cures",
    UNTUNED: "cures not told of the change",
    NO_PREDICTION: "without prediction",
    NO_BIAS: "without bias estimate",
    PAPER: "trained as the paper describes",
}
"""Label of each controller in figures and tables."""
NONE: Final = "none"
"""Text of an empty list of effects."""


class GapPoint(Value):
    """The trials of one controller under one condition."""

    part: Part
    """`plant`: the training plant; `clean`, `world`: the clean and the full twin; `delay`, `zero`:
    a point of a curve; `alone`, `without`: one effect switched on, one effect removed; `named`: a
    named world."""
    controller: Controller
    """The controller."""
    on_clean: bool = False
    """Whether a point of a curve is on the clean twin."""
    name: Name = ""
    """Name of the effect or of the world."""
    at: Number = 0.0
    """Transport delay [s] or error of the zero [rad] of a point of a curve."""
    results: TrialResults
    """Results; trial i has the same start at every point."""

    @property
    def axis_value(self) -> float:
        """Transport delay in ms, or error of the zero in degrees."""
        return round(1e3 * self.at if self.part == "delay" else degrees(self.at), 6)

    @property
    def condition(self) -> str:
        """Transport delay or error of the zero as text."""
        return f"{self.axis_value:g} {'ms' if self.part == 'delay' else 'deg'}"


class Seconds(NamedTuple):
    """Mean survival, or a difference of means, with a 95 % interval (Student's)."""

    mean: float
    """Mean [s]."""
    low: float
    """Lower end [s]."""
    high: float
    """Upper end [s]."""

    @property
    def text(self) -> str:
        """Mean and interval as text.

        Example:
            >>> Seconds(5.04, 3.87, 6.21).text
            '5.0 s [3.9, 6.2]'
        """
        return f"{self.mean:.1f} s [{self.low:.1f}, {self.high:.1f}]"

    @property
    def negated(self) -> "Seconds":
        """The difference with the opposite sign."""
        return Seconds(-self.mean, -self.high, -self.low)


class Gap(Artefact):
    """Survival of each controller under each condition."""

    FORMAT: ClassVar[str] = "equipoise-gap"
    VERSION: ClassVar[int] = 1
    quick: bool
    """Whether this is the short form: fewer points, fewer and shorter trials."""
    policy: Name
    """Digest of the policy with the cures."""
    paper_policy: Name
    """Digest of the table that was trained as the paper describes."""
    paper_settings: Settings
    """Settings of its training."""
    arm: Name
    """Name of the arm."""
    pendulum: Name
    """Digest of the pendulum that the trials vary."""
    actuator: Name
    """Digest of the actuator that the cures use on the full twin."""
    delay: Number
    """Delay of that actuator [s]."""
    world: Name
    """Name of the twin."""
    world_settings: TwinSettings
    """Settings of the twin."""
    friction: PivotFriction
    """Dry friction and drag of the pendulum on the twin."""
    clean_settings: TwinSettings
    """Settings of the clean twin."""
    settings: Settings
    """Settings of the policy: starts, number and length of the trials, the cures."""
    seed: Seed
    """Master seed of the trials."""
    points: Annotated[tuple[GapPoint, ...], Field(min_length=1, max_length=1000)]
    """All trials."""

    @property
    def duration(self) -> float:
        """Length of a trial [s]."""
        return self.settings.evaluation.duration

    @property
    def trials(self) -> int:
        """Trials of each point."""
        return self.settings.evaluation.trials

    @property
    def curves(self) -> tuple[tuple[Controller, bool], ...]:
        """Controllers of the curves, and whether each is on the clean twin."""
        points = (p for p in self.points if p.part in ("delay", "zero"))
        return tuple(dict.fromkeys((p.controller, p.on_clean) for p in points))

    @property
    def by_effect(self) -> tuple[Controller, ...]:
        """Controllers that ran effect by effect."""
        return tuple(p.controller for p in self.points if p.part == "plant")

    def curve(
        self, part: Literal["delay", "zero"], controller: Controller, on_clean: bool = False
    ) -> tuple[GapPoint, ...]:
        """Return the points of survival against delay or zero error."""
        wanted = (part, controller, on_clean)
        return tuple(p for p in self.points if (p.part, p.controller, p.on_clean) == wanted)

    def point(self, part: Part, controller: Controller, name: str = "") -> GapPoint:
        """Return a single point."""
        wanted = (part, controller, name)
        return next(p for p in self.points if (p.part, p.controller, p.name) == wanted)

    def names(self, part: Part) -> tuple[str, ...]:
        """Return the names of the effects or of the worlds."""
        return tuple(dict.fromkeys(p.name for p in self.points if p.part == part))


def mean(results: TrialResults, duration: float) -> Seconds:
    """Return the mean survival; the interval has no width if all trials lasted.

    Args:
        results: Trials.
        duration: Their length [s].
    """
    found = _student(np.array(results.survival))
    return found._replace(low=max(found.low, 0.0), high=min(found.high, duration))


def difference(results: TrialResults, reference: TrialResults) -> Seconds:
    """Return the mean difference of survival, paired by trial."""
    return _student(np.subtract(results.survival, reference.survival))


def differs(found: Seconds) -> bool:
    """Return whether a difference is significant."""
    return not found.low <= 0.0 <= found.high


def track_share(results: TrialResults) -> float | None:
    """Return the share of failures by the track limit; None without failures."""
    failed = len(results.outcomes) - results.outcomes.count(Outcome.LASTED)
    ends = results.outcomes.count(Outcome.TRACK)
    return ends / failed if failed else None


def sentences(gap: Gap) -> tuple[str, ...]:
    """Return the results in sentences."""

    def along(part: Literal["delay", "zero"], controller: Controller, clean: bool = False) -> str:
        return _along(gap.curve(part, controller, clean))

    worlds = (_open_question(gap),) if gap.names("named") else ()
    return (
        _conclusion(gap),
        _steps(gap),
        f"Delay alone, on the clean twin: the paper's table stands {along('delay', PAPER, True)}.",
        "Zero error alone, on the clean twin: the paper's table stands "
        f"{along('zero', PAPER, True)}.",
        _effect_by_effect(gap),
        f"The policy with its cures stands, on {gap.world}, {along('delay', CURED)}; with a zero "
        f"error, {along('zero', CURED)}.",
        f"Without prediction it stands {along('delay', NO_PREDICTION)}; if the delay changes and "
        f"the cures still assume {1e3 * gap.delay:.0f} ms, "
        f"{_along(gap.curve('delay', UNTUNED), gap.delay)}.",
        f"Without the bias estimate it stands, with a zero error, {along('zero', NO_BIAS)}.",
        *worlds,
        _caveat(gap),
    )


def _student(values: Array) -> Seconds:
    """Return the mean with Student's interval."""
    middle, n = float(np.mean(values)), len(values)
    half = float(student.ppf(0.5 + 0.5 * CONFIDENCE, n - 1) * np.std(values, ddof=1)) / sqrt(n)
    return Seconds(middle, middle - half, middle + half)


def at_world(gap: Gap, controller: Controller) -> TrialResults:
    """Return the trials of a controller on the full twin."""
    delay = gap.world_settings.transport
    return min(gap.curve("delay", controller), key=lambda point: abs(point.at - delay)).results


def _mean(results: TrialResults) -> str:
    return f"{float(np.mean(results.survival)):.1f}"


def _conclusion(gap: Gap) -> str:
    cured, without = at_world(gap, CURED), at_world(gap, PAPER)
    stood = (
        f"In short: on {gap.world} the policy with its cures stands {_mean(cured)} of "
        f"{gap.duration:g} s, a table trained as the paper describes {_mean(without)} s"
    )
    if not difference(cured, without).low > 0.0:
        return f"{stood}; these trials do not show that the cures help."
    without_one = at_world(gap, NO_PREDICTION), at_world(gap, NO_BIAS)
    needed = [
        f"the {cure} (without it {_mean(results)} s)"
        for cure, results in zip(("prediction", "estimate of the zero"), without_one, strict=True)
        if difference(cured, results).low > 0.0
    ]
    return f"{stood}. It needs {' and '.join(needed) or 'neither cure alone, in these trials'}."


def _steps(gap: Gap) -> str:
    plant, clean, world = (gap.point(part, PAPER).results for part in ("plant", "clean", "world"))
    share = track_share(world)
    ends = "" if share is None else f", {percent(share)} of its falls on the track limit"
    step = difference(plant, clean)
    rest = f"; the step to the clean twin costs {step.text}" if differs(step) else ""
    return (
        "A table trained as the paper describes models neither delay nor sensor. It stands "
        f"{_mean(plant)} of {gap.duration:g} s on its own training plant, {_mean(clean)} s on the "
        f"clean twin and {_mean(world)} s on {gap.world}{ends}{rest}. The paper's stood "
        f"{paper.SECONDS_BALANCED:g} s on the real arm, once."
    )


def _along(curve: tuple[GapPoint, ...], known: float = 0.0) -> str:
    """Return a curve as text, with the significant change nearest to the known value."""
    stands = ", ".join(f"{_mean(p.results)} s at {p.condition}" for p in curve)
    reference, *others = sorted(curve, key=lambda p: abs(p.at - known))
    for point in others:
        change = difference(point.results, reference.results)
        if differs(change):
            verb, size = ("adds", change) if change.mean > 0.0 else ("costs", change.negated)
            return f"{stands} ({point.condition} {verb} {size.text})"
    return f"{stands} (no significant difference)"


def _effect_by_effect(gap: Gap) -> str:
    def ranked(part: Part, reference: Part, sign: float) -> str:
        base, found = gap.point(reference, PAPER).results, dict[str, Seconds]()
        for name in gap.names(part):
            change = difference(gap.point(part, PAPER, name).results, base)
            found[name] = change if sign > 0.0 else change.negated
        return _ranked(found)

    helps, missed = ranked("alone", "clean", 1.0), ranked("without", "world", -1.0)
    better = "" if helps == NONE else f" Added alone, these gain: {helps}."
    better += "" if missed == NONE else f" Removed alone, these cost: {missed}."
    return (
        "Effect by effect, significant changes in seconds. Added alone to the clean twin, these "
        f"cost: {ranked('alone', 'clean', -1.0)}. Removed alone from {gap.world}, these gain: "
        f"{ranked('without', 'world', 1.0)}.{better}"
    )


def _ranked(differences: Mapping[str, Seconds]) -> str:
    certain = [(name, found) for name, found in differences.items() if found.low > 0.0]
    certain.sort(key=lambda pair: -pair[1].mean)
    return ", ".join(f"{name} ({found.text})" for name, found in certain) or NONE


def _open_question(gap: Gap) -> str:
    def stands(name: str) -> str:
        found, kept = (gap.point("named", who, name).results for who in (CURED, UNTUNED))
        return f"{name} {_mean(found)} s ({_mean(kept)} s)"

    return (
        "KUKA does not publish the servo of the cabinet. On each guess the policy stands, with the "
        "actuator identified there (in brackets with that of its training): "
        f"{', '.join(map(stands, gap.names('named')))}."
    )


def _caveat(gap: Gap) -> str:
    form = "This is the short form. " if gap.quick else ""
    return (
        f"{form}Each point is {gap.trials} trials of {gap.duration:g} s; in brackets, 95 % "
        "intervals of the mean, of zero width if all trials lasted. These are results on our "
        "twin, built from published data of such robots and from listed assumptions, not "
        "measurements of the authors' robot."
    )
