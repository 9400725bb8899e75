"""Recordings: every column that is read, every file that is refused."""

from math import pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from equipoise.errors import RecordingError
from equipoise.identification.recording import Trajectory, read_swing, write_swing
from tests.conftest import written

TIME = np.array([0.0, 0.1, 0.2, 0.3])


def column(name, values, time=TIME):
    rows = "".join(f"{t},{value}\n" for t, value in zip(time, values, strict=True))
    return written("swing.csv", f"time_s,{name}\n{rows}")


COLUMNS = [
    # column, its values, options, angle [rad], smallest step [rad]
    ("theta_rad", [0.1, 0.2, 0.1, -0.3], {}, [0.1, 0.2, 0.1, -0.3], 0.1),
    ("theta_deg", [90, 45, 0, -90], {}, [pi / 2, pi / 4, 0, -pi / 2], pi / 4),
    (
        *("counts", [1024, 0, -1024, 1], {"counts_per_rev": 4096}),
        *([pi / 2, 0, -pi / 2, 2 * pi / 4096], 2 * pi / 4096),
    ),
    # theta + phi = pi; a swing about hanging has phi about +-pi, wrapped there.
    (
        *("theta_deg", [170, 178, -174, 178], {"from_upright": True}),
        *(np.deg2rad([10, 2, -6, 2]), np.deg2rad(8)),
    ),
    # Unwrapped about hanging.
    ("theta_deg", [350, 5, 20, 355], {}, np.deg2rad([-10, 5, 20, -5]), np.deg2rad(5)),
]


@pytest.mark.parametrize(("name", "values", "options", "theta", "step"), COLUMNS)
def test_each_column_becomes_an_angle_from_hanging(name, values, options, theta, step):
    swing = read_swing(column(name, values), **options)
    np.testing.assert_allclose(swing.theta, theta, atol=1e-12)
    assert swing.resolution == pytest.approx(step)
    assert (swing.theta_dot, swing.source) == (None, "swing.csv")


def test_a_gyros_rate_is_a_rate():
    path = column("rate_rad_s", [1, 2, 3, -4])
    assert read_swing(path).theta is None
    assert read_swing(path).theta_dot.tolist() == [1, 2, 3, -4]
    assert read_swing(path, from_upright=True).theta_dot.tolist() == [-1, -2, -3, 4]


SPELLINGS = {
    "milliseconds": "time_ms,theta_rad\n0,1\n500,2.5\n",
    "semicolons": "time_s;theta_rad\n0;1\n0.5;2.5\n",
    "decimal commas": "time_s;theta_rad\n0,0;1,0\n0,5;2,5\n",
    "tabs and commas": "time_s\ttheta_rad\n0\t1\n0,5\t2,5\n",
    "quotes": 'note,"time_s","theta_rad"\n"a,b","0",1\n"c",0.5,"2.5"\n',
    "blanks": "note, time_s ,theta_rad\na,0,1\n\nb,0.5,2.5\n\n",
    "another script": "time_s,theta_rad,Länge (°)\n0,1,ü\n0.5,2.5,\n",
}


@pytest.mark.parametrize("text", SPELLINGS.values(), ids=SPELLINGS)
def test_one_recording_in_many_spellings_is_one_recording(text):
    swing = read_swing(written("swing.csv", text))
    assert swing.time.tolist() == [0.0, 0.5]
    assert swing.theta.tolist() == [1.0, 2.5]


def test_a_window_holds_the_samples_at_its_ends_and_trusts_its_start():
    path = column("theta_rad", [0.1, 0.2, 0.1, -0.3])
    swing = read_swing(path, start=0.1, end=0.2)
    assert swing.time.tolist() == [0.1, 0.2]
    assert (swing.released, read_swing(path, end=0.2).released) == (True, False)
    assert swing.sha256 == read_swing(path).sha256


@given(
    steps=arrays(np.float64, 20, elements=st.floats(1e-4, 1.0)),
    values=arrays(np.float64, 20, elements=st.floats(-3.0, 3.0)),
    rate=st.booleans(),
)
def test_a_written_swing_is_read_back_to_the_last_bit(tmp_path_factory, steps, values, rate):
    path = tmp_path_factory.mktemp("swing") / "swing.csv"
    # Steps below half a turn, so that nothing is taken for a wrap.
    recorded = {"theta_dot": values} if rate else {"theta": 0.5 * values}
    swing = Trajectory(time=np.cumsum(steps), **recorded)
    write_swing(path, swing)
    again = read_swing(path)
    assert np.array_equal(again.time, swing.time)
    assert np.array_equal(again.values, swing.values)


