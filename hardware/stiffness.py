"""First bending modes of the holder with the pendulum's mass on it.

Two estimates that share nothing but the solids: a beam whose sections are measured on slices, and
finite elements on cubes. Both are of one soft, even material; bearings and screws are rigid. The
whole mass of the pendulum moves with the holder, although the pendulum is free to turn.
"""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
import trimesh
from build123d import Part, Solid
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import LinearOperator, eigsh, splu

import parts
from design import MM, Design
from mechanism import Mechanism

Array = npt.NDArray[np.float64]

LEAST: Final = 30.0
"""Least first mode [Hz]: a third of the controller's ticks of 100 Hz."""
POISSON: Final = 0.38
"""Poisson's ratio of PETG."""
STIFF: Final = 50e9
"""Young's modulus of spindle and bearings, drawn as one bar [Pa]; steel has 200e9."""


def beam(mechanism: Mechanism, slice_width: float = 2.0) -> float:
    """Return the first mode of vertical bending [Hz], as a beam with a mass at its end.

    The base bends from the edge of the flange to the wall; the block is taken as rigid. The
    flexibility is that of Castigliano, the integral of s^2 / (E I) over the beam.

    Args:
        mechanism: The mechanism.
        slice_width: Thickness of the slices on which I is measured [mm].
    """
    d = mechanism.design
    base, compliance = parts.base(d), 0.0
    edges = np.arange(0.5 * d.flange.outer, d.wall_start, slice_width)
    for x in edges:
        cut = base & parts.box((x, x + slice_width), (-99.0, 99.0), (-99.0, 99.0))
        M = np.array(cut.matrix_of_inertia)  # of the slice about its centre [mm^5]
        second_moment = 0.5 * (M[0, 0] + M[1, 1] - M[2, 2]) / slice_width * MM**4
        lever = (d.pivot_outward - x - 0.5 * slice_width) * MM
        compliance += lever**2 * slice_width * MM / (d.print.modulus * second_moment)
    mass = mechanism.pendulum.mass + mechanism.holder.mass  # the holder's is nearer to the flange
    return float(np.sqrt(1.0 / (compliance * mass)) / (2.0 * np.pi))


