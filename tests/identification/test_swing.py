"""Identification: against fits of real recordings made apart, and against known truths.

The reference values of the real recordings come with them (README of the data folder); they were
found with another program, and each has its standard error, block-robust over periods.
"""

import os
from contextlib import suppress
from dataclasses import replace
from math import pi, radians, sqrt
from pathlib import Path

import numpy as np
import pytest

from equipoise.artefacts import Estimate
from equipoise.errors import RecordingError
from equipoise.identification import fit as fitting
from equipoise.identification.fitted import fitted_curve
from equipoise.identification.recording import Trajectory, read_swing, simulate_swing
from equipoise.identification.swing import identify
from equipoise.model.pendulum import Pendulum, PendulumParameters
from equipoise.settings import IdentificationSettings
from tests.reference import pendulum as reference

DATA = os.environ.get("EQUIPOISE_DATA")
compiled = pytest.mark.skipif(
    os.environ.get("NUMBA_DISABLE_JIT", "0") != "0",
    reason="slow without compilation; the others run the same lines",
)
needs_recordings = pytest.mark.skipif(
    not DATA, reason="EQUIPOISE_DATA does not name the folder of real recordings"
)

PENDULUM = PendulumParameters(w2=70.2, k=7.15, c=0.15)
PERIOD = 2.0 * pi / sqrt(70.2)


def recording(name, **window):
    return read_swing(Path(DATA) / name, **window)


def simulated(parameters=PENDULUM, **changes):
    options = {
        "theta0": 1.0,
        "duration": 3.0,
        "rate_hz": 250.0,
        "counts_per_rev": 4096,
        "noise": radians(0.05),
        "seed": 1,
    }
    return simulate_swing(parameters, **{**options, **changes})


def with_friction(model):
    return IdentificationSettings(friction=model)


def overlaps(estimate, value, error):
    """Tell whether a 95 % interval meets the reference's."""
    return estimate.low <= value + 1.96 * error and estimate.high >= value - 1.96 * error


# Real recordings.

ARM = "free_swing_arm_55s.csv"
VISCOUS_WINDOWS = [
    # window, w2, its error, c, its error, RMS [deg]
    ({"start": 0.0, "end": 9.166}, 64.073, 0.007, 0.0572, 0.0001, 0.098),
    ({"start": 18.334, "end": 27.5}, 64.041, 0.0005, 0.05445, 0.00004, 0.018),
    ({"start": 45.835, "end": 55.0}, 64.141, 0.005, 0.1092, 0.0014, 0.072),
    ({}, 64.074, 0.015, 0.0549, 0.0002, 1.60),
]
COULOMB_WINDOWS = [
    # window, w2, c, f, RMS [deg]
    ({"start": 18.334, "end": 27.5}, 64.042, 0.0516, 0.014, 0.017),
    ({"start": 45.835, "end": 55.0}, 64.146, 0.053, 0.112, 0.037),
    ({}, 63.972, 0.0476, 0.046, 1.11),
]


@compiled
@needs_recordings
@pytest.mark.parametrize(("window", "w2", "w2_error", "c", "c_error", "rms"), VISCOUS_WINDOWS)
def test_the_arms_windows_give_the_viscous_reference(window, w2, w2_error, c, c_error, rms):
    pendulum = identify(recording(ARM, **window))
    assert pendulum.w2.value == pytest.approx(w2, rel=3e-3)
    assert pendulum.c.value == pytest.approx(c, rel=5e-2)
    assert overlaps(pendulum.w2, w2, w2_error)
    assert overlaps(pendulum.c, c, c_error)
    # Half a unit of the last digit printed.
    assert pendulum.fit.rms_deg == pytest.approx(rms, abs=5.1e-3 if rms > 1.0 else 5.1e-4)
    assert pendulum.fit.release is None


@compiled
@needs_recordings
@pytest.mark.parametrize(("window", "w2", "c", "f", "rms"), COULOMB_WINDOWS)
def test_the_arms_windows_give_the_coulomb_reference(window, w2, c, f, rms):
    pendulum = identify(recording(ARM, **window), with_friction("coulomb"))
    assert pendulum.w2.value == pytest.approx(w2, rel=3e-3)
    assert pendulum.c.value == pytest.approx(c, rel=5e-2)
    assert pendulum.coulomb.low <= f <= pendulum.coulomb.high
    assert pendulum.fit.rms_deg == pytest.approx(rms, abs=5.1e-3 if rms > 1.0 else 5.1e-4)


