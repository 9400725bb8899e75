"""The bodies of the twin in MuJoCo: the arm, the bracket on its flange, and the pendulum.

The bodies of `equipoise.arm.scene` with the masses of the robot. The arm's own gravity is
balanced, as by its drives; that of bracket and pendulum is not. The pendulum is a uniform rod, and
its free swing determines its length::

    l = 3 g / (4 w2)      I = m g l / w2

Nothing collides: a trial ends before anything could. The bodies have no shapes, whose poses MuJoCo
would compute in each step.

Kernels call MuJoCo's C functions by their names, which `load_library` makes known: cached machine
code contains no address. They read and write the arrays of `mjData` as fields of one record.
"""

import ctypes
import functools
from math import copysign
from pathlib import Path
from threading import Lock, get_ident
from typing import Any, Final

import numba
import numpy as np
from llvmlite import binding

from equipoise.arm.arm import Arm, Inertial
from equipoise.arm.chain import Triple
from equipoise.arm.scene import SIZES, scene
from equipoise.arrays import Array
from equipoise.jit import DISABLED
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import TwinSettings, rotor_inertias
from equipoise.physics_engine import mujoco
from equipoise.settings import GRAVITY

TICK: Final = 1e-3
"""Time step of the twin: the cycle of the joint drives [s]."""
DRY_TIME: Final = 0.002
"""Time constant with which dry friction stops the pendulum [s]; the least that MuJoCo takes for
steps of a millisecond. With its default of 20 ms a sticking pendulum creeps."""


def build(arm: Arm, pendulum: PendulumParameters, settings: TwinSettings) -> Any:
    """Return the MuJoCo model of the twin: all joints of the arm, then phi of the pendulum.

    Args:
        arm: The arm; its pivot's distance from the axis of the last joint is that of the settings.
        pendulum: w2 and the frictions.
        settings: Masses and pivot; its frictions are not used, see `pendulum_on`.

    Raises:
        ArmError: The masses of the arm's links are not known.
    """
    n, bracket = len(arm.joints), settings.bracket_mass
    arm = arm.model_copy(update={"pivot": pivot(arm, settings.pivot_outward)})
    spec = _weighed(arm)
    if bracket > 0.0:
        _weigh(spec.body("flange"), bar_inertial(bracket, np.array(arm.pivot)))
    _weigh(spec.body("pendulum"), rod_inertial(pendulum.w2, settings.pendulum_mass))
    phi = spec.joint("phi")
    phi.solref_friction = [DRY_TIME, 1.0]
    phi.solimp_friction = [0.999, 0.999, *phi.solimp_friction[2:]]  # MuJoCo's default is 0.9
    model = spec.compile()
    model.dof_armature[:n] = rotor_inertias(settings, n)
    model.opt.timestep = TICK
    set_pendulum(model, mujoco().MjData(model), pendulum)
    return model


def set_pendulum(model: Any, data: Any, pendulum: PendulumParameters) -> None:
    """Set the pendulum of a MuJoCo model of the twin, which differs between trials.

    Args:
        model: From `build`; changed in place.
        data: Its state; set to the initial one.
        pendulum: w2 and the frictions.
    """
    body, phi = model.nbody - 1, model.nv - 1
    m = model.body_mass[body]
    rod = rod_inertial(pendulum.w2, m)
    model.body_ipos[body], model.body_inertia[body] = rod.com, np.take(rod.inertia, (0, 3, 5))
    set_friction(model, phi, pendulum, m)
    mj = mujoco()
    mj.mj_setConst(model, data)
    mj.mj_resetData(model, data)


def set_friction(model: Any, phi: int, pendulum: PendulumParameters, mass: float) -> None:
    """Set the frictions of a pendulum's joint in a MuJoCo model.

    Args:
        model: Changed in place.
        phi: Number of the joint's degree of freedom.
        pendulum: w2 and the frictions.
        mass: Mass of the pendulum [kg].
    """
    I = rod_inertia(pendulum.w2, mass)
    # MuJoCo's torque is -(damping + dampingpoly |rate|) rate.
    model.dof_damping[phi], model.dof_dampingpoly[phi, 0] = pendulum.c * I, pendulum.drag * I
    model.dof_frictionloss[phi] = pendulum.coulomb * I


