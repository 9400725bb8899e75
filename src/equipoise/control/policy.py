"""Policies: maps from the observation (x, x_dot, phi, phi_dot) to an acceleration u of the flange.

Every policy has the two methods of `Policy`. A `TaskPolicy` includes the task of trials and runs:
pendulum, arm, actuator, settings and a digest. It is a `TabularPolicy`, the paper's table as a
file, or a `BoundPolicy` of any other policy.

Compiled loops call the kernel `act` with a `PolicyKernel`; a policy without one runs in Python.
"""

import functools
import hashlib
import numbers
from dataclasses import dataclass
from math import floor, isfinite, nan
from typing import Annotated, Any, ClassVar, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np
from pydantic import Field, model_validator

from equipoise import paper
from equipoise.arm.arm import Arm
from equipoise.arrays import Array
from equipoise.errors import InputError
from equipoise.files import DIGEST_PREFIX, Artefact, Count, Fraction, Number, Seed, Value
from equipoise.jit import PACKAGE, inlined
from equipoise.model.actuator import Actuator
from equipoise.model.grid import ACTIONS, Grid, box_index, greedy_accelerations, make_grid
from equipoise.model.pendulum import Pendulum
from equipoise.model.random import DEPLOYMENT, philox, uniform
from equipoise.outcomes import Outcome
from equipoise.settings import BoxSettings, Settings, describe_recipe
from equipoise.user_code import user_code

TABLE, LINEAR, SNAPPED, RANDOM = range(4)
"""Kinds of `PolicyKernel`."""


class Observation(NamedTuple):
    """Observation of the policy."""

    x: float
    """Displacement of the flange from home [m]."""
    x_dot: float
    """Its velocity [m/s]."""
    phi: float
    """Angle of the pendulum from upright [rad]."""
    phi_dot: float
    """Its rate [rad/s]."""


@runtime_checkable
class Policy(Protocol):
    """A map from observations to accelerations of the flange; it may have a state."""

    def reset(self) -> None:
        """Begin a trial or a run: forget the state of the one before."""
        ...

    def act(self, observation: Array) -> float:
        """Return u [m/s^2] for the observation (x, x_dot, phi, phi_dot) in SI units, shape (4,)."""
        ...


