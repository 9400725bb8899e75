"""Choices that the paper leaves open: one home for each, with its unit and its reason.

The defaults here are what an `equipoise` command uses; the report's table "left open by the
paper" is made from them. Named sets (recipes) are differences to the defaults. The order is
defaults < named set < a TOML file < single settings such as `learning.gamma=0.98`. Resolved
settings go into every artefact.
"""

import difflib
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from math import radians
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, ValidationError, model_validator

from equipoise import paper
from equipoise.artefacts import (
    LONGEST_QUOTE,
    Name,
    StrPath,
    Value,
    first_fault,
    quoted,
    read_bytes,
    shortened,
)
from equipoise.errors import SettingsError

GRAVITY = 9.80665
"""Standard acceleration of gravity [m/s^2]."""
LARGEST_TOML: Final = 64 * 1024
"""Size limit of a TOML file [bytes]: all settings with a comment each need less than 20 kB."""
LONGEST_LINE: Final = 1000
"""Length limit of a line of TOML [characters]: the time to parse a key grows with the square of its
length."""
LONGEST_TRIAL: Final = 86400.0
"""Limit on the length of a trial or an episode [s]: a day."""
MOST_TRIALS: Final = 1_000_000
"""Limit on a number of trials: a million minutes of the twin take a core a week."""
MOST_EPISODES: Final = 100_000_000
"""Limit on a number of episodes: so many take a core a day and more."""
MOST_CANDIDATES: Final = 100_000
"""Limit on the candidates of a training; the screening of so many takes days."""
FINEST_ENCODER: Final = 2**48
"""Limit on counts per revolution: the steps of finer ones are lost in the rounding of an angle."""
QUARTER_TURN: Final = radians(90.0)
"""Limit on the error of an encoder's zero [rad]: beyond it the side of the fall is unknown."""

Friction = Literal["viscous", "coulomb", "quadratic"]
"""Friction models: the paper's; with dry friction; with dry friction and air drag."""


class IdentificationSettings(Value):
    """How a free swing is fitted."""

    friction: Friction = "viscous"
    """Friction model. `viscous` is the paper's; `coulomb` adds dry friction, `quadratic` adds
    dry friction and air drag. All are kept at zero or above."""
    g: float = Field(default=GRAVITY, ge=0.1, le=100.0)
    """Acceleration of gravity [m/s^2]; the standard value is within 0.3 % of any place on earth.
    The bounds hold every solid body of the solar system."""
    steps_per_period: int = Field(default=128, ge=32, le=8192)
    """Runge-Kutta steps in a period of the swing; over 60 periods of a large one they are wrong by
    less than 1e-5 rad."""
    horizons: Annotated[
        tuple[Annotated[float, Field(gt=0.0, le=1.0)], ...], Field(max_length=16)
    ] = (0.08, 0.25)
    """Shares of the window that are fitted one after the other before the whole: fitted at once, a
    long window has false minima, where the fit loses count of the periods."""
    first_horizon_periods: float = Field(default=1.5, gt=0.0, le=1e3)
    """The first horizon holds at least so many periods, or period and friction are not seen."""
    samples_per_period: float = Field(default=10.0, ge=4.0, le=1e4)
    """Fewer samples than this in a period are refused: turning points would be guessed."""
    noise_multiple: float = Field(default=8.0, gt=0.0, le=1e3)
    """A turning point is one where the motion comes back by so many standard deviations of the
    noise: noise alone does not within the samples around a turn."""
    turn_share: float = Field(default=0.02, gt=0.0, lt=1.0)
    """... and by this share of the whole range, so that a tremor makes no turning points."""
    local_periods: float = Field(default=1 / 6, gt=0.0, le=0.5)
    """Half width, in periods, of the windows over which angle, rate and acceleration are taken by
    a local polynomial: wide enough for an encoder's steps, narrow enough to see a hand let go."""
    release_share: float = Field(default=0.25, gt=0.0, le=1e3)
    """A hand is on the pendulum where gravity and friction leave more than this share of the
    nearby peak acceleration unexplained. Hands showed 0.5 and more on recorded swings, faults of
    the recorder's time stamps up to 0.18."""
    release_noise: float = Field(default=5.0, gt=0.0, le=1e3)
    """... and more than so many standard deviations of what stays unexplained in a free swing."""
    rest_share: float = Field(default=0.02, ge=0.0, lt=1.0)
    """The swing is over where its amplitude has fallen to this share of its largest: the rest says
    more about stiction than about the swing."""
    least_blocks: int = Field(default=8, ge=3, le=1000)
    """Errors of the fit are independent between blocks of a period, and of this part of the window
    where it holds fewer periods: with fewer blocks their spread says nothing."""
    unexplained: float = Field(default=0.25, gt=0.0, lt=1.0)
    """A recording is refused where the residual, noise apart, is above this share of its standard
    deviation: it is not a free swing. A long swing with the wrong friction leaves 5 %."""
    misfit_share: float = Field(default=0.005, gt=0.0, le=1.0)
    """A warning is given where the residual, noise apart, is above this share of the amplitude:
    a well-modelled pivot leaves 0.1 to 0.4 %."""
    better_share: float = Field(default=0.8, gt=0.0, lt=1.0)
    """A richer friction model is recommended where it leaves less than this share of the
    residual."""


