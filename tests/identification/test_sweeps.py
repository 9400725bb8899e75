"""Identification over many swings: no valid one is refused, and the intervals keep their word."""

import os
from math import exp, log, pi, radians, sqrt
from pathlib import Path

import numpy as np
import pytest

from equipoise.identification.recording import Trajectory, read_swing, simulate_swing
from equipoise.identification.swing import identify
from equipoise.model.pendulum import PendulumParameters

DATA = os.environ.get("EQUIPOISE_DATA")
needs_recordings = pytest.mark.skipif(
    not DATA, reason="EQUIPOISE_DATA does not name the folder of real recordings"
)
pytestmark = pytest.mark.compiled_only


# Recordings.


RECORDED = [
    # name, when the hand has let go [s], last start [s] (two periods are left), length of a
    # window [s], w2 [1/s^2], largest relative difference (a short window at small amplitude)
    ("free_swing_furuta_01.csv", 0.544, 3.85, 5.0, 120.0, 6e-3),
    ("free_swing_furuta_03.csv", 0.286, 3.85, 5.0, 120.0, 8e-3),
    ("gyro_wheel.csv", 0.0, 1.75, 5.0, 19.38, 3e-3),
    ("free_swing_arm_55s.csv", 0.0, 51.0, 4.0, 64.07, 3e-3),
]


@needs_recordings
@pytest.mark.parametrize(("name", "free_from", "last", "length", "w2", "within"), RECORDED)
def test_no_start_of_a_recorded_swing_is_refused(name, free_from, last, length, w2, within):
    for start in np.linspace(free_from, last, 4):
        pendulum = identify(read_swing(Path(DATA) / name, start=start, end=start + length))
        assert pendulum.w2.value == pytest.approx(w2, rel=within), f"from {start:.3f} s"


# Simulated swings.


def any_swing(seed):
    """Return a swing of 100 to 175 deg from anywhere in its first periods, and its w2 and c.

    c is None where dry friction is among the truth.
    """
    rng = np.random.default_rng([77, seed])
    w2, c = rng.uniform(25.0, 140.0), exp(rng.uniform(log(0.01), log(0.6)))
    period = 2.0 * pi / sqrt(w2)
    coulomb = rng.choice([0.0, rng.uniform(0.0, 2.0) * w2 / 120.0])
    swing = simulate_swing(
        PendulumParameters(w2, 0.0, c, coulomb),
        theta0=radians(rng.uniform(100.0, 175.0)) * rng.choice([-1.0, 1.0]),
        duration=rng.uniform(6.5, 14.5) * period,
        rate_hz=exp(rng.uniform(log(100.0), log(1000.0))),
        counts_per_rev=int(rng.choice([400, 600, 1000, 2000, 4096, 8192, 16384])),
        noise=radians(rng.choice([0.0, 0.02, 0.1, 0.3])),
        zero_offset=rng.uniform(-0.3, 0.3),
        seed=seed,
    )
    kept = swing.time >= rng.choice([0.0, rng.uniform(0.0, 2.5 * period)])
    recorded = Trajectory(
        time=swing.time[kept],
        theta=swing.theta[kept],
        resolution=swing.resolution,
        source=f"swing {seed}",
        released=bool(rng.uniform() < 0.6),
    )
    return recorded, w2, None if coulomb else c


def test_no_simulated_swing_of_100_to_175_degrees_is_refused():
    for seed in range(15):
        recorded, w2, c = any_swing(seed)
        pendulum = identify(recorded)
        # Viscous friction in place of dry one costs a percent of w2; coarse counts 0.1 %.
        assert abs(pendulum.w2.value / w2 - 1.0) < (0.02 if c is None else 1e-3), recorded.source


# Intervals.


def coverage(swings):
    """Return how often the 95 % intervals of w2 and c hold the truth."""
    hits = np.zeros(2)
    for seed in range(swings):
        rng = np.random.default_rng([2024, seed])
        truth = PendulumParameters(
            w2=70.2 * rng.uniform(0.8, 1.2), k=0.0, c=0.15 * rng.uniform(0.5, 2.0)
        )
        swing = simulate_swing(
            truth,
            theta0=rng.uniform(0.4, 2.9),
            duration=8.0,
            # Below and above the rate from which means are fitted.
            rate_hz=float(rng.choice([250.0, 1000.0])),
            counts_per_rev=4096,
            noise=radians(0.05),
            zero_offset=rng.uniform(-0.3, 0.3),
            seed=seed,
        )
        pendulum = identify(swing)
        hits += [
            pendulum.w2.low <= truth.w2 <= pendulum.w2.high,
            pendulum.c.low <= truth.c <= pendulum.c.high,
        ]
    return hits / swings


def test_the_intervals_cover_the_truth_of_some_simulated_swings():
    # Of 25 intervals at 95 %, fewer than 19 hold the truth with a probability of 2e-4.
    assert np.all(coverage(25) >= 19 / 25)
