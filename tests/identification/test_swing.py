"""Identification: against fits of real recordings made apart, and against known truths.

The reference values of the real recordings come with them (README of the data folder); they were
found with another program, and each has its standard error, block-robust over periods.
"""

from dataclasses import replace
from math import pi, radians, sqrt

import numpy as np
import pytest

from equipoise import Estimate, Pendulum, PendulumParameters
from equipoise.errors import RecordingError
from equipoise.identification.recording import Trajectory, fitted_curve, read_swing, simulate_swing
from equipoise.identification.swing import MODELS, identify
from equipoise.settings import IdentificationSettings
from tests.conftest import tiers
from tests.reference import pendulum as reference

PENDULUM = PendulumParameters(w2=70.2, k=7.15, c=0.15)
PERIOD = 2.0 * pi / sqrt(70.2)
STEP = 0.004
"""Time between samples [s]."""


def simulated(parameters=PENDULUM, **changes):
    encoder = {"rate_hz": 250.0, "counts_per_rev": 4096, "noise": radians(0.05), "seed": 1}
    return simulate_swing(parameters, **{"theta0": 1.0, "duration": 4.0} | encoder | changes)


def gyro(amplitude, duration):
    """Return times and the rates that a noisy gyro shows."""
    time = np.arange(0.0, duration, 0.005)
    _, rate = reference.swing(time, amplitude, 0.0, w2=70.2, c=0.15)
    return time, rate + 0.005 * np.random.default_rng(2).standard_normal(len(time))


def with_friction(model):
    return IdentificationSettings(friction=model)


def gives_the_pendulum(pendulum):
    found = pendulum.w2.value, pendulum.c.value
    return found == (pytest.approx(70.2, rel=1e-3), pytest.approx(0.15, rel=3e-2))


def overlaps(estimate, value, error):
    """Tell whether a 95 % interval meets the reference's."""
    return estimate.low <= value + 1.96 * error and estimate.high >= value - 1.96 * error


# Real recordings.

ARM_WINDOWS = [
    # friction, window, w2, its error, c, its error, Coulomb friction, RMS [deg]
    ("viscous", {"start": 0.0, "end": 9.166}, 64.073, 0.007, 0.0572, 0.0001, 0.0, 0.098),
    ("viscous", {"start": 18.334, "end": 27.5}, 64.041, 0.0005, 0.05445, 0.00004, 0.0, 0.018),
    ("viscous", {"start": 45.835, "end": 55.0}, 64.141, 0.005, 0.1092, 0.0014, 0.0, 0.072),
    pytest.param(
        *("viscous", {}, 64.074, 0.015, 0.0549, 0.0002, 0.0, 1.60), marks=pytest.mark.full
    ),
    ("coulomb", {"start": 18.334, "end": 27.5}, 64.042, 0.0, 0.0516, 0.0, 0.014, 0.017),
    ("coulomb", {"start": 45.835, "end": 55.0}, 64.146, 0.0, 0.053, 0.0, 0.112, 0.037),
]


@pytest.mark.parametrize(
    ("model", "window", "w2", "w2_error", "c", "c_error", "f", "rms"), ARM_WINDOWS
)
def test_the_arms_windows_give_the_reference(
    recordings, model, window, w2, w2_error, c, c_error, f, rms
):
    swing = read_swing(recordings / "free_swing_arm_55s.csv", **window)
    pendulum = identify(swing, with_friction(model))
    assert pendulum.w2.value == pytest.approx(w2, rel=3e-3)
    assert pendulum.c.value == pytest.approx(c, rel=5e-2)
    assert overlaps(pendulum.w2, w2, w2_error)
    assert overlaps(pendulum.c, c, c_error)
    assert pendulum.coulomb.low <= f <= pendulum.coulomb.high
    # The fit leaves out a part of a swing at both ends.
    assert 0.7 * rms < np.rad2deg(pendulum.fit.rms) <= rms


def test_dry_friction_that_would_be_negative_is_kept_at_zero(recordings):
    swing = read_swing(recordings / "free_swing_arm_55s.csv", start=0.0, end=9.166)
    viscous, coulomb = identify(swing), identify(swing, with_friction("coulomb"))
    assert coulomb.coulomb.value == coulomb.coulomb.low == 0.0
    assert coulomb.c.value == pytest.approx(viscous.c.value, rel=1e-5)
    assert coulomb.c.low == pytest.approx(viscous.c.low, rel=1e-3)
    assert any("coulomb friction is kept at zero" in warning for warning in coulomb.fit.warnings)