def modes(mechanism: Mechanism, pitch: float = 4.0, count: int = 3) -> Array:
    """Return the first modes [Hz] by finite elements: cubes with eight nodes.

    The base is held where it lies on the flange within 9 mm of its screws.

    Args:
        mechanism: The mechanism.
        pitch: Edge of a cube [mm].
        count: Number of modes.
    """
    d = mechanism.design
    xs = np.arange(-0.5 * d.plate_diameter, d.spindle_end, pitch) + 0.5 * pitch
    ys = np.arange(-d.half_width, d.half_width, pitch) + 0.5 * pitch
    zs = np.arange(0.0, d.pivot_down + d.wall_below, pitch) + 0.5 * pitch
    grid = np.stack(np.meshgrid(xs, ys, zs, indexing="ij"), axis=-1)
    centres = grid.reshape(-1, 3)
    printed = np.zeros(len(centres), bool)
    for solid in (parts.base(d), parts.bearing_block(d)):
        printed |= mesh(solid).contains(centres)
    axis = np.hypot(centres[:, 1], centres[:, 2] - d.pivot_down)
    bar = (axis < 0.5 * d.bearing.outer) & (centres[:, 0] > d.wall_end)
    filled = (printed | bar).reshape(grid.shape[:3])
    stiff = bar[filled.ravel()]
    cubes = np.argwhere(filled)
    offsets = np.array([[i, j, k] for k in (0, 1) for j in (0, 1) for i in (0, 1)])
    corners = (cubes[:, None, :] + offsets[None]).reshape(-1, 3)
    nodes, index = np.unique(corners, axis=0, return_inverse=True)
    index = index.reshape(-1, 8)
    size = pitch * MM
    K1 = cube(POISSON) * size
    modulus = np.where(stiff, STIFF, d.print.modulus)
    dof = (3 * index[:, :, None] + np.arange(3)).reshape(-1, 24)
    rows = np.repeat(dof, 24, axis=1).ravel()
    columns = np.tile(dof, (1, 24)).ravel()
    n = 3 * len(nodes)
    K = coo_matrix(((modulus[:, None] * K1.ravel()).ravel(), (rows, columns)), (n, n)).tocsc()
    bar_mass = mechanism.pendulum.mass / max(np.sum(stiff), 1)
    mass = np.where(stiff, bar_mass, d.print.density * size**3) / 8.0
    lumped = np.zeros(n)
    np.add.at(lumped, dof, np.repeat(mass, 24).reshape(-1, 24))
    places = nodes * pitch + [xs[0] - 0.5 * pitch, ys[0] - 0.5 * pitch, 0.0]
    near = [
        np.hypot(places[:, 0] - x, places[:, 1] - y) < 9.0
        for x, y in parts.flange_places(d, d.flange.screw_deg)
    ]
    held = np.any(near, axis=0) & (places[:, 2] < 1e-6)
    free = np.flatnonzero(np.repeat(~held, 3))
    M = coo_matrix((lumped[free], (np.arange(len(free)),) * 2)).tocsc()
    symmetric = {"SymmetricMode": True}
    solve = splu(K[free][:, free], "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric).solve
    inverse = LinearOperator((len(free),) * 2, solve)
    squares = eigsh(K[free][:, free], count, M, sigma=0.0, OPinv=inverse, return_eigenvectors=False)
    return np.sort(np.sqrt(squares)) / (2.0 * np.pi)


def cube(poisson: float) -> Array:
    """Return the stiffness of a unit cube with E = 1, two Gauss points each way, shape (24, 24)."""
    corner = np.array([[i, j, k] for k in (0, 1) for j in (0, 1) for i in (0, 1)]) * 2.0 - 1.0
    lame = poisson / ((1 + poisson) * (1 - 2 * poisson))
    shear = 0.5 / (1 + poisson)
    D = np.diag([2 * shear] * 3 + [shear] * 3)
    D[:3, :3] += lame
    K, point = np.zeros((24, 24)), 1.0 / np.sqrt(3.0)
    for gauss in corner * point:
        factors = 1.0 + corner * gauss
        slope = (
            0.25
            * corner
            * np.stack(
                [
                    factors[:, 1] * factors[:, 2],
                    factors[:, 0] * factors[:, 2],
                    factors[:, 0] * factors[:, 1],
                ],
                axis=1,
            )
        )  # d N / d x of a cube with edge 1: twice that of [-1, 1]
        B = np.zeros((6, 24))
        for node, (x, y, z) in enumerate(slope):
            B[:, 3 * node : 3 * node + 3] = [
                [x, 0, 0],
                [0, y, 0],
                [0, 0, z],
                [y, x, 0],
                [0, z, y],
                [z, 0, x],
            ]
        K += B.T @ D @ B / 8.0
    return K


def spindle(d: Design, mass: float) -> float:
    """Return the first mode of a mass on the free end of the spindle [Hz].

    Args:
        d: The design.
        mass: Mass in the pendulum's plane [kg].
    """
    overhang = (d.pivot_outward - d.block_end + 0.5 * d.bearing.width) * MM
    span = (d.block_end - d.wall_end - d.bearing.width) * MM
    second_moment = np.pi * (d.spindle * MM) ** 4 / 64.0
    stiffness = 3.0 * 200e9 * second_moment / (overhang**2 * (overhang + span))
    return float(np.sqrt(stiffness / mass) / (2.0 * np.pi))


def mesh(solid: Part | Solid) -> Any:
    """Return the closed mesh of a solid [mm]."""
    vertices, faces = solid.tessellate(0.1, 0.2)
    found = trimesh.Trimesh([tuple(v) for v in vertices], faces)
    found.merge_vertices()
    return found