@compiled
@needs_recordings
def test_dry_friction_that_would_be_negative_is_kept_at_zero():
    swing = recording(ARM, start=0.0, end=9.166)
    viscous, coulomb = identify(swing), identify(swing, with_friction("coulomb"))
    assert coulomb.coulomb.value == coulomb.coulomb.low == 0.0
    assert coulomb.c.value == pytest.approx(viscous.c.value, rel=1e-5)
    assert coulomb.c.low == pytest.approx(viscous.c.low, rel=1e-3)
    assert any("Coulomb friction is kept at zero" in warning for warning in coulomb.fit.warnings)


@compiled
@needs_recordings
@pytest.mark.parametrize("run", ["01", "03"])
@pytest.mark.parametrize("model", ["viscous", "coulomb"])
def test_the_furuta_swings_need_not_be_told_where_the_hand_lets_go(run, model):
    w2, c = {
        ("01", "viscous"): (119.87, 0.446),
        ("03", "viscous"): (120.03, 0.619),
        ("01", "coulomb"): (120.26, 0.234),
        ("03", "coulomb"): (120.39, 0.203),
    }[run, model]
    pendulum = identify(recording(f"free_swing_furuta_{run}.csv"), with_friction(model))
    assert pendulum.w2.value == pytest.approx(w2, rel=5e-3)
    assert pendulum.c.value == pytest.approx(c, rel=0.25)
    # The reference begins at the first passage through hanging; the hand lets go before.
    passage, turn = {"01": (0.544, 0.241), "03": (0.286, 0.120)}[run]
    assert turn < pendulum.fit.release < passage + 0.01


@compiled
@needs_recordings
def test_the_gyros_wheel_gives_the_reference_and_its_bias():
    pendulum = identify(recording("gyro_wheel.csv"))
    assert pendulum.w2.value == pytest.approx(19.378, rel=5e-3)
    assert overlaps(pendulum.w2, 19.378, 0.021)
    assert pendulum.fit.quantity == "rate"
    assert pendulum.fit.rms_deg == pytest.approx(0.457, abs=5e-4)
    assert np.rad2deg(pendulum.fit.offset) == pytest.approx(-1.75, abs=0.05)


# Known truths.


def coverage(swings, noise):
    """Return how often the 95 % intervals of w2 and c hold the truth."""
    hits = np.zeros(2)
    for seed in range(swings):
        rng = np.random.default_rng([2024, seed])
        truth = PendulumParameters(
            w2=70.2 * rng.uniform(0.8, 1.2),
            k=0.0,
            c=0.15 * rng.uniform(0.5, 2.0),
        )
        swing = simulated(
            truth,
            duration=8.0,
            theta0=rng.uniform(0.4, 1.5),
            zero_offset=rng.uniform(-0.3, 0.3),
            seed=seed,
        )
        swing = replace(swing, theta=swing.theta + noise(rng, swing), sha256="")
        pendulum = identify(swing)
        hits += [
            pendulum.w2.low <= truth.w2 <= pendulum.w2.high,
            pendulum.c.low <= truth.c <= pendulum.c.high,
        ]
    return hits / swings


@pytest.mark.slow
def test_the_intervals_stay_honest_where_the_noise_hangs_together():
    def slow_noise(rng, swing):
        # Correlated over 25 samples, 0.1 s: independent errors would be five times too small.
        white = rng.standard_normal(len(swing.time) + 24)
        return radians(0.1) * np.convolve(white, np.ones(25) / 5.0, mode="valid")

    assert np.all(coverage(100, slow_noise) >= 0.87)


@pytest.mark.parametrize(
    ("model", "truth"),
    [
        ("viscous", PendulumParameters(70.2, 7.15, 0.15)),
        ("coulomb", PendulumParameters(70.2, 7.15, 0.15, 1.0)),
        ("quadratic", PendulumParameters(70.2, 7.15, 0.15, 1.0, 0.05)),
    ],
)
def test_a_noiseless_swing_gives_back_what_made_it(model, truth):
    # The truth comes from an integrator of another kind.
    time = np.arange(0.0, 4.0, 0.004)
    frictions = {"c": truth.c, "coulomb": truth.coulomb, "drag": truth.drag}
    theta, _ = reference.swing(time, 1.4, 0.0, w2=truth.w2, **frictions)
    pendulum = identify(Trajectory(time=time, theta=theta + 0.2), with_friction(model))
    # The fit's own steps are wrong by 1e-6 rad.
    assert pendulum.w2.value == pytest.approx(truth.w2, rel=1e-5)
    assert pendulum.c.value == pytest.approx(truth.c, rel=2e-3)
    assert pendulum.coulomb.value == pytest.approx(truth.coulomb, rel=1e-3, abs=1e-9)
    assert pendulum.drag.value == pytest.approx(truth.drag, rel=1e-2, abs=1e-9)
    assert pendulum.fit.offset == pytest.approx(0.2, abs=1e-5)
    assert pendulum.fit.warnings == ()


