"""Recordings: every column that is read, every file that is refused."""

from math import pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from equipoise.errors import RecordingError
from equipoise.trajectory import Trajectory, read_swing, write_swing

TIME = np.array([0.0, 0.1, 0.2, 0.3])


def written(tmp_path, text):
    path = tmp_path / "swing.csv"
    path.write_text(text)
    return path


def column(tmp_path, name, values):
    rows = "".join(f"{t},{value}\n" for t, value in zip(TIME, values, strict=True))
    return written(tmp_path, f"time_s,{name}\n{rows}")


def test_radians_are_read_as_they_are(tmp_path):
    swing = read_swing(column(tmp_path, "theta_rad", [0.1, 0.2, 0.1, -0.3]))
    assert swing.theta.tolist() == [0.1, 0.2, 0.1, -0.3]
    assert swing.theta_dot is None
    assert swing.source == "swing.csv"
    assert swing.resolution == pytest.approx(0.1)


def test_degrees_become_radians(tmp_path):
    swing = read_swing(column(tmp_path, "theta_deg", [90, 45, 0, -90]))
    np.testing.assert_allclose(swing.theta, [pi / 2, pi / 4, 0, -pi / 2])
    assert swing.resolution == pytest.approx(pi / 4)


def test_counts_become_radians(tmp_path):
    swing = read_swing(column(tmp_path, "counts", [1024, 0, -1024, 1]), counts_per_rev=4096)
    np.testing.assert_allclose(swing.theta, [pi / 2, 0, -pi / 2, 2 * pi / 4096])
    assert swing.resolution == pytest.approx(2 * pi / 4096)


def test_a_gyros_rate_is_a_rate(tmp_path):
    swing = read_swing(column(tmp_path, "rate_rad_s", [1, 2, 3, -4]))
    assert swing.theta is None
    assert swing.theta_dot.tolist() == [1, 2, 3, -4]


def test_an_angle_from_upright_is_turned_to_hanging(tmp_path):
    # theta + phi = pi; a swing about hanging has phi about +-pi, wrapped there.
    swing = read_swing(column(tmp_path, "theta_deg", [170, 178, -174, 178]), from_upright=True)
    np.testing.assert_allclose(np.rad2deg(swing.theta), [10, 2, -6, 2], atol=1e-9)
    rate = read_swing(column(tmp_path, "rate_rad_s", [1, 2, 3, -4]), from_upright=True)
    assert rate.theta_dot.tolist() == [-1, -2, -3, 4]


def test_a_wrapped_angle_is_unwrapped_about_hanging(tmp_path):
    swing = read_swing(column(tmp_path, "theta_deg", [350, 5, 20, 355]))
    np.testing.assert_allclose(np.rad2deg(swing.theta), [-10, 5, 20, -5], atol=1e-9)


def test_further_columns_blank_lines_and_a_byte_order_mark_do_no_harm(tmp_path):
    path = written(tmp_path, "\ufeffnote, time_s ,theta_rad\na,0,1\n\nb,0.5,2\n \n")
    swing = read_swing(path)
    assert swing.time.tolist() == [0.0, 0.5]
    assert swing.theta.tolist() == [1.0, 2.0]


def test_a_window_holds_the_samples_at_its_ends_and_trusts_its_start(tmp_path):
    path = column(tmp_path, "theta_rad", [0.1, 0.2, 0.1, -0.3])
    swing = read_swing(path, start=0.1, end=0.2)
    assert swing.time.tolist() == [0.1, 0.2]
    assert swing.released
    assert not read_swing(path, end=0.2).released
    assert swing.sha256 == read_swing(path).sha256


@given(
    steps=arrays(np.float64, 20, elements=st.floats(1e-4, 1.0)),
    values=arrays(np.float64, 20, elements=st.floats(-3.0, 3.0)),
    rate=st.booleans(),
)
@settings(deadline=None, max_examples=50)
def test_a_written_swing_is_read_back_to_the_last_bit(tmp_path_factory, steps, values, rate):
    path = tmp_path_factory.mktemp("swing") / "swing.csv"
    # Steps below half a turn, so that nothing is taken for a wrap.
    recorded = {"theta_dot": values} if rate else {"theta": 0.5 * values}
    swing = Trajectory(time=np.cumsum(steps), **recorded)
    write_swing(path, swing)
    again = read_swing(path)
    assert np.array_equal(again.time, swing.time)
    assert np.array_equal(again.values, swing.values)


