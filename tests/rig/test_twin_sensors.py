"""Encoder and replies: what they show, how old it is and how wrong."""

from math import pi

import numpy as np
import pytest

from equipoise.model.arms.iiwa import iiwa
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.worlds import TwinSettings
from equipoise.worlds.twin.twin import HISTORY_MS, Twin, encoder_zero

PENDULUM = PendulumParameters(w2=70.2, k=7.16, c=0.15)
EXACT = TwinSettings(
    zero_error=0.0, encoder_age=0.0, encoder_jitter=0.0, reply_age=0.0, joint_noise=0.0
)


def test_the_zero_error_differs_between_trials_within_its_bounds():
    settings = EXACT.model_copy(update={"zero_error": 0.01, "zero_offset": 0.1})
    zeros = np.array([encoder_zero(settings, 5, i) for i in range(500)]) - 0.1
    assert np.all(np.abs(zeros) <= 0.01)
    # Even in +-0.01: mean 0, standard deviation 0.0058; 500 of them.
    assert np.mean(zeros) == pytest.approx(0.0, abs=5 * 0.0058 / np.sqrt(500))
    assert np.std(zeros) == pytest.approx(0.01 / np.sqrt(3), rel=0.1)
    assert encoder_zero(settings, 5, 3) == encoder_zero(settings, 5, 3)
    assert encoder_zero(settings, 6, 3) != encoder_zero(settings, 5, 3)


@pytest.mark.parametrize(("age", "ticks"), [(0.0, 0), (0.001, 1), (0.0042, 5), (0.05, 50)])
def test_a_sample_is_known_when_it_is_old_enough(age, ticks):
    settings = EXACT.model_copy(update={"encoder_age": age, "reply_age": age})
    twin = Twin(iiwa(7), PENDULUM, settings)
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


def test_measured_joints_carry_white_noise_of_the_stated_size():
    settings = EXACT.model_copy(update={"joint_noise": 1e-4})
    twin = Twin(iiwa(7), PENDULUM, settings, seed=3, index=4)
    twin.state.past_q[:] = np.arange(6)
    rows = np.zeros((2000, 6))
    for tick in range(2000):
        twin.state.now = tick
        rows[tick], _ = twin.measured()
    noise = (rows - np.arange(6)) / 1e-4
    assert np.mean(noise, axis=0) == pytest.approx(np.zeros(6), abs=5 / np.sqrt(2000))
    assert np.std(noise, axis=0) == pytest.approx(np.ones(6), abs=5 / np.sqrt(4000))
    together = np.corrcoef(np.vstack([noise[1:].T, noise[:-1].T]))
    assert np.max(np.abs(together - np.eye(12))) < 5 / np.sqrt(2000)