@compiled
@pytest.mark.parametrize(
    ("amplitude", "rate_hz"), [(0.03, 250.0), (0.5, 1000.0), (1.5, 20.0), (3.0, 250.0)]
)
def test_small_and_large_swings_give_the_same_pendulum(amplitude, rate_hz):
    # A damped cosine would be 30 % off in w2 at 1.5 rad already.
    swing = simulated(theta0=amplitude, rate_hz=rate_hz, counts_per_rev=8192, noise=1e-4)
    pendulum = identify(swing)
    short = any("periods only" in warning for warning in pendulum.fit.warnings)
    small = any("swing stays within" in warning for warning in pendulum.fit.warnings)
    assert (short, small) == (amplitude == 3.0, amplitude < 0.1)
    assert pendulum.w2.value == pytest.approx(70.2, rel=1e-3)
    assert pendulum.c.value == pytest.approx(0.15, rel=3e-2)


@compiled
@pytest.mark.parametrize("amplitude", [0.1, 1.5, 2.6])
def test_a_gyro_gives_the_pendulum_and_its_bias(amplitude):
    rng, time = np.random.default_rng(2), np.arange(0.0, 6.0, 0.005)
    _, rate = reference.swing(time, amplitude, 0.0, w2=70.2, c=0.15)
    recorded = rate + 0.3 + 0.005 * rng.standard_normal(len(time))
    pendulum = identify(Trajectory(time=time, theta_dot=recorded))
    assert pendulum.w2.value == pytest.approx(70.2, rel=1e-3)
    assert pendulum.c.value == pytest.approx(0.15, rel=3e-2)
    assert pendulum.fit.offset == pytest.approx(0.3, abs=2e-3)


@compiled
def test_uneven_time_stamps_and_gaps_do_no_harm():
    swing = simulated(jitter=1e-3, duration=10.0)
    # A gap of 60 ms, and one of three periods.
    kept = ((swing.time < 1.0) | (swing.time > 1.06)) & ((swing.time < 4.0) | (swing.time > 6.3))
    pendulum = identify(Trajectory(time=swing.time[kept] + 1.7e9, theta=swing.theta[kept]))
    assert pendulum.w2.low <= 70.2 <= pendulum.w2.high
    assert pendulum.c.low <= 0.15 <= pendulum.c.high
    assert pendulum.fit.window == pytest.approx((1.7e9, 1.7e9 + 10.0), abs=0.01)


# The hand.


def held_then_released(hand, swing):
    """Return a recording of a hand's motion, sampled like `swing`, and the swing after it."""
    step = float(np.median(np.diff(swing.time)))
    time = np.concatenate((np.arange(len(hand)) * step, swing.time + len(hand) * step))
    return Trajectory(
        time=time,
        theta=np.concatenate((hand, swing.theta)),
        resolution=swing.resolution,
    ), float(time[len(hand)])


def lift(angle, seconds, rate_hz=250.0):
    """A smooth lift from hanging to `angle` (least jerk), then as long a rest in the hand."""
    s = np.linspace(0.0, 1.0, round(seconds * rate_hz))
    return np.concatenate((angle * s**3 * (10 - 15 * s + 6 * s**2), np.full(len(s), angle)))


HANDS = {
    "held still for a second": lambda: lift(1.0, 1.0),
    "hanging for long, then lifted in a hurry": lambda: np.concatenate(
        (np.zeros(1500), lift(1.0, 0.3))
    ),
    "held longer than it swings": lambda: lift(1.0, 12.0),
    "moved to and fro": lambda: 1.0 * np.cos(2.0 * np.arange(1000) / 250.0) ** 3 + 0.2,
}


@compiled
@pytest.mark.parametrize("hand", HANDS)
def test_the_release_is_found_after_a_hand(hand):
    swing = simulated(duration=2.5)
    recorded, release = held_then_released(HANDS[hand](), swing)
    pendulum = identify(recorded)
    assert -0.02 * PERIOD < pendulum.fit.release - release < 0.5 * PERIOD
    assert pendulum.w2.value == pytest.approx(70.2, rel=1e-3)
    assert pendulum.c.value == pytest.approx(0.15, rel=3e-2)