class ClikSettings(Value):
    """Gains of the closed-loop inverse kinematics; the paper names them but gives no values."""

    K_p: float = Field(default=400.0, gt=0.0, le=1e4)
    """Gain on the pose error [1/s^2]. With K_d a critically damped loop of 20 rad/s: errors decay
    within 0.15 s, slow beside the 0.01 s step and fast beside the 15 s of a long run. Above 1e4 a
    step of 0.01 s is unstable."""
    K_d: float = Field(default=40.0, gt=0.0, le=200.0)
    """Gain on the twist error [1/s]; 2 sqrt(K_p) is critical damping. Above 200 a step of 0.01 s is
    unstable."""
    singular_share: float = Field(default=0.05, gt=0.0, lt=1.0)
    """The inverse is damped where the manipulability is below this share of its value at home."""
    damping: float = Field(default=0.05, gt=0.0, le=10.0)
    """Damping factor at a singularity."""


class PlantSettings(Value):
    """The simulated plant and its noise; the paper calls the noise "small"."""

    ideal: bool = False
    """The arm is where it is sent, at once, and the state is known without a sensor, as in the
    paper's simulation. Otherwise training takes the identified actuator."""
    linearised: bool = False
    """Use the linearised equation (7) for the pendulum, as the paper does. The nonlinear form
    costs nothing and is exact."""
    inertia_sigma: float = Field(default=0.02, ge=0.0, lt=0.25)
    """Standard deviation of the factor on I, once per episode. A free swing gives I to better
    than 1 %; the rest is for what changes between swing and run."""
    friction_sigma: float = Field(default=0.2, ge=0.0, lt=1.0)
    """Standard deviation of the factor on b, once per episode. Friction of real pivots varies
    that much with amplitude."""
    position_error_sigma: float = Field(default=1e-4, ge=0.0, le=paper.X_LIMIT)
    """Standard deviation of the noise on the position part of e, per step [m]."""
    orientation_error_sigma: float = Field(default=radians(0.02), ge=0.0, le=QUARTER_TURN)
    """Standard deviation of the noise on the orientation part of e, per step [rad]."""
    delay_spread: float = Field(default=0.004, ge=0.0, le=0.02)
    """The transport delay of an episode differs from the identified one by up to this, evenly [s].
    Of no effect with the actuator `ideal`, as what follows."""
    lag_spread: float = Field(default=0.2, ge=0.0, lt=0.5)
    """The lag of the joints differs by a factor of up to 1 plus or minus this, evenly."""
    zero_error: float = Field(default=radians(0.3), ge=0.0, le=QUARTER_TURN)
    """The encoder's zero of an episode is wrong by up to this, evenly [rad]: the furthest that a
    pendulum with a good bearing may rest beside the vertical."""
    counts_per_rev: int = Field(default=8192, ge=64, le=FINEST_ENCODER)
    """Encoder counts per revolution, after x4: 2048 lines, a common encoder."""
    max_speed: float | None = Field(default=None, gt=0.0, le=2.0)
    """Where |x_dot| reaches this a trial has failed, in selection and test, as a run on a rig would
    stop there [m/s]; none where nothing limits it. Episodes of the training go on: the boxes show
    no speed below 0.5 m/s, and a table cannot learn from failures that it cannot see coming. Where
    they ended episodes too, at 0.23, none lasted more than 20 of 200 trials of the selection."""


