"""Settings: the parameters that the paper leaves open, each with its unit and its reason.

The defaults are those of the `equipoise` commands and of the report's table "left open by the
paper". Recipes are named differences to the defaults. The order of precedence is defaults < recipe
< TOML file < single settings such as `learning.gamma=0.98`. Every artefact contains its resolved
settings.
"""

import tomllib
from collections.abc import Iterable, Iterator, Mapping
from difflib import get_close_matches
from itertools import pairwise
from math import inf, prod, radians
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, ValidationError, model_validator

from equipoise import paper
from equipoise.errors import SettingsError
from equipoise.files import Name, StrPath, Value, first_fault, quoted, read_text, shortened

GRAVITY = 9.80665
"""Standard acceleration of gravity [m/s^2]."""
MAX_TRIAL_DURATION: Final = 86400.0
"""Limit on the length of a trial or an episode [s]: a day."""
MAX_TRIALS: Final = 1_000_000
"""Limit on the number of trials: a million minutes of the twin take a core one week."""
MAX_EPISODES: Final = 100_000_000
"""Limit on the number of episodes: more than one day on one core."""
MAX_COUNTS_PER_REV: Final = 2**48
"""Limit on counts per revolution: finer steps are below the rounding error of an angle."""
QUARTER_TURN: Final = radians(90.0)
"""Limit on the zero error of an encoder [rad]: beyond it the direction of the fall is unknown."""

Friction = Literal["viscous", "coulomb", "quadratic"]
"""Friction models: viscous as in the paper; with dry friction; with dry friction and air drag."""


class IdentificationSettings(Value):
    """Fit of a free swing."""

    friction: Friction = "viscous"
    """Friction model. `viscous` is the paper's; `coulomb` adds dry friction, `quadratic` adds
    dry friction and air drag. Frictions are constrained to be non-negative."""
    g: float = Field(default=GRAVITY, ge=0.1, le=100.0)
    """Acceleration of gravity [m/s^2]; the standard value is within 0.3 % of any place on earth.
    The bounds include every solid body of the solar system."""


class ClikSettings(Value):
    """Gains of the closed-loop inverse kinematics; the paper names them but gives no values."""

    K_p: float = Field(default=400.0, gt=0.0, le=1e4)
    """Gain on the pose error [1/s^2]. With K_d a critically damped loop of 20 rad/s: errors decay
    within 0.15 s, slow compared with the step of 0.01 s and fast compared with a run of 15 s. A
    step of 0.01 s is unstable above 1e4."""
    K_d: float = Field(default=40.0, gt=0.0, le=200.0)
    """Gain on the twist error [1/s]; 2 sqrt(K_p) is critical damping. A step of 0.01 s is unstable
    above 200."""


class PlantSettings(Value):
    """Simulated plant and its noise, which the paper calls "small"."""

    ideal: bool = False
    """Whether the arm reaches setpoints immediately and the state is known without a sensor, as in
    the paper's simulation. Otherwise training simulates the identified actuator."""
    linearised: bool = False
    """Whether the pendulum follows the linearised equation (7), as in the paper. The nonlinear form
    is exact at no additional cost."""
    inertia_sigma: float = Field(default=0.02, ge=0.0, lt=0.25)
    """Standard deviation of the factor on I, drawn per episode. A free swing gives I to better than
    1 %; the rest allows for changes between swing and run."""
    friction_sigma: float = Field(default=0.2, ge=0.0, lt=1.0)
    """Standard deviation of the factor on b, drawn per episode. Friction of real pivots varies that
    much with amplitude."""
    position_error_sigma: float = Field(default=1e-4, ge=0.0, le=paper.X_LIMIT)
    """Standard deviation of the noise on the position part of e, per step [m]."""
    orientation_error_sigma: float = Field(default=radians(0.02), ge=0.0, le=QUARTER_TURN)
    """Standard deviation of the noise on the orientation part of e, per step [rad]."""
    delay_spread: float = Field(default=0.004, ge=0.0, le=0.02)
    """Half width of the uniform variation of the transport delay, drawn per episode [s]. This and
    the following settings have no effect with the actuator `ideal`."""
    lag_spread: float = Field(default=0.2, ge=0.0, lt=0.5)
    """Half width of the uniform factor on the lag of the joints, around 1."""
    zero_error: float = Field(default=radians(0.3), ge=0.0, le=QUARTER_TURN)
    """Half width of the uniform zero error of the encoder, drawn per episode [rad]: the largest
    rest angle beside the vertical of a pendulum with a good bearing."""
    counts_per_rev: int = Field(default=8192, ge=64, le=MAX_COUNTS_PER_REV)
    """Encoder counts per revolution, after x4: 2048 lines, a common encoder."""
    max_speed: float | None = Field(default=None, gt=0.0, le=2.0)
    """Flange speed |x_dot| that fails a trial of selection and test, as it stops a run on a rig
    [m/s]; None for no limit. Training episodes continue: the boxes do not resolve speeds below
    0.5 m/s, and a table cannot learn from failures that its state does not show. With a limit of
    0.23 on episodes too, no algorithm survived more than 20 of 200 trials of the selection."""


