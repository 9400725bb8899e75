"""The KST server's lines, both ways."""

import contextlib
import math
import re
import struct

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from equipoise.errors import InputError, LinkError
from equipoise.robots.kst import codec
from equipoise.robots.kst.codec import JOINTS, expect_numbers, java_double, setpoint, split_lines

Q = (0.0013, 0.4364, 0.0, -1.3962, 0.0, 1.309, 0.0)
FLOATS = st.floats(allow_nan=False, allow_infinity=False)
SEVEN = st.lists(FLOATS, min_size=JOINTS, max_size=JOINTS)
# As a JVM 17 prints them; from 19 on Java's own digits are the fewest, as here.
JAVA = {
    math.nan: "NaN", math.inf: "Infinity", -math.inf: "-Infinity", 0.0: "0.0",
    5e-324: "4.9E-324", 2e-323: "2.0E-323", 2.2250738585072014e-308: "2.2250738585072014E-308",
    1e-5: "1.0E-5", 1e-4: "1.0E-4", 7.513185688183855e-4: "7.513185688183855E-4",
    9.999e-4: "9.999E-4", 1e-3: "0.001", -0.0010000000000000002: "-0.0010000000000000002",
    2e-3: "0.002", 0.1 + 0.2: "0.30000000000000004", 0.4364: "0.4364", -1.3962: "-1.3962",
    5.0: "5.0", 100.0: "100.0", 1234567.0: "1234567.0", 9999999.0: "9999999.0", 1e7: "1.0E7",
    12345678.9: "1.23456789E7", 9007199254740992.0: "9.007199254740992E15", 1e21: "1.0E21",
    1.7976931348623157e308: "1.7976931348623157E308",
}  # fmt: skip


def test_setpoint_is_the_line_of_the_captured_session():
    assert setpoint(np.array(Q)) == b"jpJP_0.0013_0.4364_0_-1.3962_0_1.309_0_\n"
    assert setpoint(Q, torque=True).startswith(b"jpExT_")
    assert codec.PORT == 30001


@given(st.lists(SEVEN, min_size=20, max_size=20))
def test_setpoint_keeps_nine_digits_and_the_server_reads_them(setpoints):
    for q in setpoints:
        command, *fields, end = setpoint(q).decode().split("_")
        assert (command, len(fields), end) == ("jpJP", JOINTS, "\n")
        for value, field in zip(q, fields, strict=True):
            assert math.isclose(java_double(field), value, rel_tol=5.001e-9, abs_tol=1e-320)


WRONG_SETPOINTS = [
    Q[:6], (*Q, 0.0), (), (math.nan, *Q[1:]), (*Q[:6], math.inf), (*Q[:6], -math.inf),
    (*Q[:6], "a"), (*Q[:6], None), (*Q[:6], 1j), (*Q[:6], 10**400), np.zeros((7, 1)),
    np.zeros((1, 7)), 0.0, None,
]  # fmt: skip


@pytest.mark.parametrize("q", WRONG_SETPOINTS)
def test_only_seven_finite_numbers_are_sent(q):
    with pytest.raises(InputError, match="nothing was sent"):
        setpoint(q)


def test_stream_is_split_into_lines_however_it_is_cut():
    stream = b"jp_1_\n\ngetJointsPositions\r\n\r\nend\n"
    for cut in range(len(stream) + 1):
        lines, rest = split_lines(stream[:cut])
        later, _ = split_lines(rest + stream[cut:])
        assert lines + later == [b"jp_1_", b"getJointsPositions", b"end"]


def test_line_that_is_too_long_is_an_error():
    longest = b"x" * codec.MAX_LINE
    assert split_lines(longest) == ([], longest)
    assert split_lines(longest + b"\n" + longest) == ([longest], longest)
    for data in (longest + b"9", b"done\n" + longest + b"x\ndone\n"):
        with pytest.raises(LinkError, match="at most 1024 bytes"):
            split_lines(data)


def test_replies_of_the_captured_session_are_read():
    line = b"1.5855032851556873E-4_0.4364_0.0_-1.3962_0.0_1.309_0.0_"
    joints = (1.5855032851556873e-4, 0.4364, 0.0, -1.3962, 0.0, 1.309, 0.0)
    assert expect_numbers(line, JOINTS, "jpJP") == joints
    codec.expect_done(b"done", "jp")


NOT_SAID = [
    b"", b"Done", b"done_", b"ok", b"_",
    b"1.0", b"1.0_2.0",  # cut off: the trailing _ is missing
    b"1_2_", b"1_2.0_",
    b"1.0__2.0_", b"1.0e-4_", b"1.0E_", b"+1.0_", b".5_", b" 1.0_",  # no Java numbers
    b"1.0_\x00", b"\xff\xfe_", "١.٠_".encode(), b"nan_",
    b"NaN_0.0_", b"Infinity_", b"-Infinity_", b"1.0E999_", b"0.0_1.0E999_",  # not finite
]  # fmt: skip


@pytest.mark.parametrize("line", NOT_SAID)
def test_what_the_server_may_not_say_is_a_link_error(line):
    for count in (1, 2):
        with pytest.raises(LinkError):
            expect_numbers(line, count, "jpJP")
    with pytest.raises(LinkError):
        codec.expect_done(line, "jp")


@pytest.mark.parametrize(("value", "text"), JAVA.items())
def test_numbers_are_written_as_java_writes_them(value, text):
    assert codec.java_number(value) == text
    assert codec.numbers_reply((value, 1.5)) == f"{text}_1.5_\n".encode()


@given(st.lists(FLOATS, min_size=50, max_size=50))
@example([1e-3, 1e7, 9999999.999999998, 0.0009999999999999998, -1e-3, -1e7] * 9)
def test_java_numbers_come_back_to_the_last_bit(values):
    for value in values:
        text = codec.java_number(value)
        assert struct.pack("d", float(text)) == struct.pack("d", value)
        assert struct.pack("d", java_double(text)) == struct.pack("d", value)
        if value == 0.0 or 1e-3 <= abs(value) < 1e7:
            assert re.fullmatch(r"-?(0|[1-9]\d*)\.(0|\d*[1-9])", text)
        else:
            assert re.fullmatch(r"-?[1-9]\.(0|\d*[1-9])E-?[1-9]\d*", text)


READ = {
    "0.1": 0.1, "1e-5": 1e-5, "-3": -3.0, " +.5 ": 0.5, "5.": 5.0, "1d": 1.0, "2.5F": 2.5,
    "Infinity": math.inf, "-Infinity": -math.inf,
}  # fmt: skip


@pytest.mark.parametrize(("text", "value"), READ.items())
def test_java_reads_numbers(text, value):
    assert java_double(text) == value


@pytest.mark.parametrize("text", ["", "nan", "inf", "0x1p3", "1,5", "1.0x", "- 1"])
def test_what_java_does_not_parse_is_refused(text):
    with pytest.raises(InputError):
        java_double(text)


SAID = st.one_of(
    st.binary(max_size=40),
    st.text(alphabet="0123456789.E-_+nakdoeINf\r ", max_size=60).map(str.encode),
)


@given(st.lists(SAID, min_size=100, max_size=100))
def test_whatever_is_said_is_read_or_refused(said):
    for line in split_lines(b"\n".join(said) + b"\n")[0]:
        with contextlib.suppress(LinkError):
            assert all(map(math.isfinite, expect_numbers(line, line.count(b"_"), "jpJP")))
        for field in line.decode("latin-1").split("_"):
            with contextlib.suppress(InputError):
                assert isinstance(java_double(field), float)
