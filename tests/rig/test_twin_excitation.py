"""The excitation: safe for the arm, rich for the identification; and its record."""

import numpy as np
import pytest

from equipoise.errors import ArmError
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import TwinSettings
from equipoise.worlds.twin.excitation import PERIOD, excitation, excite
from equipoise.worlds.twin.twin import Twin

PENDULUM = PendulumParameters(w2=70.2, k=7.16, c=0.15)


@pytest.mark.parametrize("size", [7, 14])
@pytest.mark.parametrize("duration", [3.0, 10.0])
def test_it_starts_and_ends_at_rest_at_home_and_keeps_within_the_limits(size, duration):
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
    places = np.array([arm.pose(row).position for row in q[::10]]) - arm.pose(q[0]).position
    assert np.abs(places).max() < 0.05


@pytest.mark.parametrize("size", [7, 14])
def test_every_joint_moves_slowly_and_fast_and_in_its_own_way(size):
    velocity = np.diff(excitation(iiwa(size)), axis=0) / PERIOD
    for i, column in enumerate(velocity.T):
        speed = np.abs(column)
        assert speed.max() > (0.29 if i < 3 else 0.94)
        # The window makes every amplitude: a tenth of the time below 0.05, much of it above 0.1.
        assert np.mean(speed < 0.05) > 0.1
        assert np.mean(speed > 0.1) > 0.2
    assert np.abs(np.corrcoef(velocity.T) - np.eye(6)).max() < 0.45


@pytest.mark.compiled_only
@pytest.mark.parametrize("size", [7, 14])
@pytest.mark.parametrize(
    "changed", [{}, {"lag": 0.004}, {"inner": "pd"}, {"inner": "trajectory40"}], ids=str
)
def test_no_torque_ends_at_its_limit_and_the_pendulum_hangs(size, changed):
    arm = iiwa(size)
    twin = Twin(arm, PENDULUM, TwinSettings(**changed))
    swung = []
    for q in excitation(arm):
        twin.send(q)
        twin.advance(PERIOD)
        swung.append(np.pi - twin.data.qpos[7])
    assert twin.saturated <= (2 if "lag" in changed else 0)  # of 10,000 ms
    assert np.abs(swung).max() < np.radians(50.0)


def test_a_home_close_to_a_limit_is_refused():
    arm = iiwa(7)
    home = list(arm.home)
    home[6] = arm.joints[6].upper - 0.05
    with pytest.raises(ArmError, match="excitation takes A7 from .* choose a home further inside"):
        excitation(arm.model_copy(update={"home": tuple(home)}))


def test_the_record_holds_what_was_sent_and_what_came_back():
    settings = TwinSettings(joint_noise=0.0)
    arm = iiwa(7)
    record = excite(arm, settings, PENDULUM, seed=1, duration=2.0)
    count = round(2.0 / PERIOD) + 1
    assert record.stream_time == pytest.approx(PERIOD * np.arange(count))
    assert np.array_equal(record.stream_q, excitation(arm, duration=2.0))
    assert record.reply_time == pytest.approx(record.stream_time)
    assert np.abs(record.encoder_time - (record.stream_time + 0.004)).max() < 3.1e-4
    # The arm follows: late by transport and servo, some 30 ms.
    late = np.array([np.interp(record.reply_time - 0.03, record.stream_time, column)
                     for column in record.stream_q.T]).T  # fmt: skip
    moved = np.abs(record.stream_q - arm.home_free).max(axis=0)
    assert np.all(np.abs(record.reply_q - late).max(axis=0)[:5] < 0.3 * moved[:5])
    again = excite(arm, settings, PENDULUM, seed=1, duration=2.0)
    assert all(np.array_equal(a, b) for a, b in zip(record, again, strict=True))