def rod_centre(w2: float) -> float:
    """Return the distance from the pivot of a uniform rod to its centre of mass [m].

    Args:
        w2: w2 of the rod as a pendulum [1/s^2].
    """
    return 3.0 * GRAVITY / (4.0 * w2)


def rod_inertia(w2: float, mass: float) -> float:
    """Return the inertia of a uniform rod about its pivot [kg m^2].

    Args:
        w2: w2 of the rod as a pendulum [1/s^2].
        mass: Its mass [kg].
    """
    return mass * GRAVITY * rod_centre(w2) / w2


def rod_inertial(w2: float, mass: float) -> Inertial:
    """Return the inertial of a uniform rod, from its pivot upwards along z.

    Args:
        w2: w2 of the rod as a pendulum [1/s^2].
        mass: Its mass [kg].
    """
    l = rod_centre(w2)
    across, along = rod_inertia(w2, mass) - mass * l**2, 0.5 * mass * SIZES.rod**2
    inertia = np.diag([across, across, along])
    return Inertial.of("pendulum", mass, np.array([0.0, 0.0, l]), inertia)


def bar_inertial(mass: float, end: Array) -> Inertial:
    """Return the inertial of a bar as thick as the bracket.

    Args:
        mass: Its mass [kg].
        end: Its end in the frame in which it starts [m], shape (3,).
    """
    slender = (end @ end * np.eye(3) - np.outer(end, end)) / 12.0
    inertia = mass * (slender + SIZES.bracket**2 / 4.0 * np.eye(3))
    return Inertial.of("bracket", mass, 0.5 * end, inertia)


def pivot(arm: Arm, outward: float) -> Triple:
    """Return the pendulum's pivot in the flange frame [m], at a distance from the last axis.

    Args:
        arm: The arm, which gives the side and the height of the pivot.
        outward: Distance along the spindle, which lies along base y at home [m].
    """
    spindle = arm.kinematics(arm.home_free).rotation[1]
    own = float(spindle @ arm.pivot)
    x, y, z = arm.pivot + (copysign(outward, own) - own) * spindle
    return float(x), float(y), float(z)


def build_bare(arm: Arm) -> Any:
    """Return the MuJoCo model of the bare arm's links, as its drives know them.

    Raises:
        ArmError: The masses of the arm's links are not known.
    """
    spec = _weighed(arm)
    spec.delete(spec.body("flange"))
    spec.delete(spec.key("home"))
    return spec.compile()


def mass_matrix(arm: Arm) -> Array:
    """Return the mass matrix of the bare arm at home, without rotors [kg m^2], shape (n, n)."""
    mj = mujoco()
    model = build_bare(arm)
    data = mj.MjData(model)
    data.qpos[:] = arm.home
    mj.mj_forward(model, data)
    M = np.zeros((model.nv, model.nv))
    mj.mj_fullM(model, data, M)
    return M


def _weighed(arm: Arm) -> Any:
    """Return the scene without shapes, with the masses of the arm's links."""
    mj = mujoco()
    spec = scene(arm)
    spec.memory = 1 << 17  # [bytes]; a chain without contacts needs little
    spec.compiler.boundmass, spec.compiler.boundinertia = 0.0, 0.0
    # MuJoCo's 1e-8 is relative to the inertia of the whole arm; the dry friction of a pendulum of
    # 0.15 kg can be smaller and would be lost.
    spec.option.tolerance = 1e-14
    spec.option.gravity = [0.0, 0.0, -GRAVITY]
    off = mj.mjtDisableBit
    # A diverging state must be visible, not reset; the pendulum's damping needs no implicit step.
    for feature in ("CONTACT", "ISLAND", "EULERDAMP", "AUTORESET"):
        spec.option.disableflags |= int(getattr(off, f"mjDSBL_{feature}"))
    # A solver over the constraint forces: one row of dry friction needs one pass.
    spec.option.solver = mj.mjtSolver.mjSOL_PGS
    for geom in list(spec.geoms):
        spec.delete(geom)
    for number, (joint, link) in enumerate(zip(arm.joints, arm.link_inertials(), strict=True), 1):
        body = spec.body(f"frame {number}")
        body.gravcomp = 1.0
        # Time constant [s] and damping of the end of the range; with MuJoCo's default of 20 ms a
        # joint at full speed overshoots by 3 degrees.
        spec.joint(joint.name).solref_limit = [0.005, 1.0]
        _weigh(body, link)
    return spec


