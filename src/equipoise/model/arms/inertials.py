"""Masses and inertias of the links of the iiwa 7 and iiwa 14, for simulations of their dynamics.

KUKA publishes none; these are the numbers of `lbr_description` of the LBR stack (Apache-2.0), whose
joint frames lie half-way along the links and beside them and are parallel to the base at zero.
`link_inertials` places them in the joint frames of our chain. The base, link 0, does not move and
is left out.
"""

from typing import Final, NamedTuple

import numpy as np

from equipoise.errors import ArmError
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.chain import Floats, Triple, rotation_from_rpy
from equipoise.model.arms.iiwa import iiwa


class Inertial(NamedTuple):
    """What decides how a link resists motion, in the frame of the joint that moves it."""

    mass: float
    """Mass [kg]."""
    com: Floats
    """Centre of mass [m], shape (3,)."""
    inertia: Floats
    """Inertia about the centre of mass [kg m^2], shape (3, 3)."""


class _Link(NamedTuple):
    origin: Triple
    """Origin of the joint in the frame before it [m]; all axes are parallel at zero."""
    mass: float
    """Mass of the link that the joint moves [kg]."""
    com: Triple
    """Its centre of mass [m]."""
    inertia: tuple[float, float, float, float, float, float]
    """xx, xy, xz, yy, yz, zz about the centre of mass [kg m^2]."""


_LINKS: Final = {
    7: (
        _Link(
            (0.0, 0.0, 0.1475),
            3.394011,
            (0.0, -0.034819, 0.123299),
            (0.021383, 0.0, 0.0, 0.020403, 0.003797, 0.007563),
        ),
        _Link(
            (0.0, -0.0105, 0.1925),
            4.031991,
            (0.0, 0.039793, 0.086944),
            (0.031697, 0.0, 0.0, 0.03008, 0.005889, 0.009666),
        ),
        _Link(
            (0.0, 0.0105, 0.2075),
            3.394011,
            (0.0, 0.034819, 0.123299),
            (0.021383, 0.0, 0.0, 0.020403, -0.003797, 0.007563),
        ),
        _Link(
            (0.0, 0.0105, 0.1925),
            4.031989,
            (0.0, -0.039793, 0.086944),
            (0.031695, 0.0, 0.0, 0.030079, -0.005889, 0.009665),
        ),
        _Link(
            (0.0, -0.0105, 0.2075),
            1.529239,
            (0.0, -0.029824, 0.076267),
            (0.008485, 0.0, 0.0, 0.007136, 0.002806, 0.003848),
        ),
        _Link(
            (0.0, -0.0707, 0.1925),
            2.403626,
            (0.0, 0.07102, 0.00495),
            (0.007067, 0.0, 0.0, 0.006804, 0.000311, 0.004629),
        ),
        _Link(
            (0.0, 0.0707, 0.091),
            0.259474,
            (3e-06, -2e-06, 0.013782),
            (0.000171, 0.0, 0.0, 0.000171, 0.0, 0.000299),
        ),
    ),
    14: (
        _Link(
            (0.0, 0.0, 0.1475),
            5.289529,
            (0.0, -0.033795, 0.132404),
            (0.042462, 0.0, 0.0, 0.042838, 0.006341, 0.01587),
        ),
        _Link(
            (0.0, -0.01, 0.2125),
            5.688888,
            (0.000136, 0.047548, 0.076322),
            (0.055182, -3.3e-05, 5.6e-05, 0.053983, 0.010034, 0.016523),
        ),
        _Link(
            (0.0, 0.01, 0.228),
            3.461245,
            (0.0, 0.034913, 0.123108),
            (0.02172, 0.0, 0.0, 0.02073, -0.003845, 0.007701),
        ),
        _Link(
            (0.0, 0.0105, 0.192),
            4.122995,
            (0.0, -0.039793, 0.086944),
            (0.03241, 0.0, 0.0, 0.030758, -0.006022, 0.009883),
        ),
        _Link(
            (0.0, -0.0105, 0.2075),
            1.563756,
            (0.0, -0.029824, 0.076267),
            (0.008677, 0.0, 0.0, 0.007297, 0.002869, 0.003935),
        ),
        _Link(
            (0.0, -0.0707, 0.1925),
            2.457878,
            (0.0, 0.07102, 0.00495),
            (0.007227, 0.0, 0.0, 0.006958, 0.000318, 0.004734),
        ),
        _Link(
            (0.0, 0.0707, 0.091),
            0.265331,
            (3e-06, -2e-06, 0.013782),
            (0.000175, 0.0, 0.0, 0.000175, 0.0, 0.000306),
        ),
    ),
}


def link_inertials(arm: Arm) -> tuple[Inertial, ...]:
    """Return the inertial of the link behind each joint.

    Args:
        arm: An iiwa; home, pivot, limits and held joint do not matter.

    Raises:
        ArmError: The inertials of this arm are not known.
    """
    for size in (7, 14):
        if _chain(arm) == _chain(iiwa(size)):
            return _placed(arm, _LINKS[size])
    raise ArmError(
        f"masses and inertias of the links of {arm.name} are not known, only those of iiwa7 and "
        "iiwa14; choose one of these for the twin"
    )


def _chain(arm: Arm) -> tuple[object, ...]:
    places = tuple((joint.xyz, joint.rpy, joint.axis) for joint in arm.joints)
    return *places, arm.flange_xyz, arm.flange_rpy


def _placed(arm: Arm, links: tuple[_Link, ...]) -> tuple[Inertial, ...]:
    """Return the published inertials in the joint frames of `arm`.

    Both frames of a link are fixed to it, so that where they are at zero tells one in the other.
    """
    origin, rotation, published = np.zeros(3), np.eye(3), np.zeros(3)
    result: list[Inertial] = []
    for joint, link in zip(arm.joints, links, strict=True):
        origin = origin + rotation @ joint.xyz
        rotation = rotation @ rotation_from_rpy(joint.rpy)
        published = published + link.origin
        xx, xy, xz, yy, yz, zz = link.inertia
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        result.append(
            Inertial(
                mass=link.mass,
                com=rotation.T @ (published + link.com - origin),
                inertia=rotation.T @ inertia @ rotation,
            )
        )
    return tuple(result)
