"""Masses and inertias of the iiwas' links, and their validation for a twin.

KUKA publishes no inertias of the iiwa 7 and iiwa 14. The numbers come from `lbr_description` of the
LBR stack (Apache-2.0). Its joint frames lie half-way along the links and beside them, and are
parallel to the base at zero. `place_links` moves them into the joint frames of another chain of
the same arm. The base, link 0, does not move and is left out.
"""

from collections.abc import Sequence
from typing import Final, TypeGuard

import numpy as np

from equipoise.errors import ArmError
from equipoise.model.arms.arm import Arm, Inertial, Joint
from equipoise.model.arms.chain import Floats, rotation_from_rpy

ROUNDING: Final = 1e-6
"""Relative rounding of published moments of inertia."""


# fmt: off
_LINKS: Final = {
    7: (
        ((0.0, 0.0, 0.1475), 3.394011, (0.0, -0.034819, 0.123299),
         (0.021383, 0.0, 0.0, 0.020403, 0.003797, 0.007563)),
        ((0.0, -0.0105, 0.1925), 4.031991, (0.0, 0.039793, 0.086944),
         (0.031697, 0.0, 0.0, 0.03008, 0.005889, 0.009666)),
        ((0.0, 0.0105, 0.2075), 3.394011, (0.0, 0.034819, 0.123299),
         (0.021383, 0.0, 0.0, 0.020403, -0.003797, 0.007563)),
        ((0.0, 0.0105, 0.1925), 4.031989, (0.0, -0.039793, 0.086944),
         (0.031695, 0.0, 0.0, 0.030079, -0.005889, 0.009665)),
        ((0.0, -0.0105, 0.2075), 1.529239, (0.0, -0.029824, 0.076267),
         (0.008485, 0.0, 0.0, 0.007136, 0.002806, 0.003848)),
        ((0.0, -0.0707, 0.1925), 2.403626, (0.0, 0.07102, 0.00495),
         (0.007067, 0.0, 0.0, 0.006804, 0.000311, 0.004629)),
        ((0.0, 0.0707, 0.091), 0.259474, (3e-06, -2e-06, 0.013782),
         (0.000171, 0.0, 0.0, 0.000171, 0.0, 0.000299)),
    ),
    14: (
        ((0.0, 0.0, 0.1475), 5.289529, (0.0, -0.033795, 0.132404),
         (0.042462, 0.0, 0.0, 0.042838, 0.006341, 0.01587)),
        ((0.0, -0.01, 0.2125), 5.688888, (0.000136, 0.047548, 0.076322),
         (0.055182, -3.3e-05, 5.6e-05, 0.053983, 0.010034, 0.016523)),
        ((0.0, 0.01, 0.228), 3.461245, (0.0, 0.034913, 0.123108),
         (0.02172, 0.0, 0.0, 0.02073, -0.003845, 0.007701)),
        ((0.0, 0.0105, 0.192), 4.122995, (0.0, -0.039793, 0.086944),
         (0.03241, 0.0, 0.0, 0.030758, -0.006022, 0.009883)),
        ((0.0, -0.0105, 0.2075), 1.563756, (0.0, -0.029824, 0.076267),
         (0.008677, 0.0, 0.0, 0.007297, 0.002869, 0.003935)),
        ((0.0, -0.0707, 0.1925), 2.457878, (0.0, 0.07102, 0.00495),
         (0.007227, 0.0, 0.0, 0.006958, 0.000318, 0.004734)),
        ((0.0, 0.0707, 0.091), 0.265331, (3e-06, -2e-06, 0.013782),
         (0.000175, 0.0, 0.0, 0.000175, 0.0, 0.000306)),
    ),
}
# fmt: on
"""For each joint its origin in the previous frame [m] (all axes are parallel at zero), and of the
link that it moves the mass [kg], the centre of mass [m], and xx, xy, xz, yy, yz, zz [kg m^2]."""


def place_links(joints: Sequence[Joint], size: int) -> tuple[Joint, ...]:
    """Return joints of an iiwa with the published inertials, in their own frames.

    Both frames of a link are fixed to it, so that their places at zero give one in the other.

    Args:
        joints: All seven joints.
        size: 7 or 14.
    """
    origin, rotation, published = np.zeros(3), np.eye(3), np.zeros(3)
    result: list[Joint] = []
    for number, (joint, link) in enumerate(zip(joints, _LINKS[size], strict=True), start=1):
        place, mass, com, entries = link
        origin = origin + rotation @ joint.xyz
        rotation = rotation @ rotation_from_rpy(joint.rpy)
        published = published + place
        inertia = inertia_entries(rotation.T @ inertia_matrix(entries) @ rotation)
        com = tuple((rotation.T @ (published + com - origin)).tolist())
        placed = Inertial(name=f"link {number}", mass=mass, com=com, inertia=inertia)
        result.append(joint.model_copy(update={"link": placed}))
    return tuple(result)


def link_inertials(arm: Arm) -> tuple[Inertial, ...]:
    """Return the inertial of the link that each joint moves.

    Raises:
        ArmError: A mass or an inertia is unknown or impossible; the message names all of them.
    """
    links = tuple(joint.link for joint in arm.joints if _is_possible(joint.link))
    if faults := [joint.name for joint in arm.joints if not _is_possible(joint.link)]:
        raise ArmError(
            f"a twin of {arm.name} needs mass and inertia of every moving link, and those behind "
            f"the joints {', '.join(faults)} are missing or impossible (each principal moment must "
            "be positive and at most the sum of the other two); complete <inertial> in its URDF"
        )
    return links


def inertia_matrix(entries: Sequence[float]) -> Floats:
    """Return an inertia matrix from xx, xy, xz, yy, yz, zz, shape (3, 3)."""
    xx, xy, xz, yy, yz, zz = entries
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def inertia_entries(inertia: Floats) -> tuple[float, float, float, float, float, float]:
    """Return xx, xy, xz, yy, yz, zz of an inertia matrix, shape (3, 3)."""
    xx, xy, xz, _, yy, yz, _, _, zz = inertia.ravel().tolist()
    return xx, xy, xz, yy, yz, zz


def _is_possible(link: Inertial | None) -> TypeGuard[Inertial]:
    if link is None or not link.mass > 0.0:
        return False
    moments = np.linalg.eigvalsh(inertia_matrix(link.inertia))
    return bool(moments[0] > 0.0 and moments[2] <= (moments[0] + moments[1]) * (1.0 + ROUNDING))
