"""Map of the recoverable set, and of the part that a policy holds.

Starts fill a slice of the state space, one at random in each cell of a grid. The policy balances
the nominal plant from each of them, without a zero error. A start is held if the trial lasts. The
boundaries of the recoverable set (`equipoise.worlds.reachability`) are those of the nominal
pendulum, at the release.
"""

from collections.abc import Sequence
from math import ceil, inf, sqrt
from typing import Annotated, ClassVar, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from equipoise.artefacts import Artefact, Estimate, Name, Number, Seed, Share, Value
from equipoise.control.grid import TRUNCATED
from equipoise.control.policy import TaskPolicy
from equipoise.errors import InputError
from equipoise.executors import Workers
from equipoise.model.actuator import Actuator
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.random import MAP
from equipoise.model.worlds import MODEL, TwinSettings, World, pivot_friction
from equipoise.settings import LONGEST_TRIAL, Settings
from equipoise.worlds import Setup, find_world, setup_of, simulate
from equipoise.worlds.evaluation import Done, exact_interval
from equipoise.worlds.reachability import (
    FLANGE_PLANE,
    PENDULUM_PLANE,
    Boundary,
    RecoveryParams,
    boundary,
    fall,
    make_recovery_params,
    release_limit,
)

Array = npt.NDArray[np.float64]
Plane = Literal["pendulum", "flange"]

PLANES: Final = {"pendulum": PENDULUM_PLANE, "flange": FLANGE_PLANE}
"""Axes of the slices; the other two quantities are zero."""
STARTS: Final = 1600
TWIN_STARTS: Final = 400
"""Default number of starts of a slice, on a plant and on a twin, whose trials take longer."""
MAX_STARTS: Final = 1_000_000
"""Limit on the number of starts of a slice."""
DURATION: Final = 10.0
"""Default length of a trial [s]: a hundred time constants of the fall. A start that is lost ends
within one second."""
NOMINAL_FACTORS: Final = ("inertia_factor", "friction_factor", "lag_factor")
BORDER: Final = 1.15
"""Size of the area of the starts, in sizes of the necessary set."""

Point = tuple[Number, Number]
Points = Annotated[tuple[Point, ...], Field(max_length=1024)]


class HeldShare(NamedTuple):
    """Share of some starts that a policy holds."""

    held: int
    """Number of held starts."""
    starts: int
    """Number of starts."""
    share: float
    """Their ratio; 0 without starts."""
    interval: tuple[float, float]
    """Exact (Clopper-Pearson) 95 % interval; wider than needed, as the starts are spread evenly."""


class MapSlice(Value):
    """Slice of the state space, in its plane; the other two quantities are zero at the release."""

    plane: Plane
    """`pendulum`: phi [rad] and phi_dot [rad/s]; `flange`: x [m] and x_dot [m/s]."""
    necessary: Points
    """Boundary at the release beyond which no controller recovers, a polygon."""
    sufficient: Points
    """Boundary at the release up to which explicit commands recover, a polygon."""
    starts: Annotated[tuple[Point, ...], Field(min_length=1, max_length=MAX_STARTS)]
    """Start of each trial."""
    depth: Annotated[tuple[Number, ...], Field(max_length=MAX_STARTS)]
    """Distance of each start from the middle in sizes of the necessary set: 1 on its boundary."""
    depth_sufficient: Annotated[tuple[Number, ...], Field(max_length=MAX_STARTS)]
    """The same, in sizes of the sufficient set."""
    held: Annotated[tuple[bool, ...], Field(max_length=MAX_STARTS)]
    """Whether each trial lasted."""

    @model_validator(mode="after")
    def _is_whole(self) -> "MapSlice":
        counts = {len(each) for each in (self.starts, self.depth, self.depth_sufficient, self.held)}
        if len(counts) > 1:
            raise ValueError(f"{len(self.starts)} starts need as many results and depths")
        return self

    def held_share(self, where: Literal["necessary", "sufficient", "outside"]) -> HeldShare:
        """Return the share of the starts in a set, or outside both, that the policy holds."""
        depth = np.array(self.depth_sufficient if where == "sufficient" else self.depth)
        return held_share(np.array(self.held)[depth > 1.0 if where == "outside" else depth <= 1.0])