@pytest.mark.parametrize("counts_per_rev", [400, 1600, 2500, 4096, 131072])
@pytest.mark.parametrize("period", [2**8, 2**15, 2**16, 2**32, 10000])
def test_a_counter_that_overflows_is_unwrapped_by_its_own_period(counts_per_rev, period):
    time = np.arange(0.0, 8.0, 0.005)
    angle = 0.4 * np.exp(-0.1 * time) * np.cos(8.0 * time)
    counts = np.round(angle * counts_per_rev / (2.0 * pi)).astype(int)
    if np.ptp(counts) >= period:
        pytest.skip("a counter has to hold the range of the swing")
    wrapped = (counts + period // 2 - 7 + period // 2) % period - period // 2
    assert np.ptp(wrapped) > 0.9 * period
    swing = read_swing(column("counts", wrapped, time), counts_per_rev=counts_per_rev)
    read = swing.theta * counts_per_rev / (2.0 * pi)
    # A period that is no power of two is found to a count.
    within = 1e-3 if period % 256 == 0 else 1.001
    np.testing.assert_allclose(read - read[0], counts - counts[0], atol=within)


def test_a_clock_of_32_bits_that_wraps_goes_on():
    stamps = (np.arange(2**32 - 2500, 2**32 + 2500, 1000) % 2**32).tolist()
    rows = "".join(f"{t},{t % 7}\n" for t in stamps)
    path = written("swing.csv", f"time_us,theta_rad\n{rows}")
    np.testing.assert_allclose(np.diff(read_swing(path).time), 1e-3, rtol=1e-6)


def test_a_repeated_row_counts_once():
    path = written("swing.csv", "time_s,theta_rad\n0,1\n0.1,2\n0.1,2\n0.2,2\n")
    assert read_swing(path).time.tolist() == [0.0, 0.1, 0.2]


HEAD = "time_s,theta_rad\n"
REFUSED = {
    "nothing": ("", ""),
    "two quantities": ("time_s,theta_rad,theta_deg\n0,1,2\n1,1,2\n", ""),
    "decimal commas between commas": (HEAD + "0,000,1,25\n0,010,1,24\n", ""),
    "repeated samples": (HEAD + "0,1\n0.1,2\n0.1,3\n", ""),
    "counts of an unknown encoder": ("time_s,counts\n0,1\n0.1,2\n", ""),
    "milliseconds since 1970 as seconds": (HEAD + "1.7e12,1\n1.7001e12,2\n", ""),
    "a control character": ("time_s,\x00theta_rad\n0,1\n", ""),
    "Latin-1": ("time_s,theta_rad,Länge\n0,1,ü\n".encode("latin-1"), ""),
    # It says where.
    "times that do not increase": (
        HEAD + "0,1\n0.1,2\n0.1,3\n0.3,3\n0.2,3\n",
        "2 of 5 .* after 0.1 s",
    ),
    "the line as an editor counts it": (HEAD + "0,1\n\n0.1,high\n", "line 4: .*'high'"),
    "the line of a number": (HEAD + "0,1\n\n0.1,2\n0.2,inf\n", "line 5: .*inf"),
    "the line that is short": (HEAD + "0,1\n0.1\n", "line 3: 1 cells, expected 2"),
}


@pytest.mark.parametrize(("content", "says"), REFUSED.values(), ids=REFUSED)
def test_a_file_that_cannot_be_used_is_refused_in_one_sentence(content, says):
    path = written("swing.csv", content)
    with pytest.raises(RecordingError, match=rf"swing\.csv.*{says}") as refusal:
        read_swing(path)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("options", [{"start": 5.0}, {"end": -1.0}, {"counts_per_rev": -4096}])
def test_a_window_without_samples_and_impossible_counts_are_refused(options):
    with pytest.raises(RecordingError):
        read_swing(column("counts", [1, 2, 3, 4]), **{"counts_per_rev": 4096} | options)