@compiled
def test_the_release_is_found_in_a_gyros_recording():
    time = np.arange(0.0, 6.0, 0.004)
    _, rate = reference.swing(time, 1.0, 0.0, w2=70.2, c=0.15)
    hand = np.gradient(lift(1.0, 1.0), 0.004)
    rng = np.random.default_rng(4)
    recorded = np.concatenate((hand, rate)) + 0.1
    recorded += 0.005 * rng.standard_normal(len(recorded))
    pendulum = identify(Trajectory(time=np.arange(len(recorded)) * 0.004, theta_dot=recorded))
    assert -0.02 * PERIOD < pendulum.fit.release - 2.0 < 0.5 * PERIOD
    assert pendulum.w2.value == pytest.approx(70.2, rel=1e-3)


@compiled
def test_a_hand_that_stops_the_swing_is_left_out_and_mentioned():
    swing = simulated(duration=6.1)
    stopped = np.full(500, swing.theta[-1])
    time = np.arange(len(swing.time) + 500) / 250.0
    pendulum = identify(Trajectory(time=time, theta=np.concatenate((swing.theta, stopped))))
    assert 6.1 - 0.5 * PERIOD < pendulum.fit.window[1] <= 6.1 + 0.01
    assert any("something touched the pendulum" in warning for warning in pendulum.fit.warnings)
    assert pendulum.w2.value == pytest.approx(70.2, rel=1e-3)


@compiled
def test_a_start_that_was_given_is_trusted():
    recorded, release = held_then_released(lift(1.0, 1.0), simulated())
    kept = recorded.time >= release
    told = Trajectory(time=recorded.time[kept], theta=recorded.theta[kept], released=True)
    pendulum = identify(told)
    assert pendulum.fit.window[0] == release
    assert pendulum.fit.release is None


# What comes with the numbers.


@compiled
@pytest.mark.parametrize(
    ("amplitude", "truth"),
    [
        (2.5, PendulumParameters(70.2, 7.15, 0.0, 0.0, 0.12)),
        (1.0, PendulumParameters(70.2, 7.15, 0.02, 1.0, 0.1)),
        (2.5, PendulumParameters(70.2, 7.15, 0.3, 2.5, 0.0)),
    ],
)
def test_a_richer_friction_never_fits_worse_and_is_named_where_it_halves_the_residual(
    amplitude, truth
):
    swing = simulated(truth, theta0=amplitude, duration=8.0)
    fits = [identify(swing, with_friction(model)).fit for model in fitting.FRICTIONS]
    left = [fit.rms for fit in fits]
    assert left[1] <= left[0] * (1.0 + 1e-6)
    assert left[2] <= left[1] * (1.0 + 1e-6)
    # The truth is the quadratic model: what it leaves is noise and the encoder's steps.
    assert left[2] < radians(0.06)
    if left[2] < 0.5 * left[0]:
        better = "coulomb" if left[1] < 1.2 * left[2] else "quadratic"
        assert any(f"--friction {better}" in warning for warning in fits[0].warnings)


def test_the_coupling_is_gravity_over_its_place():
    pendulum = identify(simulated(), IdentificationSettings(g=9.78))
    assert pendulum.k.value == pytest.approx(pendulum.w2.value / 9.78)
    assert pendulum.k.low == pytest.approx(pendulum.w2.low / 9.78)
    assert pendulum.g == 9.78


@compiled
def test_mass_and_length_give_inertia_and_friction_with_their_uncertainty():
    mass, length = (Estimate.normal(value, 0.01 * value, "given") for value in (0.2, 0.14))
    pendulum = identify(simulated(), mass=mass, length=length)
    I = 0.2 * pendulum.g * 0.14 / pendulum.w2.value
    assert pendulum.inertia.value == pytest.approx(I)
    assert pendulum.friction.value == pytest.approx(I * pendulum.c.value)
    # 1 % and 1 % add up to 1.414 %; what the swing leaves open is far below that.
    for estimate in (pendulum.inertia, pendulum.friction):
        width = (estimate.high - estimate.low) / 2.0 / estimate.value
        assert width == pytest.approx(1.96 * 0.01414, rel=0.01)
    assert identify(simulated()).inertia is None


def test_the_covariance_belongs_to_the_frictions_that_were_fitted():
    spread = np.array(identify(simulated()).covariance)
    assert spread.shape == (4, 4)
    assert np.all(spread[2:] == 0.0)
    assert np.all(spread[:, 2:] == 0.0)
    np.testing.assert_array_equal(spread, spread.T)
    assert np.all(np.linalg.eigvalsh(spread[:2, :2]) > 0.0)