def _weigh(body: Any, link: Inertial) -> None:
    """Set the inertial of a body, independent of its geometry."""
    xx, xy, xz, yy, yz, zz = link.inertia
    body.explicitinertial = True
    body.mass, body.ipos = link.mass, link.com
    body.fullinertia = [xx, yy, zz, xy, xz, yz]


@functools.cache
def load_library() -> ctypes.CDLL:
    """Load MuJoCo's C library for kernels, with its profiler off.

    MuJoCo reads a clock at the start and the end of each stage of a step, a sixth of the step.
    """
    path = next(Path(mujoco().__file__).parent.glob("*mujoco.*"))
    binding.load_library_permanently(str(path))
    library = ctypes.CDLL(str(path))
    ctypes.c_void_p.in_dll(library, "mjcb_time").value = None
    return library


_callback_lock: Final = Lock()


def addresses(model: Any, data: Any) -> tuple[int, int]:
    """Return the addresses of MuJoCo's structures, which its control callback receives.

    Args:
        model: A model.
        data: Its state; computes what depends on positions and velocities.
    """
    mj, found = mujoco(), dict[int, tuple[int, int]]()
    callback = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(
        lambda *structures: found.update({get_ident(): structures})  # other threads call it, too
    )
    with _callback_lock:
        before = mj.get_mjcb_control()
        mj.set_mjcb_control(callback)
        try:
            mj.mj_step1(model, data)
        finally:
            mj.set_mjcb_control(before)
    return found[get_ident()]


def _c_function(name: str, *more: Any) -> Any:
    """Return a C function of MuJoCo for kernels.

    Args:
        name: Its name.
        more: Numba types of its arguments after the addresses of model and data.
    """
    if DISABLED:
        return lambda *values: load_library()[name](*map(ctypes.c_void_p, map(int, values)))
    intp = numba.types.intp
    return numba.types.ExternalFunction(name, numba.types.void(intp, intp, *more))


# ruff: noqa: N816  (the names are MuJoCo's)
# Quantities that depend on positions and velocities: the whole, and its stages in their order.
mj_step1 = _c_function("mj_step1")
mj_kinematics = _c_function("mj_kinematics")
mj_comPos = _c_function("mj_comPos")
mj_crb = _c_function("mj_crb")
mj_factorM = _c_function("mj_factorM")
mj_comVel = _c_function("mj_comVel")
mj_passive = _c_function("mj_passive")
mj_rne = _c_function("mj_rne", numba.intc, numba.intp)  # no accelerations; address of the result
# Accelerations under the applied forces, and integration: the whole, and its stages.
mj_step2 = _c_function("mj_step2")
mj_fwdAcceleration = _c_function("mj_fwdAcceleration")
mj_Euler = _c_function("mj_Euler")
mj_solveM = _c_function("mj_solveM", numba.intp, numba.intp, numba.intc)  # result, forces, number


def arrays_of(data: Any) -> Any:
    """Return the arrays of `mjData` that kernels use, as one record, shape (1,).

    Args:
        data: State of MuJoCo, which has to outlive the record: it owns the memory.
    """
    bodies = ("xpos", "xmat", "xipos", "xaxis", "xanchor", "cvel", "subtree_com")
    joints = ("qpos", "qvel", "qacc", "qacc_smooth", "qacc_warmstart")
    forces = ("qfrc_applied", "qfrc_bias")
    arrays = sorted((getattr(data, name).ctypes.data, name) for name in bodies + joints + forces)
    start = arrays[0][0]
    fields = np.dtype(
        {
            "names": [name for _, name in arrays],
            "formats": [(np.float64, getattr(data, name).shape) for _, name in arrays],
            "offsets": [address - start for address, _ in arrays],
        }
    )
    memory: Any = (ctypes.c_char * fields.itemsize).from_address(start)
    return np.frombuffer(memory, np.dtype((np.record, fields)))
