"""Numbers of the mechanism: masses, period, load, and what robot and twin take from them."""

from math import pi

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import checks
import make
import parts
from design import STEEL, Design
from equipoise.arm.urdf import read_arm
from equipoise.model.pendulum import Pendulum, shipped_pendulum
from equipoise.model.worlds import read_world
from equipoise.paper import FREE_SWING_PERIOD, U_MAX
from equipoise.rig.config import RigSettings, read_rig
from equipoise.settings import GRAVITY
from equipoise.simulation.twin.physics import build as build_twin
from mechanism import build
from stiffness import mesh


def test_masses_and_inertias_are_those_of_the_triangles(mechanism):
    """An independent integral: trimesh over the surface, OpenCascade over the solid."""
    for name in ("base", "bearing_block", "encoder_plate", "hub", "rod", "spindle"):
        (body,) = (one for one in mechanism.bodies if one.name == name)
        triangles = mesh(mechanism.solids[name])
        triangles.density = body.mass / triangles.volume
        assert body.centre == pytest.approx(1e-3 * triangles.center_mass, abs=5e-5)
        inertia = 1e-6 * triangles.moment_inertia
        assert np.abs(body.inertia - inertia).max() < 0.01 * np.abs(inertia).max()


def test_the_rod_is_a_uniform_rod(design, mechanism):
    (rod,) = (one for one in mechanism.bodies if one.name == "rod")
    length, radius = 1e-3 * mechanism.rod_length, 0.5e-3 * design.rod
    mass = STEEL * pi * radius**2 * length
    assert rod.mass == pytest.approx(mass, rel=3e-3)  # chamfers and the catch wire's hole
    across = mass * (length**2 / 12.0 + radius**2 / 4.0)
    assert rod.inertia[0, 0] == pytest.approx(across, rel=1e-2)


def test_sums_do_not_depend_on_their_order(mechanism):
    whole = sum(one.mass for one in mechanism.bodies)
    assert mechanism.holder.mass + mechanism.pendulum.mass == pytest.approx(whole)
    centre = sum(one.mass * one.centre for one in mechanism.bodies) / whole
    parts_ = (mechanism.holder, mechanism.pendulum)
    assert sum(one.mass * one.centre for one in parts_) / whole == pytest.approx(centre)


def test_the_pendulum_has_the_papers_period(mechanism):
    assert mechanism.period == pytest.approx(FREE_SWING_PERIOD, rel=0.01)
    # The program's own pendulum: the policy that ships is for it.
    assert mechanism.w2 == pytest.approx(shipped_pendulum().w2.value, rel=0.005)


def test_a_swing_of_the_designed_bodies_has_that_period(mechanism):
    """Integrated from mass, centre and inertia of every part, with nothing of this folder."""
    pivot = mechanism.pivot
    turning = ("spindle", "inner collar", "outer collar", "spacer", "hub", "rod")
    bodies = [
        one for one in mechanism.bodies if one.name in turning or one.name.startswith("screw hub")
    ]
    inertia = sum(
        one.inertia[0, 0] + one.mass * np.sum((one.centre - pivot)[1:] ** 2) for one in bodies
    )

    def slope(_, state):
        theta, rate = state
        c, s = np.cos(theta), np.sin(theta)
        moment = 0.0
        for one in bodies:
            y, z = (one.centre - pivot)[1:]
            moment -= one.mass * GRAVITY * (z * s + y * c)  # gravity along Z, turned by theta
        return [rate, moment / inertia]

    def crosses(_, state):
        return state[1]

    crosses.direction = -1.0
    swing = solve_ivp(slope, (0.0, 8.0), [0.02, 0.0], events=crosses, rtol=1e-9, atol=1e-12)
    turns = swing.t_events[0]
    assert np.mean(np.diff(turns[1:])) == pytest.approx(FREE_SWING_PERIOD, rel=0.01)


@pytest.mark.parametrize("period", [0.5, 0.6, 1.0, 1.5])
def test_another_period_is_one_parameter(period):
    other = build(Design(period=period))
    assert other.period == pytest.approx(period, rel=0.01)
    # The rod reaches through both screws of its clamp, and its hole for the catch wire.
    assert other.design.rod_start + other.rod_length > other.design.catch_at + 5.0


def test_shared_numbers_are_those_of_the_program(mechanism):
    arm = read_arm("iiwa7")
    assert 1e-3 * mechanism.design.pivot_outward == pytest.approx(np.hypot(*arm.pivot[:2]))
    assert RigSettings().counts_per_rev == 4 * 2048  # DIP switches of the AMT102 all at zero


# What is written for robot and twin.


