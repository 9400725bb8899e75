"""Arms that tests change."""

from equipoise.arm.urdf import read_urdf

STEPS = (
    ((0.0, 0.0, 0.2), (0.0, 0.0, 1.0)),
    ((0.08, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((0.0, 0.0, 0.35), (0.0, 1.0, 0.0)),
    ((0.0, 0.0, 0.1), (0.0, 0.0, 1.0)),
    ((0.0, 0.0, 0.22), (0.0, 1.0, 0.0)),
    ((0.0, 0.0, 0.09), (0.0, 0.0, 1.0)),
)
"""Origin and axis of each joint of a small arm."""
HOME = (1.2, 0.4, 1.2, 0.3, 0.9, 0.2)


def without_masses(arm):
    """Return an arm of which no link has a known mass."""
    joints = tuple(joint.model_copy(update={"link": None}) for joint in arm.joints)
    return arm.model_copy(update={"joints": joints})


def small_arm(path, lengths):
    """Write a small arm as a URDF, with other lengths [m] of some of its steps; return the arm."""
    links = ['<link name="l0"/>']
    for number, (xyz, axis) in enumerate(STEPS, 1):
        length = lengths.get(number, max(xyz))
        x, y, z = (length if part else 0.0 for part in xyz)
        links.append(
            f'<link name="l{number}"><inertial><origin xyz="0 0 0.05"/><mass value="{4 / number}"/>'
            '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>'
            f'<joint name="j{number}" type="revolute"><parent link="l{number - 1}"/>'
            f'<child link="l{number}"/><origin xyz="{x} {y} {z}"/>'
            f'<axis xyz="{axis[0]} {axis[1]} {axis[2]}"/>'
            f'<limit lower="-2.9" upper="2.9" velocity="3.1" effort="{120.0 / number}"/></joint>'
        )
    links.append(
        '<link name="flange"/><joint name="end" type="fixed"><parent link="l6"/>'
        f'<child link="flange"/><origin xyz="0 0 {lengths.get(7, 0.07)}"/></joint>'
    )
    path.write_text(f'<robot name="small">{"".join(links)}</robot>')
    return read_urdf(path, home=HOME, pivot=(0.0, lengths.get(8, 0.13), 0.0))