class PolicyKernel(NamedTuple):
    """A policy as an argument of compiled loops."""

    kind: int
    """TABLE, LINEAR (clipped to the range of the actions), SNAPPED (to an action) or RANDOM."""
    u_of_box: Array = np.zeros(0)
    """Acceleration of each box [m/s^2]; for TABLE."""
    gains: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Gains of u = gains . (x, x_dot, phi, phi_dot); for LINEAR and SNAPPED."""
    boxes: Grid = make_grid(BoxSettings(), 1.0)
    """Edges of the boxes."""


@inlined
def act(policy: PolicyKernel, observation: Observation, chance: float) -> float:
    """Return the acceleration that a policy commands.

    Args:
        policy: Table or baseline.
        observation: The observation.
        chance: Uniform number in [0, 1), for RANDOM.

    Returns:
        Acceleration u of the flange along x [m/s^2].
    """
    x, x_dot, phi, phi_dot = observation
    if policy.kind == TABLE:
        return policy.u_of_box[box_index(x, x_dot, phi, phi_dot, policy.boxes)]
    actions = paper.ACTIONS
    if policy.kind == RANDOM:
        return actions[int(chance * len(actions))]
    g = policy.gains
    u = g[0] * x + g[1] * x_dot + g[2] * phi + g[3] * phi_dot
    if policy.kind == LINEAR:
        return min(max(u, actions[0]), actions[-1])
    return nearest_action(u, actions[0], actions)


@inlined
def nearest_action(u: float, nearest: float, actions: tuple[float, ...]) -> float:
    """Return the action nearest to u [m/s^2], or `nearest` where none is nearer."""
    for i in range(len(actions)):
        if abs(actions[i] - u) < abs(nearest - u):
            nearest = actions[i]
    return nearest


class KernelPolicy:
    """A policy for compiled loops, called from Python."""

    def __init__(self, kernel: PolicyKernel) -> None:
        """Wrap `kernel`."""
        self.kernel, self._tick = kernel, 0

    @property
    def digest(self) -> str:
        """SHA-256 of its numbers."""
        kind, u_of_box, gains, _ = self.kernel
        numbers = repr((kind, u_of_box.tolist(), gains, paper.ACTIONS))
        return DIGEST_PREFIX + hashlib.sha256(numbers.encode()).hexdigest()

    def reset(self) -> None:
        """Begin the sequence of random numbers again, for RANDOM."""
        self._tick = 0

    def act(self, observation: Array) -> float:
        """Return u [m/s^2] for the observation (x, x_dot, phi, phi_dot), shape (4,)."""
        chance = 0.0
        if self.kernel.kind == RANDOM:
            chance = uniform(philox(0, self._tick, 0, 0, DEPLOYMENT)[0], 0.0, 1.0)
            self._tick += 1
        return float(act(self.kernel, Observation(*observation.tolist()), chance))


class LearningPoint(Value):
    """Point of the learning curve: state of the training after some episodes."""

    episodes: Count
    """Number of episodes."""
    steps: Count
    """Number of control steps."""
    duration: Number
    """Mean duration of the training episodes that ended since the last point [s]."""


class Checkpoint(Value):
    """A greedy policy from the course of the training, with its results on selection seeds."""

    episodes: Count
    """Number of episodes before it."""
    trials: Count
    """Number of selection trials."""
    survived: Count
    """Number of trials survived."""
    mean_duration: Number
    """Mean duration of the trials [s]."""
    rms_x: Number
    """Root mean square of x over the trials [m]."""
    score: Number
    """Score of the selection: mean duration over the longest possible, less a penalty on rms_x."""


class TargetTest(Value):
    """Held-out trials of a selected policy on the plant of its training."""

    target: Fraction
    """Required probability to survive a trial [-]; 0 without a requirement."""
    duration: Number
    """Length of a trial [s]."""
    trials: Count
    """Number of trials."""
    survived: Count
    """Number of trials survived."""
    at_least: Fraction
    """Lower bound of the probability to survive a trial [-], exact for each attempt, with 95 %
    confidence over all attempts of one command."""
    causes: dict[Outcome, Count]
    """Number of trials by their outcome."""

    @property
    def met(self) -> bool:
        """Whether the lower bound reaches the target."""
        return self.at_least >= self.target

    def __str__(self) -> str:
        """Return the result in one line."""
        target = f"; target {format_fraction(self.target)}" if self.target else ""
        return (
            f"{self.survived:,} of {self.trials:,} trials survived {self.duration:g} s "
            f"(at least {format_fraction(self.at_least)}, 95 % confidence){target}"
        )


def format_fraction(fraction: float) -> str:
    """Return a fraction in per cent, rounded down to two digits.

    Example:
        >>> format_fraction(0.99), format_fraction(0.98999), format_fraction(1.0)
        ('99 %', '98.99 %', '100 %')
    """
    return f"{floor(1e4 * fraction + 1e-6) / 100.0:g} %"


class TabularPolicy(Artefact):
    """A trained table, with its task and the settings to train it again."""

    FORMAT: ClassVar[str] = "equipoise-policy"
    name: ClassVar[str] = "policy"
    """Name in results."""

    actions: Annotated[tuple[Number, ...], Field(max_length=len(paper.ACTIONS))]
    """Accelerations [m/s^2]."""
    Q: tuple[tuple[Number, ...], ...]
    """State-action values, a row of 8 for each box."""
    visits: tuple[tuple[Count, ...], ...]
    """Number of updates of each value, in the same shape."""
    h: float = Field(ge=0.001, le=0.1)
    """Time step [s]: at least the servo's cycle of 1 ms; with 0.1 s no policy balances."""
    pendulum: Pendulum
    """Pendulum of the training."""
    arm: Arm
    """Arm of the training, with its home posture."""
    actuator: Actuator
    """Response of the arm to its setpoints in the training."""
    settings: Settings
    """Resolved settings of the training."""
    seed: Seed
    """Master seed."""
    episodes: Count
    """Episodes trained."""
    steps: Count
    """Control steps trained."""
    learning_curve: tuple[LearningPoint, ...]
    """Course of the training."""
    checkpoints: tuple[Checkpoint, ...]
    """Candidates of the selection, the best first; empty if the last table was taken."""
    test: TargetTest | None = None
    """Test of the selected policy; None if it was not tested."""

    @model_validator(mode="after")
    def _fits_the_boxes(self) -> Self:
        if self.actions != paper.ACTIONS:
            raise ValueError("the actions are not the ones of this Equipoise (the paper's eight)")
        shape = (self.settings.boxes.count, ACTIONS)
        for name, table in (("Q", self.Q), ("visits", self.visits)):
            if len(table) != shape[0] or any(len(row) != shape[1] for row in table):
                raise ValueError(f"{name} must have {shape[0]} rows of {shape[1]} numbers")
        return self

    def __repr__(self) -> str:
        """Return one line: arm, length of the training, and the test."""
        tested = "" if self.test is None else f": {self.test}"
        return f"<TabularPolicy of {self.arm.name!r}, {self.episodes:,} episodes{tested}>"

    __str__ = __repr__

    @property
    def shortfall(self) -> str:
        """One line where the policy misses the target of its training; else empty."""
        if self.test is None or self.test.met:
            return ""
        return f"the policy misses the target of its training: {self.test}"

    @property
    def recipe(self) -> str:
        """Name of the recipe whose settings trained it, or `custom` with the differences."""
        return describe_recipe(self.settings)

    @property
    def table(self) -> Array:
        """Q as an array, shape (boxes, 8)."""
        return np.array(self.Q)

    @property
    def u_of_box(self) -> Array:
        """Greedy acceleration of each box [m/s^2], shape (boxes,)."""
        return greedy_accelerations(self.table)

    @property
    def kernel(self) -> PolicyKernel:
        """Greedy policy for compiled loops."""
        return PolicyKernel(TABLE, self.u_of_box, boxes=self.grid)

    @property
    def grid(self) -> Grid:
        """The boxes for kernels."""
        return make_grid(self.settings.boxes, self.pendulum.parameters().k)

    def reset(self) -> None:
        """Do nothing: a table has no state."""

    def act(self, observation: Array) -> float:
        """Return u [m/s^2] for the observation (x, x_dot, phi, phi_dot), shape (4,)."""
        x, x_dot, phi, phi_dot = (float(value) for value in observation)
        return _greedy(self.Q)[box_index(x, x_dot, phi, phi_dot, self.grid)]


