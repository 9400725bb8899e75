"""The bench: a twin whose time passes as a clock's, with a body, a hand and faults."""

import numpy as np
import pytest

from equipoise import PendulumParameters, iiwa
from equipoise.model.worlds import TwinSettings
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.simulated_rig import Bodies, SimulatedRig
from equipoise.settings import GRAVITY
from equipoise.simulation.twin.twin import FLANGE, Twin

ARM = iiwa(7)
PENDULUM = PendulumParameters(w2=70.2, k=70.2 / GRAVITY, c=0.15)
NOMINAL = TwinSettings()


def stand(seed=0, **more):
    """Return a rig in this process and its clock, in virtual time."""
    clock = VirtualClock()
    bench = SimulatedRig(Bodies(ARM, PENDULUM, NOMINAL, ARM.home_free, 0.0, seed), **more)
    clock.attach(bench.advance)
    return bench, clock


def wait(clock, seconds):
    clock.wait_until(clock.now() + seconds)


def shown(bench):
    return np.array(bench.body.measured())


def test_with_the_hand_off_it_is_the_twin_bit_by_bit():
    bench, clock = stand(phi=2.0)
    twin = Twin(ARM, PENDULUM, NOMINAL)
    twin.reset(phi=2.0)
    for _ in range(20):
        wait(clock, 0.05)
        twin.advance(0.05)
        assert bench.now == pytest.approx(twin.now)
        assert bench.twin.truth() == twin.truth()
        assert np.array_equal(bench.twin.data.qpos, twin.data.qpos)


# The body.


def swept(bench, clock, until):
    """Sweep joint 1 at 0.5 rad/s."""
    bench.body.servo(True)
    q = shown(bench)
    for i in range(round(until / 0.005)):
        bench.body.target(q + np.eye(7)[0] * 0.0025 * i)
        wait(clock, 0.005)
    return q


def test_what_stops_it_brakes_it_at_once_and_it_obeys_nothing_until_set_free():
    bench, clock = stand()
    swept(bench, clock, 0.5)
    speed = bench.twin.data.qvel[0]
    assert speed == pytest.approx(0.5, rel=0.3)
    bench.body.stop("emergency stop")
    there = shown(bench)
    wait(clock, 0.3)
    assert np.abs(bench.twin.data.qvel[:7]).max() < 0.05
    assert 0.0 < shown(bench)[0] - there[0] < 0.02
    there = shown(bench)
    bench.body.target(there + 0.1)
    bench.body.servo(True)
    assert not bench.body.running
    bench.body.target(there + 0.1)
    wait(clock, 0.3)
    assert np.abs(shown(bench) - there).max() < 5e-3
    bench.body.set_free()
    bench.body.servo(True)
    bench.body.target(there + 0.02)
    wait(clock, 0.3)
    assert shown(bench)[0] - there[0] == pytest.approx(0.02, abs=3e-3)


def test_external_torques_are_those_of_what_hangs_on_the_flange_and_of_what_presses_on_it():
    bench, clock = stand()
    wait(clock, 0.5)
    at_rest = np.array(bench.body.torques(True))
    data = bench.twin.data
    # A weight at the flange, by the lever arms of the axes: joint 1 is vertical, joint 2 lies
    # across at the shoulder, joint 4 at the elbow.
    weight = GRAVITY * (NOMINAL.bracket_mass + NOMINAL.pendulum_mass)
    assert abs(at_rest[0]) < 0.2
    assert at_rest[1] == pytest.approx(weight * data.xpos[FLANGE, 1], abs=0.4)
    bench.touch((0.0, 0.0, -20.0))
    wait(clock, 0.2)
    pressed = np.array(bench.body.torques(True)) - at_rest
    mujoco, model = pytest.importorskip("mujoco"), bench.twin.model
    J = np.zeros((3, 8))
    mujoco.mj_jacBodyCom(model, data, J, None, model.body("flange").id)
    assert pressed == pytest.approx(J[2, :7] * -20.0, abs=0.4)
    bench.touch((0.0, 0.0, 0.0))
    wait(clock, 0.5)
    assert np.array(bench.body.torques(True)) == pytest.approx(at_rest, abs=0.4)


# The hand.


def recorded(bench, clock, seconds):
    """phi in space, each millisecond [rad]."""
    angles = []
    for _ in range(round(1000 * seconds)):
        clock.wait_until(clock.now() + 0.001)
        angles.append(bench.twin.truth().phi)
    return np.array(angles)


@pytest.mark.parametrize(("side", "sign"), [("front", 1), ("back", -1)])
def test_the_hand_lifts_from_its_side_and_holds_upright_within_its_tremor(side, sign):
    bench, clock = stand(seed=11)
    clock.wait_until(0.2)
    manner = bench.lift(side=side)
    lifting = recorded(bench, clock, manner.lifting)
    middle = lifting[len(lifting) // 4 : -len(lifting) // 4]
    assert (sign * middle > 0).all()
    held = recorded(bench, clock, 8.0)
    assert bench.hand.holds
    # Sum of all amplitudes, and the grip's yielding.
    assert np.abs(held).max() < manner.amplitude.sum() + np.radians(0.2)
    quick = held - np.convolve(held, np.ones(500) / 500, mode="same")
    rms = np.std(quick[500:-500])
    assert rms == pytest.approx(np.sqrt(np.sum(manner.amplitude[:-2] ** 2) / 2), rel=0.25)


def test_a_pendulum_released_cleanly_falls_freely_and_no_force_remains():
    for seed in range(2):
        bench, clock = stand(seed=seed)
        manner = bench.lift()
        clock.wait_until(manner.lifting + 2.0)
        before = bench.twin.truth()
        bench.let_go()
        clock.wait_until(clock.now() + manner.opening + 0.002)
        assert bench.hand.idle
        assert not bench.twin.data.xfrc_applied.any()
        after = bench.twin.truth()
        # Nothing was thrown: the rate is still that of a tremor, or of the fall from there.
        allowed = abs(before.phi_dot) + PENDULUM.w2 * 0.1 * manner.opening + np.radians(8)
        assert abs(after.phi_dot) < allowed
        clock.wait_until(clock.now() + 0.6)
        assert abs(bench.twin.truth().phi) > np.radians(1.0)