class RecoveryMap(Artefact):
    """Recoverable set of a task, and the starts that a policy holds."""

    FORMAT: ClassVar[str] = "equipoise-map"
    VERSION: ClassVar[int] = 1

    policy: Name
    """Digest of the policy's file or source."""
    name: Name
    """Name of the policy."""
    world: Name
    """World of the trials."""
    world_settings: TwinSettings | None
    """Numbers of the twin; None on a plant."""
    arm: Name
    """Name of the arm."""
    pendulum: Name
    """Digest of the pendulum."""
    actuator: Name
    """Digest of the controller's model of the arm's response."""
    delay: Number
    """Delay of the arm at full acceleration [s]."""
    rate: Number
    """Rate of the fall, lambda [1/s]."""
    fade: Number
    """Rate mu of the converging motion [1/s]."""
    u_max: Number
    """Largest acceleration of the flange [m/s^2]."""
    releases_recoverable: Share
    """Share of the releases inside the necessary set, with the variation of the plant."""
    worst: Number
    """Largest diverging angle of the releases, after the delay [rad]."""
    limit: Number
    """Diverging angle up to which the worst release may be recoverable, after the delay [rad]."""
    settings: Settings
    """Resolved settings."""
    duration: float = Field(gt=0.0, le=LONGEST_TRIAL)
    """Length of a trial [s]."""
    seed: Seed
    """Master seed."""
    slices: Annotated[tuple[MapSlice, ...], Field(min_length=1, max_length=2)]
    """Slices of the state space, the pendulum's first."""

    @property
    def use(self) -> float:
        """Diverging angle of the worst release as a share of its limit."""
        return self.worst / self.limit


def held_share(held: npt.NDArray[np.bool_]) -> HeldShare:
    """Return the share of starts that are held, with its interval."""
    count, starts = int(np.sum(held)), len(held)
    if starts == 0:
        return HeldShare(0, 0, 0.0, (0.0, 1.0))
    return HeldShare(count, starts, count / starts, exact_interval(count, starts))


def default_starts(world: str | World) -> int:
    """Return the default number of starts of a slice in a world."""
    return STARTS if find_world(world)[1] is None else TWIN_STARTS


def trials_of(world: str | World, starts: int) -> int:
    """Return the number of trials of a map."""
    return starts_of(starts) * len(planes_of(world))


def starts_of(starts: int) -> int:
    """Return the number of cells of the grid, a square, for a number of starts."""
    return ceil(sqrt(starts)) ** 2


def planes_of(world: str | World) -> tuple[Plane, ...]:
    """Return the slices of a world: on a twin, every trial starts with the flange at rest."""
    return ("pendulum", "flange") if find_world(world)[1] is None else ("pendulum",)