class ControllerSettings(Value):
    """State estimation for the policy, on plants with a sensor and an actuator.

    The paper specifies neither.
    """

    predict: bool = True
    """Whether the policy observes the predicted state at the time when its command takes effect,
    instead of the present state. The pendulum keeps falling during the delay, and pending commands
    move it."""
    estimate_bias: bool = True
    """Whether the zero error of the encoder is estimated while balancing."""
    margin: float = Field(default=0.005, ge=0.0, le=0.2)
    """Minimum margin of the prediction horizon beyond the identified delay [s]: a horizon 5 ms too
    long costs little, one 5 ms too short loses the balance. Balancing is impossible at 0.2 s."""


End = Annotated[float, Field(ge=-1e4, le=1e4)]
"""Inner end of an interval; the limit keeps it finite."""
Ends = Annotated[tuple[End, ...], Field(min_length=1, max_length=63)]
"""Inner ends of the intervals of one quantity, in rising order and symmetric about zero."""


class BoxSettings(Value):
    """Grid of a table: inner ends of the intervals of each quantity, the paper's by default.

    The outer ends are the limits of failure. The ends lie symmetrically about zero, so that each
    box has a mirror image. An end of phi belongs to the interval above it, an end of another
    quantity to the interval farther from zero, as in the paper.
    """

    phi_deg: Ends = paper.inner_ends(paper.PHI_INTERVALS_DEG)
    """Ends for the angle from upright [deg]; zero is one of them, so that each box has a side to
    which the pendulum tips."""
    phi_dot_deg: Ends = paper.inner_ends(paper.PHI_DOT_INTERVALS_DEG)
    """Ends for the angular velocity [deg/s]."""
    x: Ends = paper.inner_ends(paper.X_INTERVALS)
    """Ends for the displacement of the flange, continued by `look_ahead` [m]."""
    x_dot: Ends = paper.inner_ends(paper.X_DOT_INTERVALS)
    """Ends for its velocity [m/s]."""
    look_ahead: float = Field(default=0.5, ge=0.0, le=10.0)
    """Time over which a table's x is continued at the velocity of the pendulum's centre of
    percussion [s]; 0 as in the paper. The boxes do not resolve velocities below 0.5 m/s: without
    it, a table learns of a drift only when the track is nearly used up, and fails at its ends."""

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Number of intervals of phi, phi_dot, x, x_dot."""
        ends = self.phi_deg, self.phi_dot_deg, self.x, self.x_dot
        phi, phi_dot, x, x_dot = (len(inner) + 1 for inner in ends)
        return phi, phi_dot, x, x_dot

    @property
    def count(self) -> int:
        """Number of boxes."""
        return prod(self.shape)

    @model_validator(mode="after")
    def _divides_and_mirrors(self) -> Self:
        limits = {"phi_deg": paper.PHI_LIMIT_DEG, "x": paper.X_LIMIT}
        for name in ("phi_deg", "phi_dot_deg", "x", "x_dot"):
            ends, limit = getattr(self, name), limits.get(name, inf)
            rises = all(low < high for low, high in pairwise(ends))
            if not rises or ends != tuple(-end for end in reversed(ends)) or ends[-1] >= limit:
                form = f"must rise below {limit:g} and be symmetric about zero"
                raise ValueError(f"{name} {form}, got {list(ends)}")
        if 0.0 not in self.phi_deg:
            raise ValueError(f"phi_deg must have the end 0, got {list(self.phi_deg)}")
        if self.count > 10_000:
            raise ValueError(f"the ends make {self.count:,} boxes, expected at most 10,000")
        return self


class LearningSettings(Value):
    """Learning rule and episodes."""

    algorithm: Name = "q_learning"
    """Learning rule: the paper's `q_learning`, equation (1), or MODULE:NAME of a custom one, as in
    examples/algorithms."""
    reward: Name = "failure"
    """Reward of a step: `failure`, which only a failure costs; `alive`, `centred`, or MODULE:NAME
    of a custom function. The paper does not give its reward."""
    episodes: int = Field(default=paper.EPISODES, ge=1, le=MAX_EPISODES)
    """Number of training episodes, as in the paper."""
    episode_duration: float = Field(default=10.0, ge=paper.STEP, le=MAX_TRIAL_DURATION)
    """Time limit of an episode [s]; reaching it is not a failure."""
    gamma: float = Field(default=0.98, gt=0.0, lt=1.0)
    """Discount per step: a horizon of half a second."""
    alpha_initial: float = Field(default=0.36, gt=0.0, le=1.0)
    """Learning rate at the first visit of a state-action pair."""
    alpha_decay: float = Field(default=0.009, ge=0.0, le=1e6)
    """Decay of the learning rate, alpha_initial / (1 + alpha_decay N) after N visits: early guesses
    are forgotten and later values are averages; 0 is a constant rate."""
    alpha_minimum: float = Field(default=5.6e-4, ge=0.0, le=1.0)
    """Minimum learning rate: the distribution of states in a box changes with the policy, so old
    experience has to fade."""
    epsilon_initial: float = Field(default=0.22, ge=0.0, le=1.0)
    """Probability of a random action in the first episode."""
    epsilon_until: float = Field(default=0.0, ge=0.0, le=1.0)
    """Fraction of the episodes over which that probability falls linearly to zero; 0 keeps it
    constant."""
    mirrored: bool = True
    """Whether each update is repeated for the mirror image: the task is symmetric, and experience
    counts twice."""
    start_x: float = Field(default=0.14, ge=0.0, lt=paper.X_LIMIT)
    """Half width of the uniform initial x of episodes [m]: exploring starts visit boxes that a good
    policy seldom reaches. Wider starts are often lost under any policy, and teach little."""
    start_x_dot: float = Field(default=0.3, ge=0.0, le=10.0)
    """Half width of the uniform initial x_dot [m/s]: a table holds little beyond it."""
    start_phi: float = Field(default=radians(3.5), ge=0.0, lt=radians(paper.PHI_LIMIT_DEG))
    """Half width of the uniform initial phi [rad]: episodes that begin inclined teach a table to
    recover from pushes."""
    start_phi_dot: float = Field(default=radians(23.0), ge=0.0, le=100.0)
    """Half width of the uniform initial phi_dot [rad/s]."""


class SelectionSettings(Value):
    """Selection of the best greedy policy of a training, and test of the selected one.

    The greedy policies of late tables differ in few boxes, and later ones are not always better.
    The candidates run common trials on seeds that neither training nor test uses; the best one is
    tested in held-out trials.
    """

    every: int = Field(default=200, ge=0, le=MAX_EPISODES)
    """Number of episodes between two candidates. 0 keeps the last table. Single tables differ more
    than averages: recipe `paper` takes more of them."""
    averaging: float = Field(default=0.3, gt=0.0, le=1.0)
    """Weight of the newest table in the running average (Polyak & Juditsky 1992) whose greedy
    policy is the candidate; 1 uses the table itself. The values of the best two actions differ by
    less than the fluctuation of a table."""
    late: float = Field(default=0.6, gt=0.0, le=1.0)
    """Fraction of the episodes, at the end of a training, in which candidates are taken."""
    trials: int = Field(default=32, ge=1, le=MAX_TRIALS)
    """Number of trials of each candidate."""
    duration: float = Field(default=60.0, ge=paper.STEP, le=MAX_TRIAL_DURATION)
    """Length of a trial of selection and test [s]."""
    test_trials: int = Field(default=1000, ge=1, le=MAX_TRIALS)
    """Number of trials of the test: a target of 99 % is shown with up to two failures, so that a
    policy that survives 99.9 % meets it with a probability of 0.92."""


Start = Literal["hand", "hanging"]
"""Start of a trial: released by a hand, or hanging, from where the arm swings the pendulum up."""
HANGING: Final[Start] = "hanging"
"""The start with a hanging pendulum."""


class EvaluationSettings(Value):
    """Trials that start as after a release: x = x_dot = 0, the pendulum already falling."""

    start: Start = "hand"
    """Start: released by a hand, or hanging, from where the arm swings the pendulum up; phi is then
    measured from hanging."""
    trials: int = Field(default=200, ge=1, le=MAX_TRIALS)
    """Number of trials."""
    duration: float = Field(default=60.0, ge=paper.STEP, le=MAX_TRIAL_DURATION)
    """Length of a trial [s]."""
    phi_low: float = Field(default=radians(1.5), ge=0.0, le=QUARTER_TURN)
    """Smallest |phi| at the start [rad]; its sign is random."""
    phi_high: float = Field(default=radians(2.5), ge=0.0, le=QUARTER_TURN)
    """Largest |phi| at the start [rad]."""
    phi_dot_low: float = Field(default=radians(8.0), ge=0.0, le=100.0)
    """Smallest |phi_dot| at the start, of the same sign as phi [rad/s]."""
    phi_dot_high: float = Field(default=radians(18.0), ge=0.0, le=100.0)
    """Largest |phi_dot| at the start [rad/s]."""

    @model_validator(mode="after")
    def _ranges_rise(self) -> Self:
        for name in ("phi", "phi_dot"):
            low, high = getattr(self, f"{name}_low"), getattr(self, f"{name}_high")
            if low > high:
                raise ValueError(f"{name}_low is {low:g}, above {name}_high, {high:g}")
        return self


class Settings(Value):
    """All settings, resolved, in the groups of `equipoise.settings`."""

    identification: IdentificationSettings = IdentificationSettings()
    clik: ClikSettings = ClikSettings()
    controller: ControllerSettings = ControllerSettings()
    plant: PlantSettings = PlantSettings()
    boxes: BoxSettings = BoxSettings()
    learning: LearningSettings = LearningSettings()
    selection: SelectionSettings = SelectionSettings()
    evaluation: EvaluationSettings = EvaluationSettings()


RECIPES: Mapping[str, Mapping[str, Any]] = {
    "robust": {},
    "fine": {
        "boxes.phi_deg": (-8.0, -5.0, -3.0, -1.0, -0.5, 0.0, 0.5, 1.0, 3.0, 5.0, 8.0),
        "boxes.phi_dot_deg": (-50.0, -30.0, -10.0, 10.0, 30.0, 50.0),
        "boxes.look_ahead": 0.7,
    },
    "paper": {
        "controller.predict": False,
        "boxes.look_ahead": 0.0,
        "controller.estimate_bias": False,
        "plant.ideal": True,
        "plant.linearised": True,
        "plant.inertia_sigma": 0.012,
        "plant.friction_sigma": 0.072,
        "plant.position_error_sigma": 2.3e-5,
        "plant.orientation_error_sigma": 5e-4,
        "learning.reward": "centred",
        "learning.mirrored": False,
        "learning.start_x": 0.13,
        "learning.start_x_dot": 0.19,
        "learning.start_phi": 0.004,
        "learning.start_phi_dot": 0.57,
        "selection.averaging": 1.0,
        "selection.every": 60,
    },
}
"""Named differences to the defaults. `robust` is the default. `fine` has 756 boxes, for pendulums
that the paper's 270 resolve too coarsely. `paper` is literal in all that the paper prints: no
prediction, no look-ahead, no symmetry, and the late table that survives longest in the paper's own
simulation. One search there chose the numbers of the learning that the paper leaves open
(docs/deviations.md)."""


def changed(settings: Settings, changes: Mapping[str, Any]) -> Settings:
    """Return settings with other values of some of them, by their full names; None changes none.

    Raises:
        SettingsError: A name is unknown.
        ValidationError: A value is invalid.
    """
    tree = settings.model_dump()
    known = ", ".join(tree)
    key_of = {f"{section}.{key}": key for section, fields in tree.items() for key in fields}
    for name, value in changes.items():
        section, _, key = name.partition(".")
        if name not in key_of:
            close = [] if name in tree else get_close_matches(key or name, key_of.values(), n=1)
            near = [similar for similar in key_of if key_of[similar] in close]
            remedy = f"did you mean {' or '.join(near)}?" if near else f"sections: {known}"
            raise SettingsError(f"there is no setting {quoted(name)}; {remedy}")
        if value is not None:
            tree[section][key] = value
    return Settings.read(tree)


def resolve(
    recipe: str = "robust",
    file: StrPath | None = None,
    overrides: Iterable[str] = (),
) -> Settings:
    """Return the settings: defaults < recipe < TOML file < single settings.

    Args:
        recipe: A name in `RECIPES`.
        file: TOML with a table for each section, e.g. `[learning]` with `gamma = 0.97`.
        overrides: Single settings such as `learning.gamma=0.97`.

    Raises:
        SettingsError: A name is unknown or a value is invalid.

    Example:
        >>> resolve("paper", overrides=["learning.gamma=0.97"]).learning.gamma
        0.97
    """
    if str(recipe) not in RECIPES:
        raise SettingsError(f"there is no recipe {recipe!r}; choose one of {', '.join(RECIPES)}")
    changes = dict(RECIPES[recipe])
    if file is not None:
        for section, fields in read_toml(Path(file), "the settings").items():
            if isinstance(fields, dict):
                changes |= {f"{section}.{key}": value for key, value in fields.items()}
            else:
                changes[section] = fields
    for override in overrides:
        name, sign, text = str(override).partition("=")
        if not sign:
            raise SettingsError(
                f"{quoted(override)} is no setting; expected NAME=VALUE, e.g. learning.gamma=0.98"
            )
        changes[name.strip()] = _toml_value(text.strip())
    try:
        return changed(Settings(), changes)
    except ValidationError as error:
        raise SettingsError(f"setting {first_fault(error)}") from None


def describe_recipe(settings: Settings) -> str:
    """Return the name of the recipe with these settings, or `custom` with the differences.

    The sections `identification` and `evaluation` do not affect a training.

    Example:
        >>> describe_recipe(resolve("paper"))
        'paper'
        >>> describe_recipe(resolve(overrides=["learning.gamma=0.9"]))
        'custom: robust with learning.gamma = 0.9'
    """
    differences_of = {name: tuple(_differences(settings, resolve(name))) for name in RECIPES}
    name, differences = min(differences_of.items(), key=lambda item: len(item[1]))
    return f"custom: {name} with {', '.join(differences)}" if differences else name


def _differences(settings: Settings, recipe: Settings) -> Iterator[str]:
    for section, values in settings:
        if section not in ("identification", "evaluation"):
            for key, value in values:
                if value != getattr(getattr(recipe, section), key):
                    yield f"{section}.{key} = {value}"


def read_toml(path: Path, kind: str) -> dict[str, Any]:
    """Read a TOML file.

    Args:
        path: The file.
        kind: Content of the file, with its article, for messages.

    Raises:
        SettingsError: The file is missing, too large, or not TOML.
    """
    # [bytes]: all settings with a comment each need less than 20 kB.
    text = read_text(path, 64 * 1024, f"a TOML file with {kind}", SettingsError)
    try:
        return tomllib.loads(text, parse_float=_number)
    except (ValueError, RecursionError) as error:
        reason = shortened(str(error), 120)
        raise SettingsError(f"{path} is not valid TOML ({reason}); correct it") from None


def _number(text: str) -> float:
    """Return a float of a TOML text; a whole number such as 1e4 is an int."""
    value = float(text)
    return int(value) if value.is_integer() and abs(value) < 2**53 else value


def _toml_value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}", parse_float=_number)["value"]
    except (ValueError, RecursionError):
        return text