class ControllerSettings(Value):
    """How measurements become what the policy sees, where there are a sensor and an actuator.

    The paper says nothing about either.
    """

    predict: bool = True
    """Show the policy the state at the moment when its command takes effect, not the present one:
    over the delay the pendulum falls on, and the commands in flight move it."""
    estimate_bias: bool = True
    """Estimate the error of the encoder's zero while balancing."""
    margin: float = Field(default=0.005, ge=0.0, le=0.2)
    """The prediction reaches at least so far beyond the identified delay [s]: looking 5 ms too far
    costs little, looking 5 ms too short costs the balance. Nobody balances 0.2 s later."""
    acceleration_sigma: float = Field(default=1.5, ge=1e-6, le=1e3)
    """What shakes phi_ddot beyond the model [rad/s^2]: dry friction, an acceleration of the pivot
    that is wrong by 0.2 m/s^2. Beyond a factor of a million the observer's equations round to
    nothing."""
    angle_sigma: float = Field(default=3e-4, ge=0.0, le=0.1)
    """What shakes a measured angle beyond the encoder's steps [rad]: a time stamp that is wrong by
    0.3 ms at 1 rad/s. A sensor that is wrong by 0.1 rad (6 deg) shows nothing within 11 deg."""
    bias_drift: float = Field(default=radians(0.05), ge=1e-6, le=1.0)
    """How far the bias may drift in a second [rad]: it decides how fast a wrong zero is found."""
    correction: float = Field(default=0.1, ge=0.0, le=1.0)
    """Share of the difference between measured and modelled joints that is taken up per tick: a
    time constant of 0.1 s. The model is faster than the measurement; only slow differences, such
    as the sag under the pendulum's weight, are to be believed."""


