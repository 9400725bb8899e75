"""Draw the recoverable set, and the starts from which a policy balances.

Starts fill a slice of the state space, one at random in each cell of a grid. The policy balances
the nominal plant from each of them, without a zero error; a start is held if the trial survives.
The boundary is that of `recoverable.py`, beyond which no controller recovers::

    python experiments/map.py lqr --out map.png
"""

from math import ceil, inf, pi, sqrt
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from recoverable import RecoveryParams, fall, largest_start, make_recovery_params
from shared import options, proportion, store

import equipoise as eq
from equipoise.control.policy import TaskPolicy
from equipoise.executors import available_cores
from equipoise.model.grid import TRUNCATED
from equipoise.model.random import MAP
from equipoise.simulation import setup_of, simulate
from equipoise.simulation.plant import DomainRandomization

PLANES = {
    "flange at rest in the middle": (2, 3),
    "pendulum upright at rest": (0, 1),
}
"""Axes of the slices in the state (x, x_dot, phi, phi_dot); the other two quantities are zero."""
LABELS = ("x [m]", "dx/dt [m/s]", "phi [deg]", "dphi/dt [deg/s]")
UNITS = (1.0, 1.0, 180.0 / pi, 180.0 / pi)
DIRECTIONS = 48
"""Number of directions of a boundary."""
BORDER = 1.15
"""Size of the area of the starts, in sizes of the recoverable set."""


class MapSlice(NamedTuple):
    """A slice of the state space at the release; the other two quantities are zero."""

    edge: np.ndarray
    """Boundary beyond which no controller recovers, a polygon, shape (n, 2)."""
    starts: np.ndarray
    """Start of each trial, shape (m, 2)."""
    inside: np.ndarray
    """Whether each start is inside the boundary, shape (m,)."""
    held: np.ndarray
    """Whether each trial survived, shape (m,)."""

    def fraction(self) -> dict:
        """Return how many of the starts inside the boundary are held, with its 95 % interval."""
        return proportion(int(np.sum(self.held & self.inside)), int(np.sum(self.inside)))


