"""Recordings: every column that is read, every file that is refused."""

import gzip
import tracemalloc
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


SAME = "time_s,theta_rad\n0,1\n0.5,2.5\n"
SPELLINGS = {
    "milliseconds": "time_ms,theta_rad\n0,1\n500,2.5\n",
    "microseconds": "time_us,theta_rad\n0,1\n500000,2.5\n",
    "semicolons": "time_s;theta_rad\n0;1\n0.5;2.5\n",
    "decimal commas": "time_s;theta_rad\n0,0;1,0\n0,5;2,5\n",
    "tabs": "time_s\ttheta_rad\n0\t1\n0.5\t2.5\n",
    "tabs and commas": "time_s\ttheta_rad\n0\t1\n0,5\t2,5\n",
    "quotes": 'note,"time_s","theta_rad"\n"a,b","0",1\n"c",0.5,"2.5"\n',
    "windows": "time_s,theta_rad\r\n0,1\r\n0.5,2.5\r\n",
    "old mac": "time_s,theta_rad\r0,1\r0.5,2.5\r",
    "UTF-8 mark": b"\xef\xbb\xbf" + SAME.encode(),
    "another script": "time_s,theta_rad,Länge (°)\n0,1,ü\n0.5,2.5,\n",
}


@pytest.mark.parametrize("text", SPELLINGS.values(), ids=SPELLINGS)
def test_one_recording_in_many_spellings_is_one_recording(tmp_path, text):
    path = tmp_path / "swing.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    swing = read_swing(path)
    assert swing.time.tolist() == [0.0, 0.5]
    assert swing.theta.tolist() == [1.0, 2.5]


@pytest.mark.parametrize("header", ["", "t,angle\n", "\ufefft,angle\n"])
def test_columns_can_be_named_where_the_file_does_not(tmp_path, header):
    path = written(tmp_path, header + "0,90\n250,45\n")
    swing = read_swing(path, columns="time_ms, theta_deg")
    assert swing.time.tolist() == [0.0, 0.25]
    np.testing.assert_allclose(swing.theta, [pi / 2, pi / 4])


def test_a_large_recording_is_read_in_little_time_and_memory(tmp_path):
    n = 200_000
    rows = "".join(f"{i / 1000:.3f},{i % 7:.6f}\n" for i in range(n))
    path = written(tmp_path, "time_s,theta_rad\n" + rows)
    tracemalloc.start()
    swing = read_swing(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(swing.time) == n
    # A list of cells for each row takes 40 MB and more.
    assert peak < 6 * path.stat().st_size


def test_a_recording_that_is_too_large_is_refused_before_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr("equipoise.trajectory.MAX_RECORDING_SIZE", 1024 * 1024)
    path = written(tmp_path, "time_s,theta_rad\n" + "0,1\n" * 300_000)
    with pytest.raises(RecordingError, match="1 MiB, the limit for a recording"):
        read_swing(path)
    monkeypatch.setattr("equipoise.trajectory.MAX_RECORDING_SIZE", 10**8)
    monkeypatch.setattr("equipoise.trajectory.MAX_SAMPLES", 1000)
    with pytest.raises(RecordingError, match="300,001 lines, expected at most 1,000"):
        read_swing(path)


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (SAME.encode("utf-16"), "UTF-16"),
        (b"\xfe\xff" + SAME.encode("utf-16-be"), "UTF-16"),
        (SAME.encode("utf-16-le"), "UTF-16"),
        (SAME.encode("utf-16-be"), "UTF-16"),
        ("time_s,theta_rad,Länge (°)\n0,1,ü\n".encode("latin-1"), "not UTF-8"),
        (gzip.compress(SAME.encode(), mtime=0), "a gzip file"),
        (b"PK\3\4 a spreadsheet", "a ZIP file or a spreadsheet"),
        (b"\x89PNG\r\n\x1a\n\x00\xff\xfe", "not UTF-8"),
    ],
)
def test_a_file_that_is_not_utf_8_is_refused_by_its_kind(tmp_path, content, found):
    path = tmp_path / "swing.csv"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=f" is {found}; save the recording as CSV in UTF-8$"):
        read_swing(path)


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
        ("", "columns \\(none\\); expected one of time_s, time_ms, time_us and one of theta_rad"),
        ("time_s,theta_rad\n", "holds no samples"),
        ("t,angle\n0,1\n", "has the columns t, angle; expected one of time_s"),
        ("theta_rad\n0\n", "expected one of time_s"),
        ("time_s,theta_rad,theta_deg\n0,1,2\n", "expected one of time_s"),
        ("time_s,theta_rad\n0,1\n0.1,nan\n", "line 3: theta_rad is 'nan', expected a finite"),
        ("time_s,theta_rad\n0,1\n0.1,inf\n", "line 3: theta_rad is 'inf', expected a finite"),
        ("time_s,theta_rad\n0,1\n\n0.1,high\n", "line 4: theta_rad is 'high'"),
        ("time_s,theta_rad\nnan,1\n", "line 2: time_s is 'nan'"),
        ("time_s,theta_rad\n0,1\n0.1\n", "line 3: theta_rad is '', expected a finite"),
        (
            "time_s,theta_rad\n0,1\n0.1,2\n0.1,3\n",
            "line 4: time does not increase, time_s is 0.1 after 0.1",
        ),
        ("time_s,theta_rad\n0,1\n0.2,2\n\n0.1,3\n", "line 5: time does not increase"),
        ("time_s,counts\n0,1\n0.1,2\n", "counts per revolution are not given"),
        ("time_s,theta_rad\n0,1\n", "holds a single sample; record a swing"),
        ("time_s,time_ms,theta_rad\n0,0,1\n", "expected one of time_s"),
        (
            "0.0,1.5\n0.1,1.4\n",
            "no header.*'0.0,1.5'; name its columns, for example --columns time_s",
        ),
        ("time_s,theta_rad\n0,000,1,25\n0,010,1,24\n", "has 4 cells .* by semicolons"),
        ("time_s;theta_rad\n0;1\n0.1;a,b\n", "line 3: theta_rad is 'a.b'"),
        ("time_s theta_rad\n0 1\n", "separated by a comma, a semicolon or a tab"),
        ("time_s,theta_rad\n0,1\n0.1,2\n   \n0.2,x\n", "line 5: theta_rad is 'x'"),
        ('time_s,note,theta_rad\n0,"a,b",1\n0.1,"c,d",y\n', "line 3: theta_rad is 'y'"),
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


def test_control_characters_are_no_text(tmp_path):
    with pytest.raises(RecordingError, match="is not text"):
        read_swing(written(tmp_path, "time_s,\x01theta_rad\n0,1\n"))


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
        ({}, "an angle or a rate"),
        ({"theta": TIME, "theta_dot": TIME}, "an angle or a rate"),
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


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("time_s,theta_rad\n1.7e12,1\n1.7001e12,2\n", "time_s reaches 1.7e\\+12, .* another unit"),
        ("time_s,rate_rad_s\n0,1\n1,1e12\n", "rate_rad_s reaches 1e\\+12"),
        ("time_s,rate_rad_s\n0,1\n1,1e300\n", "line 3: rate_rad_s is '1e300'"),
        ("time_s,theta_rad\n0,1\n1_000,1\n", "line 3: time_s is '1_000'.* such as -1.25"),
        ("time_s,theta_rad\n0,1\n1,٣\n", "line 3: theta_rad is '٣'"),
    ],
)
def test_numbers_that_no_recorder_gives_are_refused(tmp_path, text, reason):
    with pytest.raises(RecordingError, match=reason):
        read_swing(written(tmp_path, text))
