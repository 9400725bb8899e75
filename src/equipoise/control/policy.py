"""What decides: a policy maps the state (x, x_dot, phi, phi_dot) to an acceleration u.

`Policy` is the protocol that anything can meet; `TabularPolicy` is the paper's table as a file.
The compiled loops call `act`, with a `PolicyKernel` made from a table or from a yardstick.
"""

import functools
from importlib import resources
from typing import Annotated, ClassVar, Final, NamedTuple, Protocol, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from equipoise import paper
from equipoise.artefacts import Artefact, Count, Name, Number, Seed, Share, Value
from equipoise.compiled import kernel
from equipoise.control import boxes
from equipoise.control.boxes import BoxDescription, Boxes, box_index
from equipoise.model.actuator import Actuator
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import Pendulum
from equipoise.settings import MOST_CANDIDATES, Settings
from equipoise.views import Viewable

Array = npt.NDArray[np.float64]

TABLE: Final = 0
LINEAR: Final = 1
SNAPPED: Final = 2
RANDOM: Final = 3


class Policy(Protocol):
    """Anything that balances: any callable of this shape can be evaluated."""

    def act(self, state: Array) -> float:
        """Return u [m/s^2] for the state (x, x_dot, phi, phi_dot) in SI units, shape (4,)."""
        ...


class PolicyKernel(NamedTuple):
    """A policy as compiled loops take it."""

    kind: int
    """TABLE, LINEAR (clipped to the range of the actions), SNAPPED (to an action) or RANDOM."""
    u_of_box: Array
    """Acceleration of each box [m/s^2], shape (270,); for TABLE."""
    gains: tuple[float, float, float, float]
    """u = gains . (x, x_dot, phi, phi_dot); for LINEAR and SNAPPED."""
    actions: tuple[float, ...]
    """The eight accelerations [m/s^2]."""
    boxes: Boxes
    """Edges of the boxes."""


@kernel
def act(
    policy: PolicyKernel, x: float, x_dot: float, phi: float, phi_dot: float, chance: float
) -> float:
    """Return the acceleration that a policy commands.

    Args:
        policy: Table or yardstick.
        x: Displacement of the flange [m].
        x_dot: Its velocity [m/s].
        phi: Angle of the pendulum from upright [rad].
        phi_dot: Its angular velocity [rad/s].
        chance: Uniform number in [0, 1), for RANDOM.

    Returns:
        Acceleration u of the flange along x [m/s^2].
    """
    if policy.kind == TABLE:
        return policy.u_of_box[box_index(x, x_dot, phi, phi_dot, policy.boxes)]
    actions = policy.actions
    if policy.kind == RANDOM:
        return actions[int(chance * len(actions))]
    g = policy.gains
    u = g[0] * x + g[1] * x_dot + g[2] * phi + g[3] * phi_dot
    if policy.kind == LINEAR:
        return min(max(u, actions[0]), actions[-1])
    nearest = actions[0]
    for i in range(1, len(actions)):
        if abs(actions[i] - u) < abs(nearest - u):
            nearest = actions[i]
    return nearest


def policy_kernel(
    kind: int,
    *,
    u_of_box: Array | None = None,
    gains: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
) -> PolicyKernel:
    """Return a `PolicyKernel`; what its kind does not use stays zero."""
    return PolicyKernel(
        kind=kind,
        u_of_box=np.zeros(boxes.COUNT) if u_of_box is None else np.array(u_of_box),
        gains=gains,
        actions=paper.ACTIONS,
        boxes=boxes.boxes(),
    )


class LearningPoint(Value):
    """The training as it stood after some episodes."""

    episodes: Count
    """Episodes so far."""
    steps: Count
    """Control steps so far."""
    duration: Number
    """Mean duration of the training episodes that ended since the last point [s]."""
    survival: Share | None = None
    """Share of the screening trials that the greedy policy of this moment lasted."""


class Checkpoint(Value):
    """A greedy policy of some moment of the training, and how it did on selection seeds."""

    episodes: Count
    """When it was taken."""
    trials: Count
    """How many selection trials it ran."""
    survived: Count
    """How many of them it lasted."""
    mean_duration: Number
    """Mean balance [s]."""
    rms_x: Number
    """Root mean square of x over the trials [m]."""
    score: Number
    """What was compared: mean duration over the longest possible, less a penalty on rms_x."""