def boundary(params: RecoveryParams, axes: tuple[int, int]) -> np.ndarray:
    """Return the boundary after the arm's delay in a plane, by rising angle, shape (n, 2)."""
    limits = (params.x_limit, sqrt(2.0 * params.u_max * params.x_limit))
    limits += (params.phi_limit, params.phi_limit * params.fade)
    half: list[np.ndarray] = []
    for angle in pi * np.arange(DIRECTIONS // 2) / (DIRECTIONS // 2):
        point = np.array([limits[axes[0]] * np.cos(angle), limits[axes[1]] * np.sin(angle)])
        half.append(point * largest_start(params, in_plane(point[None], axes)[0]))
    return np.concatenate((np.negative(half), half))  # mirrored, as the task is


def in_plane(points: np.ndarray, axes: tuple[int, int]) -> np.ndarray:
    """Return the states of points in a plane, shape (n, 4)."""
    states = np.zeros((len(points), 4))
    states[:, axes] = points
    return states


def is_inside(edge: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return which points a star-shaped polygon around zero contains."""
    scale = np.abs(edge).max(axis=0)
    edge, points = edge / scale, points / scale
    angles = np.arctan2(edge[:, 1], edge[:, 0])
    order = np.argsort(angles)
    edge, angles = edge[order], angles[order]
    after = np.searchsorted(angles, np.arctan2(points[:, 1], points[:, 0])) % len(edge)
    p, q = edge[after - 1], edge[after]
    normal = np.column_stack((q[:, 1] - p[:, 1], p[:, 0] - q[:, 0]))
    return np.sum(normal * points, axis=1) <= np.sum(normal * p, axis=1)


def slice_of(
    policy: TaskPolicy, world: str, axes: tuple[int, int], starts: int, duration: float
) -> MapSlice:
    """Run the trials of a slice."""
    setup = setup_of(policy, world)
    pendulum = setup.pendulum.parameters(linearised=setup.settings.plant.linearised)
    params = make_recovery_params(pendulum, setup.arm, setup.settings, setup.actuator)
    after_delay = boundary(params, axes)
    edge = fall(params, in_plane(after_delay, axes), -params.delay)[:, axes]
    limit = params.phi_limit if axes == (2, 3) else params.x_limit
    cells = ceil(sqrt(starts))
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(cells), np.arange(cells)), axis=-1).reshape(-1, 2)
    size = np.abs(edge[np.abs(edge[:, 0]) <= limit]).max(axis=0)
    half = np.minimum(BORDER * size, (limit, inf))
    chosen = half * (2.0 * (grid + rng.random(grid.shape)) / cells - 1.0)
    states = in_plane(chosen, axes)
    simulation = simulate(world, setup, seed=0, stream=MAP)
    trials = simulation.draw(len(chosen))
    nominal = DomainRandomization(1.0, 1.0, 0.0, 1.0, 0.0)
    trials = trials._replace(start=states, variation=np.tile(nominal, (len(chosen), 1)))
    simulation.run(policy, trials, duration=duration, workers=available_cores())
    inside = is_inside(after_delay, fall(params, states)[:, axes])
    return MapSlice(edge, chosen, inside, trials.cause == TRUNCATED)


def draw(slices: dict[str, MapSlice], settings: eq.Settings) -> Figure:
    """Draw the slices, with the area of the releases."""
    figure = Figure(figsize=(5.0 * len(slices), 4.5), layout="constrained")
    panels = figure.subplots(1, len(slices), squeeze=False)[0]
    for panel, (title, section) in zip(panels, slices.items(), strict=True):
        axes = PLANES[title]
        unit = np.array([UNITS[axis] for axis in axes])
        starts, size = unit * section.starts, 9000.0 / len(section.starts)
        for which, look, label in (
            (~section.inside & ~section.held, {"color": "0.7", "marker": "."}, "lost, outside"),
            (section.inside & ~section.held, {"color": "tab:red", "marker": "x"}, "lost, inside"),
            (section.held, {"color": "tab:blue", "marker": "s"}, "held by the policy"),
        ):
            panel.scatter(*starts[which].T, s=size, linewidths=0.5, label=label, **look)
        closed = unit * np.concatenate((section.edge, section.edge[:1]))
        panel.plot(*closed.T, color="black", label="beyond: no controller recovers")
        fraction = section.fraction()
        low, high = fraction["interval"]
        panel.set_title(
            f"{title}\nheld: {fraction['rate']:.0%} [{low:.0%}, {high:.0%}] of the inside"
        )
        panel.set(xlabel=LABELS[axes[0]], ylabel=LABELS[axes[1]])
        if axes == (2, 3):
            e = settings.evaluation
            corner = np.rad2deg((e.phi_low, e.phi_dot_low))
            width, height = np.rad2deg((e.phi_high, e.phi_dot_high)) - corner
            look = {"fill": False, "edgecolor": "tab:orange", "linewidth": 2.0, "zorder": 3}
            for sign in (1.0, -1.0):
                panel.add_patch(Rectangle(sign * corner, sign * width, sign * height, **look))
        panel.set_xlim(1.02 * unit[0] * np.array((-1.0, 1.0)) * np.abs(section.starts[:, 0]).max())
        panel.set_ylim(1.05 * unit[1] * np.array((-1.0, 1.0)) * np.abs(section.starts[:, 1]).max())
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
    return figure


def main() -> None:
    """Map a policy, and draw the figure."""
    parser = options(__doc__, "json", duration=10.0, out="map.png")
    parser.add_argument("policy", nargs="?", help="as `equipoise evaluate` takes it")
    parser.add_argument("--world", default="model", choices=("ideal", "model"))
    parser.add_argument("--starts", type=int, default=1600, help="starts of a slice")
    args = parser.parse_args()
    policy = eq.load_policy(args.policy)
    slices = {
        title: slice_of(policy, args.world, axes, args.starts, args.duration)
        for title, axes in PLANES.items()
    }
    for title, section in slices.items():
        print(f"{title}: {section.held.sum()} of {len(section.held)} starts held")
    draw(slices, policy.settings).savefig(args.out, dpi=150)
    fractions = [section.fraction() for section in slices.values()]
    store(args.json, {"starts": args.starts, "slices": fractions})


if __name__ == "__main__":
    main()
