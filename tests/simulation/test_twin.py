"""The twin as a whole: against closed forms, SciPy, MuJoCo, `identify` and itself."""

from math import pi

import mujoco
import numpy as np
import pytest

from equipoise import PendulumParameters, iiwa
from equipoise.identification.actuator import PERIOD, excitation
from equipoise.model.worlds import TwinSettings
from equipoise.settings import GRAVITY
from equipoise.simulation.twin.physics import TICK
from equipoise.simulation.twin.twin import HISTORY_MS, Twin, reset
from tests.reference import pendulum as reference

ARM = iiwa(7)
PENDULUM = PendulumParameters(w2=70.2, k=70.2 / GRAVITY, c=0.15)
# An arm that does not yield: what the pendulum does to it is another matter.
# No file of a world may say so, therefore the copy without validation.
FIRM = TwinSettings().model_copy(update={"rotor_inertia": (1e4,)})


def swing(theta, steps):
    """theta of a pendulum let go at rest, each 10 ms for 3 s, of so many steps a millisecond."""
    twin = Twin(ARM, PENDULUM, FIRM)
    twin.model.opt.timestep = TICK / steps
    twin.reset(phi=np.pi - theta)
    angles = [theta]
    for _ in range(300):
        twin.advance(10 * steps * TICK)
        angles.append(np.pi - twin.data.qpos[7])
    return np.array(angles)


@pytest.mark.parametrize("theta", [0.1, 1.2, 2.8])
def test_a_free_swing_is_that_of_the_equation(theta):
    time = np.arange(0, 3.0005, 0.01)
    exact, _ = reference.swing(time, theta, 0.0, w2=PENDULUM.w2, c=PENDULUM.c)
    rate = np.abs(np.gradient(exact, time)).max()
    errors = [np.abs(swing(theta, steps) - exact).max() for steps in (1, 2)]
    # The engine's steps are of first order: they are half a step late.
    assert errors[0] < TICK * rate
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.15)


def test_the_truth_is_what_mujoco_says_of_the_bodies():
    twin = Twin(ARM, PENDULUM, TwinSettings(), seed=2)
    twin.reset(ARM.home_free + 0.05, phi=0.4, phi_dot=1.0)
    for row in excitation(ARM, duration=1.0)[:120]:
        twin.send(row + 0.05)
        twin.advance(0.005)
    model, data, real = twin.model, mujoco.MjData(twin.model), twin.truth()
    data.qpos[:], data.qvel[:] = twin.data.qpos, twin.data.qvel
    mujoco.mj_forward(model, data)
    velocity = np.zeros(6)
    kind = mujoco.mjtObj.mjOBJ_XBODY
    flange, rod = model.body("flange").id, model.body("pendulum").id
    mujoco.mj_objectVelocity(model, data, kind, flange, velocity, 0)
    home_x = ARM.kinematics(ARM.home_free).position[0]
    assert real.x == pytest.approx(data.xpos[flange, 0] - home_x, abs=1e-12)
    assert real.x_dot == pytest.approx(velocity[3], abs=1e-12)
    assert abs(real.x_dot) > 0.01

    def phi_after(seconds):
        q = data.qpos.copy()
        mujoco.mj_integratePos(model, q, data.qvel, seconds)
        later = mujoco.MjData(model)
        later.qpos[:] = q
        mujoco.mj_kinematics(model, later)
        x, _, z = later.xmat[rod].reshape(3, 3)[:, 2]
        return np.arctan2(x, z)

    assert real.phi == pytest.approx(phi_after(0.0), abs=1e-12)
    assert real.phi_dot == pytest.approx((phi_after(1e-5) - phi_after(-1e-5)) / 2e-5, rel=1e-6)
    # In space, not relative to the flange, which is tilted by now.
    assert abs(real.phi - twin.data.qpos[7]) > 1e-3