class LearningSettings(Value):
    """The learner and its episodes."""

    learner: Name = "q_learning"
    """Learning rule: the paper's `q_learning`, equation (1); `sarsa`, `watkins`, `double_q`, or
    MODULE:NAME of a guest's."""
    reward: Name = "paper"
    """Reward of a step: `paper`, `alive`, `centred`, or MODULE:NAME of a guest's function."""
    episodes: int = Field(default=paper.EPISODES, ge=1, le=MOST_EPISODES)
    """Episodes of training; the paper's number."""
    episode_duration: float = Field(default=30.0, ge=paper.STEP, le=LONGEST_TRIAL)
    """An episode that lasts this long ends without a failure [s]."""
    gamma: float = Field(default=0.97, gt=0.0, lt=1.0)
    """Discount per step. Behind a servo a horizon of a third of a second learns most reliably: with
    0.99, which does on the ideal arm, three of six trainings found no table that stands."""
    alpha_initial: float = Field(default=1.0, gt=0.0, le=1.0)
    """Learning rate at the first visit of a state-action pair."""
    alpha_decay: float = Field(default=0.02, ge=0.0, le=1e6)
    """Learning rate after N visits: alpha_initial / (1 + alpha_decay N), so that early guesses are
    forgotten and later values are averages; 0 is a constant rate."""
    alpha_minimum: float = Field(default=0.02, ge=0.0, le=1.0)
    """The rate never falls below this: the states seen in a box change with the policy, so old
    experience has to fade."""
    epsilon_initial: float = Field(default=0.05, ge=0.0, le=1.0)
    """Probability of a random action in the first episode."""
    epsilon_until: float = Field(default=0.8, ge=0.0, le=1.0)
    """Share of the episodes over which that probability falls linearly to zero; 0 keeps it."""
    reward_failure: float = Field(default=-1.0, ge=-1e6, lt=0.0)
    """Reward of a step that ends in failure; with reward `paper` every other reward is zero."""
    trace_decay: float = Field(default=0.7, ge=0.0, le=1.0)
    """lambda of the learner `watkins`: share of an error that reaches the decision before."""
    mirrored: bool = True
    """Update the mirror image with every update: the task is symmetric, experience counts twice."""
    hold_action: bool = True
    """Hold an action until the state leaves its box, and update then, discounted by the time that
    has gone by. Updated in each step, a box is mostly its own successor, and its value an average
    over how long one stays there."""
    start_x: float = Field(default=0.08, ge=0.0, lt=paper.X_LIMIT)
    """Episodes start with x uniform within plus and minus this [m]: exploring starts show boxes
    that a good policy seldom sees. Wider starts are often lost whatever one does, and teach little
    but that."""
    start_x_dot: float = Field(default=0.2, ge=0.0, le=10.0)
    """... x_dot within this [m/s] ..."""
    start_phi: float = Field(default=radians(3.5), ge=0.0, lt=radians(paper.PHI_LIMIT_DEG))
    """... phi within this [rad] ..."""
    start_phi_dot: float = Field(default=radians(23.0), ge=0.0, le=100.0)
    """... and phi_dot within this [rad/s]."""


class SelectionSettings(Value):
    """Which greedy policy of a training is kept.

    A table changes its greedy policy until the last episode, and a later one is not always better.
    Candidates run trials on seeds that neither training nor test uses, on plants that vary more
    than the trained ones; the best go on to a longer round.
    """

    every: int = Field(default=20, ge=0, le=MOST_EPISODES)
    """A candidate is taken after each so many episodes, if its greedy policy is a new one; 0 takes
    the last table."""
    averaging: float = Field(default=0.05, gt=0.0, le=1.0)
    """A candidate is the greedy policy of a running average of the table (Polyak & Juditsky 1992),
    which takes up this share of the newest table each time; 1 takes the table as it is. The values
    of the best two actions differ by less than a table trembles."""
    screening_trials: int = Field(default=24, ge=1, le=MOST_TRIALS)
    """Trials of every candidate."""
    finalists: int = Field(default=8, ge=1, le=1000)
    """Candidates that go on to the final round."""
    final_trials: int = Field(default=200, ge=1, le=MOST_TRIALS)
    """Trials of each finalist."""
    duration: float = Field(default=60.0, ge=paper.STEP, le=LONGEST_TRIAL)
    """Length of a screening trial [s]."""
    final_duration: float = Field(default=120.0, ge=paper.STEP, le=LONGEST_TRIAL)
    """Length of a trial of the final round [s]: what lasts two minutes seldom fails in one."""
    spread: float = Field(default=2.0, ge=0.0, le=10.0)
    """Factor on the plant's standard deviations of I and b: a policy that stands on worse plants
    has margin."""
    rms_x_weight: float = Field(default=0.002, ge=0.0, le=1e3)
    """Score = mean duration / duration - weight * rms(x) / 0.22 m. Survival alone saturates; of
    policies that always stand, the one that uses less track has more of it left."""


