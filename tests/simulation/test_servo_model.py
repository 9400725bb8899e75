"""The servo: when setpoints arrive, and how the joints follow them."""

import numpy as np
import pytest

from equipoise import PendulumParameters, iiwa
from equipoise.arrays import fields, new_records
from equipoise.identification.actuator import excitation
from equipoise.model.actuator import Servos, follow, lag_fraction
from equipoise.model.worlds import POSITION_DRIVES, TwinSettings
from equipoise.simulation.twin.physics import TICK
from equipoise.simulation.twin.servo_model import equivalent_actuator, new_servo, send, serve, start
from equipoise.simulation.twin.twin import Twin

ARM = iiwa(7)
PENDULUM = PendulumParameters(w2=70.2, k=7.16, c=0.15)
AT_ONCE = TwinSettings(transport=0.0, transport_jitter=0.0)
UNLOADED = AT_ONCE.model_copy(update={"bracket_mass": 0.0, "pendulum_mass": 1e-9})


@pytest.mark.parametrize("cycle_ms", [1, 2, 4])
def test_the_servo_follows_new_setpoints_once_per_cycle(cycle_ms):
    servo = new_servo(ARM, AT_ONCE.model_copy(update={"cycle": 1e-3 * cycle_ms}))
    q, force, speeds = np.zeros(7), np.zeros(7), []
    start(servo, q)
    for ms in range(12):
        send(servo, np.full(7, 1e-3 * (ms + 1)), ms, 0, 0)
        serve(servo, ms, q, q, q, force)
        speeds.append(servo.velocity[0])
    assert (np.flatnonzero(np.diff(speeds)) + 1).tolist() == list(range(cycle_ms, 12, cycle_ms))


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"cycle": 0.002, "lag": 0.016},
        POSITION_DRIVES | {"shaped": False},
        {"reach_time": 0.040},
    ],
    ids=str,
)
def test_an_arm_without_load_moves_as_the_equivalent_actuator(changes):
    settings = UNLOADED.model_copy(update=changes)
    twin = Twin(ARM, PENDULUM, settings)
    setpoints = excitation(ARM, duration=2.0)
    found = equivalent_actuator(settings)
    model = found.parameters
    servos = new_records(Servos)
    servos["q"], servos["fraction"] = ARM.home_free[:, None], lag_fraction(found.lags[0].value)
    apart = []
    for row in setpoints:
        twin.send(row)
        servos["target"] = row[:, None]
        for _ in range(5):
            twin.advance(TICK)
            follow(fields(servos, Servos), model, 0, 1)
            apart.append(twin.data.qpos[twin.state.free] - servos["q"][0, :, 0])
    # Off home the mass matrix is another than the drives': joints shake each other a little.
    assert np.max(np.abs(apart)) < 1e-3
    assert np.sqrt(np.mean(np.square(apart))) < 2e-4


def test_torques_end_at_what_the_joints_can_give_with_the_arms_weight_in_it():
    twin = Twin(ARM, PENDULUM, AT_ONCE)
    q = ARM.home_free
    q[1] += 0.5
    twin.send(q)
    limits = np.array([joint.torque for joint in ARM.joints])
    largest = np.zeros(7)
    for _ in range(50):
        twin.advance(TICK)
        servo = twin.state.servo
        # The engine has moved on since: the arm's weight is that of a millisecond later.
        on_links = twin.data.qfrc_applied[:7] - servo.rotors * servo.ddq
        largest = np.maximum(largest, np.abs(on_links))
    assert np.all(largest <= limits * 1.02)
    assert largest[1] > 0.98 * limits[1]