@dataclass(frozen=True, eq=False)
class BoundPolicy:
    """A policy with its task. Its u is checked.

    It is clipped to the largest of the paper's actions, which the safety limits assume.
    """

    policy: Policy
    """The policy."""
    name: str
    """Name in results and messages."""
    digest: str
    """SHA-256 of the policy's file or source."""
    kernel: PolicyKernel | None
    """The policy for compiled loops; None for a policy in Python."""
    pendulum: Pendulum
    """Nominal pendulum."""
    arm: Arm
    """Arm with its home posture."""
    actuator: Actuator
    """Model of the arm's response in the controller."""
    settings: Settings
    """Settings of plant, controller and evaluation."""
    h: ClassVar[float] = paper.STEP
    """Time step [s]."""
    shortfall: ClassVar[str] = ""
    """Empty: no training that could miss a target."""

    def reset(self) -> None:
        """Begin a trial or a run.

        Raises:
            InputError: The policy raised an exception.
        """
        with user_code(self.name, where=lambda: " in its reset"):
            self.policy.reset()

    def act(self, observation: Array) -> float:
        """Return u [m/s^2], clipped, for the observation (x, x_dot, phi, phi_dot).

        Raises:
            InputError: The policy raised an exception, or returned no finite number.
        """
        state = observation.copy()  # the policy may write into its argument
        with user_code(self.name, where=lambda: f" in the state {_format_state(state)}"):
            u: Any = self.policy.act(observation)
            u = u.item() if isinstance(u, np.ndarray) and u.size == 1 else u
            value = float(u) if isinstance(u, numbers.Real) else nan
            if not isfinite(value):
                raise InputError(
                    f"{self.name} returned {u!r:.60} in the state {_format_state(state)}, expected "
                    "a finite number: the acceleration u in m/s^2; correct it"
                )
        return min(max(value, -paper.U_MAX), paper.U_MAX)


TaskPolicy = TabularPolicy | BoundPolicy
"""A policy with its task: the argument of evaluations and runs."""


def tick_policy(policy: TaskPolicy | KernelPolicy) -> Policy:
    """Return a policy for a call per tick from Python: compiled if the policy has a kernel."""
    return policy if policy.kernel is None else KernelPolicy(policy.kernel)


def _format_state(state: Array) -> str:
    named = zip(("x", "x_dot", "phi", "phi_dot"), state.tolist(), strict=True)
    return ", ".join(f"{name} = {value:.3g}" for name, value in named)


@functools.lru_cache(maxsize=16)
def _greedy(Q: tuple[tuple[float, ...], ...]) -> tuple[float, ...]:
    """Return the greedy accelerations as Python numbers; cached, since every `act` needs them."""
    return tuple(greedy_accelerations(np.array(Q)).tolist())


@functools.cache
def shipped_policy() -> TabularPolicy:
    """Return the policy that ships with Equipoise, trained for the shipped pendulum."""
    return TabularPolicy.load(PACKAGE / "data" / "policy.json")