class EvaluationSettings(Value):
    """Trials as a release leaves them: x = x_dot = 0, the pendulum already falling."""

    trials: int = Field(default=200, ge=1, le=MOST_TRIALS)
    """Number of trials."""
    duration: float = Field(default=60.0, ge=paper.STEP, le=LONGEST_TRIAL)
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
    """All settings, resolved."""

    identification: IdentificationSettings = IdentificationSettings()
    clik: ClikSettings = ClikSettings()
    controller: ControllerSettings = ControllerSettings()
    plant: PlantSettings = PlantSettings()
    learning: LearningSettings = LearningSettings()
    selection: SelectionSettings = SelectionSettings()
    evaluation: EvaluationSettings = EvaluationSettings()

    @model_validator(mode="after")
    def _has_few_candidates(self) -> Self:
        every = self.selection.every
        if every > 0 and self.learning.episodes > every * MOST_CANDIDATES:
            raise ValueError(
                f"selection.every of {every} makes more than {MOST_CANDIDATES:,} candidates of "
                f"{self.learning.episodes:,} episodes; raise it"
            )
        return self


RECIPES: Mapping[str, Mapping[str, Any]] = {
    "robust": {},
    "paper": {
        "controller.predict": False,
        "controller.estimate_bias": False,
        "plant.ideal": True,
        "plant.linearised": True,
        "learning.gamma": 0.99,
        "learning.alpha_initial": 0.1,
        "learning.alpha_decay": 0.0,
        "learning.alpha_minimum": 0.0,
        "learning.epsilon_initial": 0.1,
        "learning.epsilon_until": 0.0,
        "learning.mirrored": False,
        "learning.hold_action": False,
        "learning.start_x": 0.0,
        "learning.start_x_dot": 0.0,
        "learning.start_phi": radians(2.5),
        "learning.start_phi_dot": 0.0,
        "selection.every": 0,
    },
}
"""Named differences to the defaults. `robust` is the default; `paper` is the barest reading of the
paper's text: textbook constants for what it leaves open, starts near upright, no symmetry, and the
last table is the policy."""


SLOW: Mapping[str, Any] = {"learning.gamma": 0.95}
"""What a limited speed changes beside the limit: a horizon of a fifth of a second, for tables that
push less. At 0.23 m/s the first two learners of seed 0 last 168 and 132 of 200 trials of the
selection; with the third of a second of 0.97 they last 66 and 139."""


def resolve(
    recipe: str = "robust",
    file: StrPath | None = None,
    overrides: Iterable[str] = (),
    *,
    max_speed: float | None = None,
) -> Settings:
    """Return the settings: defaults < recipe < limited speed < TOML file < single settings.

    Args:
        recipe: A name in `RECIPES`.
        file: TOML with a table for each section, e.g. `[learning]` with `gamma = 0.97`.
        overrides: Single settings such as `learning.gamma=0.97`.
        max_speed: `plant.max_speed` [m/s], which brings the differences of `SLOW` along; none where
            nothing limits the speed.

    Raises:
        SettingsError: A name is unknown or a value impossible.

    Example:
        >>> resolve("paper", overrides=["learning.gamma=0.97"]).learning.gamma
        0.97
    """
    if recipe not in RECIPES:
        raise SettingsError(f"there is no recipe {recipe!r}; choose one of {', '.join(RECIPES)}")
    # Not `model_dump`, which leaves out what says nothing.
    tree: dict[str, dict[str, Any]] = {name: dict(section) for name, section in Settings()}
    for name, value in RECIPES[recipe].items():
        _put(tree, name, value)
    if max_speed is not None:
        for name, value in SLOW.items():
            _put(tree, name, value)
    if file is not None:
        for name, value in _flat(read_toml(Path(file), "the settings")):
            _put(tree, name, value)
    for override in overrides:
        name, sign, text = override.partition("=")
        if not sign:
            raise SettingsError(
                f"{quoted(override)} is no setting; expected NAME=VALUE, e.g. learning.gamma=0.98"
            )
        _put(tree, name.strip(), _toml_value(text.strip()))
    if max_speed is not None:
        tree["plant"]["max_speed"] = max_speed
    try:
        return Settings.model_validate(tree)
    except ValidationError as error:
        fault = first_fault(error)
        got = f", got {fault.got}" if "." in fault.where else ""
        where = f"setting {fault.where}" if fault.where else "settings"
        raise SettingsError(f"{where}: {fault.what}{got}") from None


