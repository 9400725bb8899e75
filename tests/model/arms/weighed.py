"""The arms of `witnesses` with their masses, in MuJoCo and Pinocchio.

The table of the iiwas is typed from the public description, in its own frames.
"""

import mujoco
import numpy as np

from equipoise.model.arms.iiwa import iiwa
from tests.model.arms.witnesses import ARMS, Pinocchio, iiwa_urdf

GRAVITY = np.array([0.0, 0.0, -9.80665])
PUBLISHED = {
    # link|mass [kg]|com [m]|Ixx Ixy Ixz Iyy Iyz Izz [kg m^2]
    7: """
        0|4.855658|-0.012857 0 0.069964|.017839|0|.000781|.022294|0|.021334
        1|3.394011|0 -0.034819 0.123299|.021383|0|0|.020403|.003797|.007563
        2|4.031991|0 0.039793 0.086944|.031697|0|0|.03008|.005889|.009666
        3|3.394011|0 0.034819 0.123299|.021383|0|0|.020403|-.003797|.007563
        4|4.031989|0 -0.039793 0.086944|.031695|0|0|.030079|-.005889|.009665
        5|1.529239|0 -0.029824 0.076267|.008485|0|0|.007136|.002806|.003848
        6|2.403626|0 0.07102 0.00495|.007067|0|0|.006804|.000311|.004629
        7|0.259474|3e-6 -2e-6 .013782|.000171|0|0|.000171|0|.000299
    """,
    14: """
        0|7.050378|-0.012822 0 0.071507|.031226|0|.000871|.039697|0|.043102
        1|5.289529|0 -0.033795 0.132404|.042462|0|0|.042838|.006341|.01587
        2|5.688888|.000136 0.047548 0.076322|.055182|-3.3e-5|5.6e-5|.053983|.010034|.016523
        3|3.461245|0 0.034913 0.123108|.02172|0|0|.02073|-.003845|.007701
        4|4.122995|0 -0.039793 0.086944|.03241|0|0|.030758|-.006022|.009883
        5|1.563756|0 -0.029824 0.076267|.008677|0|0|.007297|.002869|.003935
        6|2.457878|0 0.07102 0.00495|.007227|0|0|.006958|.000318|.004734
        7|0.265331|3e-6 -2e-6 .013782|.000175|0|0|.000175|0|.000306
    """,
}
TOTAL = {7: 23.9, 14: 29.9}
"""What each weighs with its base [kg]."""


def weighed_urdf(size):
    """Return the public chain with the public inertials; the flange weighs nothing."""
    urdf = iiwa_urdf(size)
    for line in PUBLISHED[size].split("\n"):
        if not line.strip():
            continue
        number, mass, com, *inertia = (part.strip() for part in line.split("|"))
        names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        moments = " ".join(f'{n}="{v}"' for n, v in zip(names, inertia, strict=True))
        start = urdf.index(f'<link name="link{number}">')
        end = urdf.index("</link>", start)
        urdf = (
            urdf[:start]
            + f'<link name="link{number}"><inertial><origin xyz="{com}"/>'
            + f'<mass value="{mass}"/><inertia {moments}/></inertial>'
            + urdf[end:]
        )
    start = urdf.index('<link name="flange">')
    return urdf[:start] + '<link name="flange">' + urdf[urdf.index("</link>", start) :]


WEIGHED = {
    "iiwa7": (iiwa(7), weighed_urdf(7)),
    "iiwa14": (iiwa(14), weighed_urdf(14)),
    "elbow6": ARMS["elbow6"],
}
"""Arms, and the URDFs with their masses that the libraries read."""


def by_mujoco(urdf, q):
    model = mujoco.MjModel.from_xml_string(urdf)
    model.opt.gravity[:] = GRAVITY
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    return M, data.qfrc_bias.copy()


def by_pinocchio(urdf, q):
    robot = Pinocchio(urdf)
    robot.model.gravity.linear = GRAVITY
    configuration = robot.configuration(q)
    M = robot.pin.crba(robot.model, robot.data, configuration)
    torque = robot.pin.computeGeneralizedGravity(robot.model, robot.data, configuration)
    return np.triu(M) + np.triu(M, 1).T, torque