def test_a_trajectory_cannot_be_written_to():
    source = np.zeros(4)
    swing = Trajectory(time=TIME, theta=source)
    with pytest.raises(ValueError, match="read-only"):
        swing.theta[0] = 1.0
    source[0] = 1.0
    assert swing.theta[0] == 0.0


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "columns \\(none\\); expected time_s and one of theta_rad"),
        ("time_s,theta_rad\n", "holds no samples"),
        ("t,angle\n0,1\n", "has the columns t, angle; expected time_s and one of"),
        ("theta_rad\n0\n", "expected time_s and one of"),
        ("time_s,theta_rad,theta_deg\n0,1,2\n", "expected time_s and one of"),
        ("time_s;theta_rad\n0;1\n", "expected time_s and one of"),
        ("time_s,theta_rad\n0,1\n0.1,nan\n", "line 3: theta_rad is 'nan', expected a finite"),
        ("time_s,theta_rad\n0,1\n0.1,inf\n", "line 3: theta_rad is 'inf', expected a finite"),
        ("time_s,theta_rad\n0,1\n\n0.1,high\n", "line 4: theta_rad is 'high'"),
        ("time_s,theta_rad\nnan,1\n", "line 2: time_s is 'nan'"),
        ("time_s,theta_rad\n0,1\n0.1\n", "line 3: theta_rad is '', expected a finite"),
        ("time_s,theta_rad\n0,1\n0.1,2\n0.1,3\n", "line 4: time does not increase, 0.1 s comes"),
        ("time_s,theta_rad\n0,1\n0.2,2\n\n0.1,3\n", "line 5: time does not increase"),
        ("time_s,counts\n0,1\n0.1,2\n", "counts per revolution are not given"),
        ("time_s,theta_rad\n0,1\n", "has 1 samples"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_in_one_sentence(tmp_path, text, reason):
    with pytest.raises(RecordingError, match=reason) as refusal:
        read_swing(written(tmp_path, text))
    assert "\n" not in str(refusal.value)


def test_a_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(RecordingError, match=r"there is no file .*nowhere\.csv"):
        read_swing(tmp_path / "nowhere.csv")


def test_a_folder_is_refused(tmp_path):
    with pytest.raises(RecordingError, match="cannot read"):
        read_swing(tmp_path)


def test_a_file_that_is_not_text_is_refused(tmp_path):
    path = tmp_path / "swing.csv"
    path.write_bytes(b"\x89PNG\x00\xff\xfe")
    with pytest.raises(RecordingError, match="is not text"):
        read_swing(path)


@pytest.mark.parametrize("counts_per_rev", [0, -4096])
def test_impossible_counts_per_revolution_are_refused(tmp_path, counts_per_rev):
    with pytest.raises(RecordingError, match=f"counts per revolution are {counts_per_rev}"):
        read_swing(column(tmp_path, "counts", [1, 2, 3, 4]), counts_per_rev=counts_per_rev)


@pytest.mark.parametrize("window", [{"start": 5.0}, {"end": -1.0}, {"start": 0.2, "end": 0.1}])
def test_a_window_without_samples_is_refused(tmp_path, window):
    path = column(tmp_path, "theta_rad", [0.1, 0.2, 0.1, -0.3])
    with pytest.raises(RecordingError, match=r"it lasts from 0 s to 0\.3 s"):
        read_swing(path, **window)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({}, "either an angle or a rate"),
        ({"theta": TIME, "theta_dot": TIME}, "either an angle or a rate"),
        ({"theta": np.zeros(3)}, "theta has shape"),
        ({"theta": np.array([0.0, np.nan, 0.0, 0.0])}, "sample 1 of theta is not a finite"),
        ({"theta": TIME, "x_ddot": np.full(4, np.inf)}, "sample 0 of x_ddot"),
    ],
)
def test_impossible_trajectories_are_refused(fields, reason):
    with pytest.raises(RecordingError, match=reason):
        Trajectory(time=TIME, **fields)


def test_a_trajectory_whose_time_stands_still_is_refused():
    with pytest.raises(RecordingError, match="time does not increase at sample 2"):
        Trajectory(time=np.array([0.0, 1.0, 1.0]), theta=np.zeros(3))