def closest_recipe(settings: Settings) -> tuple[str, tuple[str, ...]]:
    """Return the recipe that differs least from settings of a training, and the differences.

    The sections `identification` and `evaluation` have no part in a training.

    Example:
        >>> closest_recipe(resolve("paper", overrides=["learning.gamma=0.9", "clik.K_p=100"]))
        ('paper', ('clik.K_p = 100.0', 'learning.gamma = 0.9'))
    """
    found = {name: tuple(_differences(settings, resolve(name))) for name in RECIPES}
    name = min(found, key=lambda name: len(found[name]))
    return name, found[name]


def describe_recipe(settings: Settings) -> str:
    """Return the name of the recipe with these settings, or `custom` with the differences.

    Example:
        >>> describe_recipe(resolve("paper"))
        'paper'
        >>> describe_recipe(resolve(overrides=["learning.gamma=0.9"]))
        'custom: robust with learning.gamma = 0.9'
    """
    name, differences = closest_recipe(settings)
    return f"custom: {name} with {', '.join(differences)}" if differences else name


def _differences(settings: Settings, recipe: Settings) -> Iterator[str]:
    for section, values in settings:
        if section not in ("identification", "evaluation"):
            for key, value in values:
                if value != getattr(getattr(recipe, section), key):
                    yield f"{section}.{key} = {value}"


def _put(tree: dict[str, Any], name: str, value: Any) -> None:
    section, _, key = name.partition(".")
    if section not in tree or key not in tree[section]:
        known = tree.get(section, tree)
        close = difflib.get_close_matches(key if section in tree else section, known, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else f"; known: {', '.join(known)}"
        raise SettingsError(f"there is no setting {quoted(name)}{hint}")
    tree[section][key] = value


def _flat(tree: Mapping[str, Any]) -> Iterable[tuple[str, Any]]:
    for section, fields in tree.items():
        if not isinstance(fields, dict):
            raise SettingsError(
                f"{quoted(section)} stands outside a section; expected e.g. [learning] above "
                "gamma = 0.98"
            )
        for key, value in fields.items():
            yield f"{section}.{key}", value


def read_toml(path: Path, kind: str) -> dict[str, Any]:
    """Return the content of a TOML file.

    Args:
        path: The file.
        kind: Name of what the file holds, with its article, for messages.

    Raises:
        SettingsError: The file is missing, too large, or not TOML.
    """
    data = read_bytes(path, LARGEST_TOML, f"a TOML file with {kind}", SettingsError)
    try:
        return parse_toml(data.decode("utf-8"))
    except UnicodeDecodeError:
        raise SettingsError(
            f"{path} is not valid TOML (it is not UTF-8 text); save {kind} in UTF-8"
        ) from None
    except ValueError as error:
        raise SettingsError(f"{path} is not valid TOML ({error}); correct {kind}") from None


def parse_toml(text: str) -> dict[str, Any]:
    """Return what a TOML text says.

    Raises:
        ValueError: It is no TOML, nested too deeply, or has too long a line or number.
    """
    if max(map(len, text.splitlines()), default=0) > LONGEST_LINE:
        raise ValueError(f"a line is longer than {LONGEST_LINE} characters")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("its tables or lists are nested too deeply") from None
    except ValueError as error:
        raise ValueError(shortened(str(error), 2 * LONGEST_QUOTE)) from None


def _toml_value(text: str) -> Any:
    try:
        return parse_toml(f"value = {text}")["value"]
    except ValueError:
        return text