class TabularPolicy(Viewable, Artefact):
    """A trained table and all that is needed to run it and to train it again."""

    FORMAT: ClassVar[str] = "equipoise-policy"
    VERSION: ClassVar[int] = 3

    boxes: BoxDescription
    """The boxes, in the paper's notation."""
    actions: Annotated[tuple[Number, ...], Field(max_length=len(paper.ACTIONS))]
    """Accelerations [m/s^2]."""
    Q: tuple[tuple[Number, ...], ...]
    """State-action values, 270 x 8."""
    visits: tuple[tuple[Count, ...], ...]
    """How often each value was updated, 270 x 8."""
    h: float = Field(ge=0.001, le=0.1)
    """Time step [s]; the servo's cycle is 1 ms, and with 0.1 s none stands."""
    pendulum: Pendulum
    """The pendulum it was trained for."""
    arm: Arm
    """The arm it was trained on, with its home posture."""
    actuator: Actuator
    """How the arm followed its setpoints in the training."""
    recipe: Name
    """Name of the training recipe."""
    settings: Settings
    """Resolved settings of the training."""
    seed: Seed
    """Master seed."""
    learner: Count
    """Which of the learners of that seed."""
    episodes: Count
    """Episodes trained."""
    steps: Count
    """Control steps trained."""
    learning_curve: Annotated[tuple[LearningPoint, ...], Field(max_length=MOST_CANDIDATES + 1)]
    """The course of the training."""
    checkpoints: Annotated[tuple[Checkpoint, ...], Field(max_length=MOST_CANDIDATES + 1)]
    """The finalists of the selection, the chosen one first; empty if the last table was taken."""

    @model_validator(mode="after")
    def _fits_the_boxes(self) -> Self:
        if self.boxes != boxes.describe() or self.actions != paper.ACTIONS:
            raise ValueError(
                "the boxes or actions are not the ones of this Equipoise (the paper's 270 and 8)"
            )
        shape = (boxes.COUNT, boxes.ACTIONS)
        for name, table in (("Q", self.Q), ("visits", self.visits)):
            if len(table) != shape[0] or any(len(row) != shape[1] for row in table):
                raise ValueError(f"{name} must have {shape[0]} rows of {shape[1]} numbers")
        return self

    def __repr__(self) -> str:
        """Return one line: arm, recipe and length of the training."""
        return (
            f"<TabularPolicy of {self.arm.name!r}, recipe {self.recipe!r}, {self.episodes:,} "
            f"episodes, {len(self.Q)} boxes, {len(self.actions)} actions>"
        )

    __str__ = __repr__

    @property
    def table(self) -> Array:
        """Q as an array, shape (270, 8)."""
        return np.array(self.Q)

    @property
    def u_of_box(self) -> Array:
        """The greedy acceleration of each box [m/s^2], shape (270,)."""
        return greedy_accelerations(self.table)

    @property
    def kernel(self) -> PolicyKernel:
        """The greedy policy for compiled loops."""
        return policy_kernel(TABLE, u_of_box=self.u_of_box)

    def act(self, state: Array) -> float:
        """Return u [m/s^2] for the state (x, x_dot, phi, phi_dot), shape (4,)."""
        x, x_dot, phi, phi_dot = (float(value) for value in state)
        return _greedy(self.Q)[box_index(x, x_dot, phi, phi_dot, boxes.boxes())]


def greedy_accelerations(Q: Array) -> Array:
    """Return the greedy acceleration of each box [m/s^2], shape (270,), of a table."""
    return np.array(paper.ACTIONS)[boxes.greedy_actions(Q)]


@functools.lru_cache(maxsize=16)
def _greedy(Q: tuple[tuple[float, ...], ...]) -> tuple[float, ...]:
    """Return the same as numbers of Python; kept, for `act` is called every step."""
    return tuple(greedy_accelerations(np.array(Q)).tolist())


@functools.cache
def shipped_policy() -> TabularPolicy:
    """Return the policy that ships with Equipoise, trained for the shipped pendulum."""
    with resources.as_file(resources.files("equipoise") / "data" / "policy.json") as path:
        return TabularPolicy.load(path)