@pytest.mark.parametrize(
    ("run", "model", "w2", "c"),
    [
        ("01", "viscous", 119.87, 0.446),
        ("03", "viscous", 120.03, 0.619),
        ("01", "coulomb", 120.26, 0.234),
        ("03", "coulomb", 120.39, 0.203),
    ],
)
def test_the_furuta_swings_need_not_be_told_where_the_hand_lets_go(recordings, run, model, w2, c):
    swing = read_swing(recordings / f"free_swing_furuta_{run}.csv")
    pendulum = identify(swing, with_friction(model))
    assert pendulum.w2.value == pytest.approx(w2, rel=5e-3)
    assert pendulum.c.value == pytest.approx(c, rel=0.25)
    # The reference begins at the first passage through hanging; the hand lets go before.
    passage = {"01": 0.544, "03": 0.286}[run]
    assert passage < pendulum.fit.release < passage + 0.25


RECORDED = [
    # name, first and last start [s] (three periods are left), length of a window [s], w2 [1/s^2],
    # largest relative difference (a short window at small amplitude)
    ("free_swing_furuta_01.csv", 0.544, 3.4, 5.0, 120.0, 8e-3),
    ("free_swing_furuta_03.csv", 0.286, 3.4, 5.0, 120.0, 8e-3),
    pytest.param("gyro_wheel.csv", 0.0, 1.1, 5.0, 19.38, 3e-3, marks=pytest.mark.full),
    ("free_swing_arm_55s.csv", 0.0, 51.0, 4.0, 64.07, 3e-3),
]


@pytest.mark.parametrize(("name", "first", "last", "length", "w2", "within"), RECORDED)
def test_no_start_of_a_recorded_swing_is_refused(recordings, name, first, last, length, w2, within):
    for start in np.linspace(first, last, 3):
        pendulum = identify(read_swing(recordings / name, start=start, end=start + length))
        assert pendulum.w2.value == pytest.approx(w2, rel=within), f"from {start:.3f} s"
        assert pendulum.fit.quantity == ("rate" if "gyro" in name else "angle")
        assert start <= pendulum.fit.window[0] < start + pi / sqrt(w2) + 0.1
        assert pendulum.fit.release is None


# Known truths.


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
    time = np.arange(0.0, 5.0, STEP)
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


@pytest.mark.parametrize(
    ("amplitude", "rate_hz"), [(0.03, 250.0), (0.5, 1000.0), (1.5, 20.0), (3.0, 250.0)]
)
def test_small_and_large_swings_give_the_same_pendulum(amplitude, rate_hz):
    # A damped cosine would be 30 % off in w2 at 1.5 rad already.
    swing = simulated(theta0=amplitude, rate_hz=rate_hz, counts_per_rev=8192, noise=1e-4)
    pendulum = identify(swing)
    assert gives_the_pendulum(pendulum)
    short = any("periods only" in warning for warning in pendulum.fit.warnings)
    small = any("swing stays within" in warning for warning in pendulum.fit.warnings)
    assert (short, small) == (amplitude == 3.0, amplitude < 0.1)


@pytest.mark.parametrize("amplitude", [0.1, 1.5, 2.6])
def test_a_gyro_gives_the_pendulum_and_its_bias(amplitude):
    time, rate = gyro(amplitude, 6.0)
    pendulum = identify(Trajectory(time=time, theta_dot=rate + 0.3))
    assert gives_the_pendulum(pendulum)
    assert pendulum.fit.offset == pytest.approx(0.3, abs=2e-3)