@pytest.mark.parametrize("name", make.RIGS)
def test_the_rig_file_has_the_designs_pivot_and_load(name, mechanism, tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(make.rig_toml(read_arm(name), mechanism))
    rig = read_rig(path)
    arm = rig.described_arm
    load = rig.load
    assert load is not None
    assert load.mass == pytest.approx(mechanism.load.mass, abs=1e-3)
    home = arm.kinematics(arm.home_free)
    own = read_arm(name)
    # The same side as the arm's own pivot, and lower by the height of the design.
    shift = home.rotation @ (np.array(arm.pivot) - own.pivot)
    assert shift == pytest.approx([0.0, 0.0, -1e-3 * mechanism.design.pivot_down], abs=1e-9)
    # The load hangs between flange and pivot.
    outward = home.rotation @ load.centre
    assert 0.0 < outward[1] < 1e-3 * mechanism.design.pivot_outward
    assert outward[2] < 0.0
    assert rig.counts_per_rev == 8192


def twin(mechanism, folder):
    path = folder / "twin.toml"
    path.write_text(make.twin_toml(mechanism))
    return read_world(f"twin:{path}").settings


def test_the_twins_rod_reacts_on_the_arm_like_the_designed_pendulum(mechanism, tmp_path):
    """Both compound pendulums, hanging, their pivots accelerated: the same force for each."""
    settings = twin(mechanism, tmp_path)
    pendulum = Pendulum.assumed(mechanism.w2, 0.0)
    model = build_twin(read_arm("iiwa7"), pendulum.parameters(), settings)
    rod = model.body("pendulum")
    m, l = rod.mass[0], np.linalg.norm(rod.ipos)
    designed = mechanism.pendulum.mass * mechanism.length
    assert m * l == pytest.approx(designed, rel=1e-3)
    # About the pivot, both need the same moment for an angular acceleration.
    about_pivot = rod.inertia.max() + m * l**2
    assert about_pivot == pytest.approx(mechanism.inertia, rel=5e-3)
    whole = settings.bracket_mass + settings.pendulum_mass
    assert whole == pytest.approx(mechanism.load.mass, abs=1e-3)


def test_the_twin_swings_with_the_designed_period(mechanism, tmp_path):
    settings = twin(mechanism, tmp_path)
    pendulum = Pendulum.assumed(mechanism.w2, 0.0).parameters()
    model = build_twin(read_arm("iiwa7"), pendulum, settings)
    data = mujoco.MjData(model)
    arm = read_arm("iiwa7")
    data.qpos[:] = [*arm.home, pi + 0.02]
    model.dof_armature[:-1] = 1e6  # the arm stands still
    crossings, before = [], 0.02
    for tick in range(4000):
        mujoco.mj_step(model, data)
        angle = data.qpos[-1] - pi
        if before > 0.0 >= angle:
            crossings.append((tick + 1 - angle / (angle - before)) * 1e-3)
        before = angle
    assert np.mean(np.diff(crossings)) == pytest.approx(FREE_SWING_PERIOD, rel=0.01)


# The robot carries it.


@pytest.mark.parametrize("name", checks.ARMS)
def test_arms_carry_the_load_with_a_tenth_of_their_torque(name, mechanism):
    assert mechanism.load.mass < 0.2 * checks.ARMS[name]
    assert checks.torque_fraction(read_arm(name), mechanism) < 0.1


def test_the_torque_of_the_load_is_that_of_its_weight(mechanism):
    """By virtual work: the load's height and place change with each joint."""
    arm = read_arm("iiwa14")
    lever = checks.base_rotation(arm) @ mechanism.load.centre

    def work(q):
        now = arm.kinematics(q)
        place = now.position + now.rotation @ lever
        return mechanism.load.mass * (place @ [U_MAX, 0.0, GRAVITY])

    step, fractions = 1e-6, []
    for number, joint in enumerate(arm.free_joints):
        aside = step * np.eye(6)[number]
        torque = (work(arm.home_free + aside) - work(arm.home_free - aside)) / (2.0 * step)
        fractions.append(abs(torque) / joint.torque)
    assert max(fractions) == pytest.approx(checks.torque_fraction(arm, mechanism), rel=1e-6)


def test_a_loose_rod_would_fly_within_the_keep_out_circle(mechanism):
    """Stated in README: 2.7 turns a second, falling from upright, release at the worst place."""
    rate = (4.0 * mechanism.w2) ** 0.5  # from rest upright to hanging, without friction
    speed = rate * mechanism.reach
    assert 3.0 < speed < 4.0
    height = 0.85  # of the pivot over the floor, on a table [m]
    # Range of a throw at 45 degrees from that height.
    v = speed / 2**0.5
    flight = (v + (v**2 + 2.0 * GRAVITY * height) ** 0.5) / GRAVITY
    assert v * flight < 2.0


def test_the_clamp_holds_the_rod_with_a_large_margin(mechanism, design):
    rate2 = 4.0 * mechanism.w2
    (rod,) = (one for one in mechanism.bodies if one.name == "rod")
    pull = rod.mass * ((rod.centre - mechanism.pivot)[2] * rate2 + GRAVITY)
    screws, preload, friction = len(design.hub_rod_screws), 1000.0, 0.15
    # 1 kN from an M4 at 1 N m; both halves press on the rod, an hinge takes half of it.
    assert pull < 0.1 * screws * preload * friction
    assert parts.reach(design, mechanism.rod_length) < 220.0