def map_recovery(
    policy: TaskPolicy,
    *,
    world: str | World = MODEL,
    actuator: Actuator | None = None,
    starts: int | None = None,
    duration: float = DURATION,
    seed: int = 0,
    workers: Workers = 1,
    done: Done = lambda _: None,
) -> RecoveryMap:
    """Compute the recoverable set of a policy's task, and the part that the policy holds.

    Args:
        policy: The policy with its task.
        world: `ideal`, `model`, or a twin.
        actuator: The controller's model of the arm's response (default: the policy's).
        starts: Number of starts of each slice, rounded up to a square (default: 1600, or 400 on
            a twin).
        duration: Length of a trial [s].
        seed: Master seed.
        workers: Threads, or an executor, of compiled policies; the result does not depend on it.
        done: Receives the number of trials that have just finished.

    Raises:
        InputError: The number of starts is out of range.
        SettingsError: The world is unknown.
        ArmError: The masses of the twin's arm are unknown.
    """
    starts = default_starts(world) if starts is None else starts
    if not 1 <= starts <= MAX_STARTS:
        raise InputError(f"{starts:,} starts; give a number from 1 to {MAX_STARTS:,}")
    setup = setup_of(policy, world, None, actuator)
    place, numbers = find_world(world)
    pendulum, response = _plant(setup, numbers)
    params = make_recovery_params(pendulum, setup.arm, setup.settings, response)
    simulation = simulate(world, setup, seed=seed, stream=MAP)
    generator = np.random.default_rng(seed)

    def rows_done(rows: Sequence[int]) -> None:
        done(len(rows))

    def slice_of(plane: Plane) -> MapSlice:
        necessary, sufficient = (
            boundary(params, PLANES[plane], sufficient=one) for one in (False, True)
        )
        edges = [_at_release(params, plane, one.points) for one in (necessary, sufficient)]
        chosen = _starts(params, plane, edges[0], starts_of(starts), generator)
        states = chosen @ np.array(PLANES[plane])
        trials = simulation.draw(len(chosen))
        exact = {name: np.ones(len(chosen)) for name in NOMINAL_FACTORS}
        exact |= {name: np.zeros(len(chosen)) for name in ("delay", "zero")}
        trials = trials._replace(start=states, **exact)
        rows = range(len(chosen))
        simulation.run(policy, trials, rows, duration=duration, workers=workers, done=rows_done)
        depths = [_depth(params, plane, one, states) for one in (necessary, sufficient)]
        return MapSlice(
            plane=plane,
            necessary=_points(edges[0]),
            sufficient=_points(edges[1]),
            starts=_points(chosen),
            depth=tuple(depths[0].tolist()),
            depth_sufficient=tuple(depths[1].tolist()),
            held=tuple((trials.cause == TRUNCATED).tolist()),
        )

    slices = tuple(slice_of(plane) for plane in planes_of(world))
    limit = release_limit(pendulum, setup.arm, setup.settings, response)
    return RecoveryMap(
        policy=policy.digest,
        name=policy.name,
        world=place,
        world_settings=numbers,
        arm=setup.arm.name,
        pendulum=setup.pendulum.digest,
        actuator=setup.actuator.digest,
        delay=params.delay,
        rate=params.rate,
        fade=params.fade,
        u_max=params.u_max,
        releases_recoverable=limit.share,
        worst=limit.worst,
        limit=limit.limit,
        settings=setup.settings,
        duration=duration,
        seed=seed,
        slices=slices,
    )


def _plant(setup: Setup, numbers: TwinSettings | None) -> tuple[PendulumParameters, Actuator]:
    """Return the pendulum of a world, and the response of its arm."""
    pendulum = setup.pendulum.parameters(linearised=setup.settings.plant.linearised)
    if numbers is None:
        return pendulum, setup.actuator
    delay = Estimate.around(numbers.transport, 0.0, "assumed")
    response = setup.actuator.model_copy(update={"delay": delay})
    return pivot_friction(setup.pendulum, numbers).on(pendulum), response


def _at_release(params: RecoveryParams, plane: Plane, points: Array) -> Array:
    """Return a boundary at the release, within failure angle and track, from that after the delay.

    Points of the boundary after the delay may come from outside these limits.
    """
    axes = np.array(PLANES[plane])
    before = fall(params, points @ axes, -params.delay) @ axes.T
    limit = params.phi_limit if plane == "pendulum" else params.x_limit
    for sign in (1.0, -1.0):
        kept: list[Array] = []
        for p, q in zip(np.roll(before, 1, axis=0), before, strict=True):
            room_p, room_q = limit - sign * p[0], limit - sign * q[0]
            if room_p * room_q < 0.0:
                kept.append(p + room_p / (room_p - room_q) * (q - p))
            if room_q >= 0.0:
                kept.append(q)
        before = np.array(kept)
    return before


def _starts(
    params: RecoveryParams, plane: Plane, edge: Array, count: int, generator: np.random.Generator
) -> Array:
    """Return a start at random in each cell of a grid around a boundary, shape (count, 2).

    Failure angle and track limit the grid.
    """
    cells = round(sqrt(count))
    columns, rows = np.meshgrid(np.arange(cells), np.arange(cells))
    place = (
        np.column_stack((columns.ravel(), rows.ravel())) + generator.random((count, 2))
    ) / cells
    limit = params.phi_limit if plane == "pendulum" else params.x_limit
    half = np.minimum(BORDER * np.abs(edge).max(axis=0), (limit, inf))
    return half * (2.0 * place - 1.0)


def _depth(params: RecoveryParams, plane: Plane, edge: Boundary, states: Array) -> Array:
    """Return the distance of states at the release from the middle, in sizes of a set."""
    return edge.share(fall(params, states) @ np.array(PLANES[plane]).T)


def _points(points: Array) -> tuple[Point, ...]:
    return tuple((float(a), float(b)) for a, b in points)