@pytest.mark.parametrize("correlated", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_intervals_cover_the_truth_of_some_simulated_swings(correlated):
    hits = np.zeros(2)
    for seed in range(25):
        rng = np.random.default_rng([2024, seed])
        truth = PendulumParameters(70.2 * rng.uniform(0.8, 1.2), 0.0, 0.15 * rng.uniform(0.5, 2.0))
        swing = simulated(truth, theta0=rng.uniform(0.4, 1.5), duration=8.0, seed=seed)
        if correlated:  # over 25 samples, 0.1 s: independent errors would be five times too small
            white = rng.standard_normal(len(swing.time) + 24)
            slow = radians(0.1) * np.convolve(white, np.ones(25) / 5.0, mode="valid")
            swing = replace(swing, theta=swing.theta + slow, sha256="")
        pendulum = identify(swing)
        for i, (estimate, value) in enumerate(((pendulum.w2, truth.w2), (pendulum.c, truth.c))):
            hits[i] += estimate.low <= value <= estimate.high
    # Of 25 intervals at 95 %, fewer than 19 hold the truth with a probability of 2e-4.
    assert np.all(hits >= 19)


# The hand.


def held_then_released(hand, swing):
    """Return a recording of a hand's motion, sampled like `swing`, and the swing after it."""
    time = np.concatenate((np.arange(len(hand)) * STEP, swing.time + len(hand) * STEP))
    theta = np.concatenate((hand, swing.theta))
    recorded = Trajectory(time=time, theta=theta, resolution=swing.resolution)
    return recorded, float(time[len(hand)])


def lift(angle, seconds):
    """A smooth lift from hanging to `angle` (least jerk), then as long a rest in the hand."""
    s = np.linspace(0.0, 1.0, round(seconds / STEP))
    return np.concatenate((angle * s**3 * (10 - 15 * s + 6 * s**2), np.full(len(s), angle)))


HANDS = {
    "held still for a second": lambda: lift(1.0, 1.0),
    "held longer than it swings": lambda: lift(1.0, 12.0),
    "moved to and fro": lambda: 1.0 * np.cos(2.0 * np.arange(1000) * STEP) ** 3 + 0.2,
    "pushed in time with the swing": lambda: (
        np.linspace(0.1, 1.0, 500) * np.cos(2.0 * pi / PERIOD * (np.arange(500) - 500) * STEP)
    ),
}


@pytest.mark.parametrize("hand", HANDS)
def test_the_swing_after_a_hand_is_found(hand):
    recorded, release = held_then_released(HANDS[hand](), simulated())
    pendulum = identify(recorded)
    assert -0.02 * PERIOD < pendulum.fit.release - release < 1.2 * PERIOD
    assert pendulum.fit.window[0] == pendulum.fit.release
    assert gives_the_pendulum(pendulum)


def test_a_hand_that_stops_the_swing_is_left_out():
    swing = simulated(duration=6.1)
    stopped = np.full(500, swing.theta[-1])
    time = np.arange(len(swing.time) + 500) * STEP
    pendulum = identify(Trajectory(time=time, theta=np.concatenate((swing.theta, stopped))))
    assert 6.1 - 0.5 * PERIOD < pendulum.fit.window[1] <= 6.1 + 0.01
    assert pendulum.w2.value == pytest.approx(70.2, rel=1e-3)


@pytest.mark.parametrize(("gap", "lasts"), [(0.0, 0.3), (0.0, 0.5), (0.6, 0.5)])
def test_several_swings_in_one_recording_are_distinguished(gap, lasts):
    # The pendulum is lifted again within about half a period; or the recorder paused meanwhile.
    time, theta = [], []
    for amplitude, periods in ((0.9, 8.25), (1.0, 5.5), (0.7, 6.1)):
        swing = simulated(theta0=amplitude, duration=periods * PERIOD, seed=len(theta))
        if theta and not gap:
            s = np.arange(STEP, lasts * PERIOD, STEP) / (lasts * PERIOD)
            theta.append(theta[-1][-1] + (amplitude - theta[-1][-1]) * s**2 * (3.0 - 2.0 * s))
            time.append(time[-1][-1] + STEP * np.arange(1, len(s) + 1))
        begin = time[-1][-1] + STEP + gap * lasts * PERIOD if time else 0.0
        time.append(begin + swing.time)
        theta.append(swing.theta)
    recorded = Trajectory(time=np.concatenate(time), theta=np.concatenate(theta))
    pendulum = identify(recorded)
    assert pendulum.w2.value == pytest.approx(70.2, rel=5e-3)
    assert pendulum.fit.window[1] <= time[0][-1]  # the longest


# What comes with the numbers.


def test_a_richer_friction_is_asked_for_where_it_is_missing():
    truth = PendulumParameters(70.2, 7.15, 0.02, 1.0, 0.1)
    swing = simulated(truth, duration=8.0)
    viscous, quadratic = (identify(swing, with_friction(model)).fit for model in MODELS[::2])
    assert viscous.richer_friction == "coulomb"
    assert any("try --friction coulomb" in warning for warning in viscous.warnings)
    # The truth is the quadratic model: what it leaves is noise and the encoder's steps.
    assert quadratic.rms < radians(0.06)
    assert (quadratic.richer_friction, quadratic.warnings) == (None, ())


def refused_or_warned(swing, friction):
    """Return what the user reads about a swing."""
    try:
        return " ".join(identify(swing, with_friction(friction)).fit.warnings)
    except RecordingError as refusal:
        return str(refusal)


def spring(amplitude=0.55):
    time = np.arange(0.0, 20.0, 0.017)
    theta = amplitude * np.exp(-0.01 * time) * np.cos(2.0 * pi * time / 1.31)
    return Trajectory(time=time, theta=theta, resolution=radians(0.001))


@pytest.mark.full
def test_a_richer_friction_is_never_worse_for_any_oscillator():
    rng, swings = np.random.default_rng(44), [spring(), spring(1.5)]
    for seed in range(8):
        w2 = 10.0 ** rng.uniform(1.0, 2.3)
        c, coulomb, drag = (rng.integers(2) * 10.0 ** rng.uniform(-3.0, -1.5) for _ in range(3))
        truth = PendulumParameters(w2, w2 / 9.81, c * sqrt(w2), coulomb * w2, drag)
        period, theta0 = 2.0 * pi / sqrt(w2), rng.uniform(0.3, 2.5)
        options = {"duration": 12.0 * period, "rate_hz": 50.0 / period, "seed": seed}
        swings.append(simulated(truth, theta0=theta0, **options))
    for swing in swings:
        rms = [identify(swing, with_friction(model)).fit.rms for model in MODELS]
        assert rms == sorted(rms, reverse=True)


@pytest.mark.parametrize("friction", tiers(MODELS, ["viscous"], MODELS))
def test_a_spring_is_named_and_no_other_friction_advised(friction):
    said = refused_or_warned(spring(), friction)
    assert "period does not depend on the amplitude: a spring" in said
    assert "--friction" not in said


@pytest.mark.parametrize("amplitude", [0.6, 1.5])
@pytest.mark.parametrize(("factor", "said"), [(4.0, "4 times smaller"), (0.5, "2 times larger")])
@pytest.mark.full
def test_counts_per_revolution_that_are_off_are_suspected_by_the_period(factor, said, amplitude):
    swing = simulated(theta0=amplitude, noise=1e-4, duration=8.0)
    wrong = replace(swing, theta=factor * swing.theta, sha256="")
    assert said in refused_or_warned(wrong, "viscous")


@pytest.mark.parametrize("amplitude", [0.5, 1.0, 2.4])
@pytest.mark.full
def test_deg_per_s_taken_for_rad_per_s_are_suspected_by_the_period(amplitude):
    time, rate = gyro(amplitude, 8.0)
    said = refused_or_warned(Trajectory(time=time, theta_dot=np.rad2deg(rate)), "viscous")
    assert "57.3 times smaller than recorded" in said


def test_gravity_mass_and_length_give_coupling_inertia_and_friction_with_their_uncertainty():
    mass, length = (Estimate.normal(value, 0.01 * value, "given") for value in (0.2, 0.14))
    pendulum = identify(simulated(), IdentificationSettings(g=9.78), mass=mass, length=length)
    assert pendulum.k.value == pytest.approx(pendulum.w2.value / 9.78)
    I = 0.2 * 9.78 * 0.14 / pendulum.w2.value
    assert pendulum.inertia.value == pytest.approx(I)
    assert pendulum.friction.value == pytest.approx(I * pendulum.c.value)
    # 1 % and 1 % add up to 1.414 %; what the swing leaves open is far below that.
    for estimate in (pendulum.inertia, pendulum.friction):
        assert estimate.half_width / estimate.value == pytest.approx(1.96 * 0.01414, rel=0.02)


def test_the_fitted_curve_can_be_drawn_from_files_alone(tmp_path):
    recorded, _ = held_then_released(lift(1.0, 1.0), simulated())
    identify(recorded).save(tmp_path / "pendulum.json", command="test")
    pendulum = Pendulum.load(tmp_path / "pendulum.json")
    assert pendulum == identify(recorded)
    curve = fitted_curve(recorded, pendulum)
    low, high = pendulum.fit.window
    inside = (recorded.time >= low) & (recorded.time <= high)
    assert np.all(np.isnan(curve[~inside]))
    residual = recorded.theta[inside] - curve[inside]
    assert np.sqrt(np.mean(residual**2)) == pytest.approx(pendulum.fit.rms, rel=1e-9)
    for other in (pendulum, Pendulum.assumed(70.2, 0.15)):
        with pytest.raises(RecordingError, match="give the recording that it came from"):
            fitted_curve(simulated(seed=2), other)


# Refusals.


def plain(theta):
    return Trajectory(time=np.arange(len(theta)) * STEP, theta=np.asarray(theta))


CHIRP = np.arange(0.0, 5.0, STEP)
NOISE = np.random.default_rng(0).standard_normal(2000)
NO_SWINGS = {
    "a third of a period": lambda: simulated(theta0=0.5, duration=0.3 * PERIOD),
    "at rest": lambda: plain(np.zeros(2000)),
    "noise": lambda: plain(0.01 * NOISE),
    "a chirp": lambda: plain(0.3 * np.sin(CHIRP * (3.0 + CHIRP))),
    "sampled too slowly": lambda: simulated(theta0=0.5, rate_hz=5.0, duration=20.0),
    "milliseconds as seconds": lambda: simulated(
        PendulumParameters(70.2e-6, 7.15e-6, 0.15e-3), duration=4e3, rate_hz=0.25
    ),
    "over the top": lambda: plain(10.0 * np.arange(0.0, 2.5, STEP)),
}


@pytest.mark.parametrize("kind", NO_SWINGS)
def test_a_motion_that_is_no_free_swing_is_refused(kind):
    with pytest.raises(RecordingError, match=";") as refusal:  # it says what to do
        identify(NO_SWINGS[kind]())
    assert "\n" not in str(refusal.value)