def test_the_fitted_curve_can_be_drawn_from_files_alone(tmp_path):
    recorded, _ = held_then_released(lift(1.0, 1.0), simulated())
    identify(recorded).save(tmp_path / "pendulum.json", command="test")
    pendulum = Pendulum.load(tmp_path / "pendulum.json")
    curve = fitted_curve(recorded, pendulum)
    low, high = pendulum.fit.window
    inside = (recorded.time >= low) & (recorded.time <= high)
    assert np.all(np.isnan(curve[~inside]))
    residual = recorded.theta[inside] - curve[inside]
    assert np.sqrt(np.mean(residual**2)) == pytest.approx(pendulum.fit.rms, rel=1e-9)


@compiled
def test_the_fitted_curve_of_another_recording_is_refused():
    pendulum = identify(simulated())
    with pytest.raises(RecordingError, match="give the recording that it came from"):
        fitted_curve(simulated(seed=2), pendulum)
    with pytest.raises(RecordingError, match="from no recording"):
        fitted_curve(simulated(), Pendulum.assumed(70.2, 0.15))


def test_equal_recordings_give_equal_bits():
    assert identify(simulated()) == identify(simulated())


# Refusals.


def plain(theta, step=0.004):
    return Trajectory(time=np.arange(len(theta)) * step, theta=np.asarray(theta))


def scaled(factor, **quantity):
    swing = simulated()
    return replace(swing, sha256="", time=swing.time * factor, **quantity)


def chirp():
    time = np.arange(0.0, 10.0, 0.004)
    return plain(0.3 * np.sin(time * (3.0 + time)))


NOISE = np.random.default_rng(0).standard_normal(2000)
NO_SWINGS = {
    "a third of a period": lambda: simulated(theta0=0.5, duration=0.3 * PERIOD),
    "nearly a period": lambda: simulated(theta0=0.5, duration=0.9 * PERIOD),
    "nearly a period after the hand": lambda: held_then_released(
        lift(1.0, 1.0), simulated(duration=0.9 * PERIOD)
    )[0],
    "a dozen samples": lambda: plain(np.zeros(12)),
    "at rest": lambda: plain(np.zeros(2000)),
    "noise": lambda: plain(0.01 * NOISE),
    "one count to and fro": lambda: plain(np.round(0.3 * NOISE) * 2.0 * pi / 4096),
    "a chirp": chirp,
    "sampled too slowly": lambda: simulated(theta0=0.5, rate_hz=5.0, duration=20.0),
    "sampled at the period": lambda: simulated(theta0=2.6, rate_hz=3.0, duration=20.0),
    "milliseconds as seconds": lambda: scaled(1e3),
    "seconds as milliseconds": lambda: scaled(1e-3),
    "degrees as radians": lambda: scaled(1.0, theta=np.rad2deg(simulated().theta)),
    "over the top": lambda: plain(10.0 * np.arange(0.0, 2.5, 0.004)),
}


@compiled
@pytest.mark.parametrize("kind", NO_SWINGS)
def test_a_motion_that_is_no_free_swing_is_refused(kind):
    with pytest.raises(RecordingError, match=";") as refusal:  # it says what to do
        identify(NO_SWINGS[kind]())
    assert "\n" not in str(refusal.value)


WILD = {
    "random walk": lambda rng, n: np.cumsum(rng.standard_normal(n)),
    "steps": lambda rng, n: np.sign(rng.standard_normal(n)),
    "rare spikes": lambda rng, n: 3.0 * (rng.uniform(size=n) < 0.01),
    "chirp": lambda rng, n: np.sin(rng.uniform(1e-6, 1e-2) * np.arange(n) ** 2),
    "huge": lambda rng, n: 1e150 * np.sin(0.05 * np.arange(n)),
    "tiny": lambda rng, n: 1e-150 * np.sin(0.05 * np.arange(n)),
    "sawtooth": lambda rng, n: 4.0 * np.mod(np.arange(n) * rng.uniform(0.001, 0.2), 1.0),
}


@compiled
@pytest.mark.parametrize("kind", WILD)
def test_no_motion_ends_in_anything_but_a_pendulum_or_a_refusal(kind):
    for seed in range(6):
        rng = np.random.default_rng(seed)
        n = int(rng.choice([3, 21, 60, 600]))
        time = np.cumsum(10.0 ** rng.uniform(-3.0, -1.0) * rng.uniform(0.5, 1.5, n))
        values = WILD[kind](rng, n)
        quantity = {"theta": values} if seed % 2 else {"theta_dot": values}
        with suppress(RecordingError):
            identify(Trajectory(time=time, **quantity, released=seed % 3 == 0))