@pytest.mark.parametrize(
    ("phi", "phi_dot", "moved", "beyond", "sticks"),
    [
        (0.3, 0.5, 0.02, -1.0, False),  # the pendulum slides
        (np.pi - 0.003, 0.0, 0.0, -1.0, True),  # it sticks
        (np.pi - 0.1, -0.1, 0.02, -1.0, False),  # it turns back
        (0.3, 0.5, 0.02, 0.002, False),  # a joint is beyond its range
    ],
)
def test_a_millisecond_is_a_whole_step_of_mujoco(phi, phi_dot, moved, beyond, sticks):
    pendulum = PENDULUM._replace(coulomb=0.5, drag=0.02)
    twin = Twin(ARM, pendulum, TwinSettings(), seed=2)
    state, data = twin.state, twin.data
    whole, n = mujoco.MjData(twin.model), len(ARM.joints)
    posture = np.array(ARM.home)
    posture[5] = max(posture[5], ARM.joints[5].upper + beyond)
    reset(twin.state, twin.args[1][0], posture, phi, phi_dot)
    twin.send(np.array(ARM.without_held(posture)) + moved)
    ends, friction = 0, []
    for _ in range(40):
        whole.qpos[:], whole.qvel[:], before = data.qpos, data.qvel, state.gravity.copy()
        twin.advance(TICK)
        # The torques now balance the gravity at the end of the millisecond.
        whole.qfrc_applied[:n] = data.qfrc_applied[:n] - state.gravity + before
        mujoco.mj_step(twin.model, whole)
        assert twin.data.qpos == pytest.approx(whole.qpos, abs=1e-13)
        assert twin.data.qvel == pytest.approx(whole.qvel, abs=1e-11)
        assert twin.data.qacc == pytest.approx(whole.qacc, abs=1e-8)
        friction.append(abs(whole.efc_force[0]) / twin.model.dof_frictionloss[n])
        ends += whole.nefc - 1
    assert (min(friction) < 0.99) == sticks
    assert (ends > 0) == (beyond > 0.0)


# Encoder and replies


@pytest.mark.parametrize(("age", "ticks"), [(0.0, 0), (0.001, 1), (0.0042, 5), (0.05, 50)])
def test_a_sample_is_known_when_it_is_old_enough(age, ticks):
    exact = {"zero_error": 0.0, "encoder_jitter": 0.0, "joint_noise": 0.0}
    settings = TwinSettings(encoder_age=age, reply_age=age, **exact)
    twin = Twin(ARM, PENDULUM, settings)
    state, now = twin.state, 1000
    state.now = now
    for tick in range(now - HISTORY_MS + 1, now + 1):
        state.past_phi[tick % HISTORY_MS] = pi - (tick - 900) * 2 * pi / 8192
        state.past_q[tick % HISTORY_MS] = tick + 0.1 * np.arange(6)
    counts, counted = twin.encoder()
    q, measured = twin.measured()
    assert counts == now - ticks - 900
    assert counted == measured == pytest.approx(1e-3 * (now - ticks))
    assert q == pytest.approx(now - ticks + 0.1 * np.arange(6))


@pytest.mark.parametrize(("size", "duration"), [(7, 10.0), (14, 3.0)])
def test_the_excitation_starts_and_ends_at_rest_at_home_and_keeps_within_the_limits(size, duration):
    arm = iiwa(size)
    q = excitation(arm, duration=duration)
    assert q.shape == (round(duration / PERIOD) + 1, 6)
    assert q[[0, -1]] == pytest.approx(np.array([arm.home_free] * 2), abs=1e-12)
    velocity = np.diff(q, axis=0) / PERIOD
    acceleration = np.diff(velocity, axis=0) / PERIOD
    assert np.abs(velocity[[0, -1]]).max() < 0.01
    for i, joint in enumerate(arm.free_joints):
        assert np.abs(velocity[:, i]).max() < 0.81 * joint.velocity
        assert np.abs(acceleration[:, i]).max() < 0.81 * joint.acceleration
    places = np.array([arm.kinematics(row).position for row in q[::10]])
    assert np.abs(places - places[0]).max() < 0.05
