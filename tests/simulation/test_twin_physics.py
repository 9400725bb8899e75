"""The twin's bodies in MuJoCo against the public chain, closed forms and energy."""

import mujoco
import numpy as np
import pytest

from equipoise import PendulumParameters, iiwa
from equipoise.errors import ArmError
from equipoise.model.worlds import TwinSettings
from equipoise.settings import GRAVITY
from equipoise.simulation.twin.physics import build, mass_matrix
from tests.arm.witnesses import ARMS, by_pinocchio
from tests.arms import without_masses

PENDULUM = PendulumParameters(w2=70.2, k=70.2 / GRAVITY, c=0.15)
BARE = TwinSettings(bracket_mass=0.0, pendulum_mass=1e-9, rotor_inertia=(0.0,))


def at(model, q):
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    return data


def matrix(model, q):
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, at(model, q), M)
    return M


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.full
def test_the_arm_is_that_of_an_independent_library(name):
    arm, urdf = ARMS[name]
    n = len(arm.joints)
    model = build(arm, PENDULUM, BARE)
    rng = np.random.default_rng(n)
    for _ in range(5):
        q = rng.uniform(-2.0, 2.0, n)
        M, torque = by_pinocchio(urdf, q)
        # MuJoCo keeps principal inertias, to some 1e-7 of what it is given.
        assert matrix(model, [*q, 0.0])[:n, :n] == pytest.approx(M, abs=1e-6)
        data = at(model, [*q, 0.0])
        assert data.qfrc_bias[:n] == pytest.approx(torque, abs=1e-6)
        assert data.qfrc_gravcomp[:n] == pytest.approx(torque, abs=1e-6)


def test_rotors_bracket_and_pendulum_have_their_inertia():
    arm, home = iiwa(7), [*iiwa(7).home, 0.0]
    rotors = BARE.model_copy(update={"rotor_inertia": (0.3, 0.2)})
    more = matrix(build(arm, PENDULUM, rotors), home) - matrix(build(arm, PENDULUM, BARE), home)
    assert more == pytest.approx(np.diag([0.3] + [0.2] * 6 + [0.0]), abs=1e-9)

    model = build(arm, PENDULUM, TwinSettings(bracket_mass=0.4, pendulum_mass=0.3))
    outward = np.array([0.0, 0.13, 0.0])
    data = at(model, home)
    flange, rod = model.body("flange"), model.body("pendulum")
    assert flange.mass[0] == pytest.approx(0.4)
    assert rod.mass[0] == pytest.approx(0.3)
    flange_x = arm.kinematics(arm.home_free).position
    assert data.xipos[flange.id] == pytest.approx(flange_x + 0.5 * outward, abs=1e-9)
    assert data.xpos[rod.id] == pytest.approx(flange_x + outward, abs=1e-9)


@pytest.mark.parametrize("w2", [60.0, 70.2])
def test_the_pendulum_is_a_uniform_rod_with_the_w2_and_k_that_it_shall_have(w2):
    settings = TwinSettings(pendulum_mass=0.2)
    pendulum = PendulumParameters(w2=w2, k=w2 / GRAVITY, c=0.1, coulomb=0.3, drag=0.02)
    model = build(iiwa(7), pendulum, settings)
    home = [*iiwa(7).home, 0.0]
    I = matrix(model, home)[7, 7]
    # A uniform rod of length L about its end: I = m L^2 / 3, centre of mass at L / 2.
    l = model.body("pendulum").ipos[2]
    assert pytest.approx(0.2 * (2 * l) ** 2 / 3) == I
    assert 0.2 * GRAVITY * l / I == pytest.approx(w2)
    # What an acceleration of the pivot does, k = m l / I: the flange's is that of A1 at home.
    assert model.dof_damping[7] == pytest.approx(0.1 * I)
    assert model.dof_dampingpoly[7, 0] == pytest.approx(0.02 * I)
    assert model.dof_frictionloss[7] == pytest.approx(0.3 * I)
    flange = iiwa(7).kinematics(iiwa(7).home_free)
    x_per_a1 = flange.jacobian[0, 0] - 0.13  # the pivot is outward of the flange, along base y
    coupling = matrix(model, home)[7, 0] / I
    assert coupling == pytest.approx(pendulum.k * x_per_a1)


def test_gravity_of_the_arm_is_balanced_and_that_of_bracket_and_pendulum_is_not():
    arm = iiwa(7)
    rng = np.random.default_rng(5)
    bare, loaded = build(arm, PENDULUM, BARE), build(arm, PENDULUM, TwinSettings())
    for _ in range(5):
        q = [*rng.uniform(-1.0, 1.0, 7), np.pi]
        data = at(bare, q)
        assert data.qfrc_passive[:7] == pytest.approx(data.qfrc_bias[:7], abs=1e-6)
        data = at(loaded, q)
        J = np.zeros((3, 8))
        torque = np.zeros(8)
        for name, mass in (("flange", 0.1), ("pendulum", 0.15)):
            mujoco.mj_jacBodyCom(loaded, data, J, None, loaded.body(name).id)
            torque += mass * GRAVITY * J[2]
        unbalanced = data.qfrc_bias - data.qfrc_gravcomp
        assert unbalanced == pytest.approx(torque, abs=1e-6)


def test_an_arm_of_unknown_masses_is_refused():
    arm = without_masses(iiwa(7))
    with pytest.raises(ArmError, match="mass"):
        build(arm, PENDULUM, TwinSettings())
    with pytest.raises(ArmError, match="mass"):
        mass_matrix(arm)
