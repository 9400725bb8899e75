"""The E-line protocol: what is a line, what is none, and what a damaged one can pass for."""

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from equipoise.robots.encoder import codec
from equipoise.robots.encoder.codec import Banner, Decoder, Reading, decode, encode

READINGS = st.builds(
    Reading, st.integers(0, 2**16 - 1), st.integers(0, 2**32 - 1),
    st.integers(-(2**31), 2**31 - 1), st.integers(0, 15),
)  # fmt: skip
EXAMPLE = Reading(1023, 123456789, -4096, 1)


def signed(body):
    """Return a line with the right checksum, found bit by bit from the polynomial as printed."""
    register = 0
    for byte in body:
        for place in range(8):
            carry = (register & 1) ^ (byte >> place & 1)
            register = register >> 1 ^ (0b10001100 if carry else 0)
    return body + b"*%02X" % register


def test_the_checksum_is_crc_8_maxim():
    assert codec.crc8(b"") == 0
    assert codec.crc8(b"123456789") == 0xA1
    # The ROM code of a 1-Wire chip in Maxim's application note 27.
    assert codec.crc8(bytes.fromhex("021CB801000000")) == 0xA2


@given(READINGS)
@example(Reading(0, 0, -(2**31), 0))
@example(Reading(2**16 - 1, 2**32 - 1, 2**31 - 1, 15))
def test_every_reading_comes_back(reading):
    line = encode(reading)
    assert line.endswith(b"\n")
    assert line[:-1] == signed(line[:-4])
    assert decode(line[:-1]) == reading


WRONG = """
E|E,1,2,3|E,1,2,3,0,0|E,01,2,3,0|E,+1,2,3,0|E, 1,2,3,0|E,1,2,-0,0|E,1,2,03,0|E,1,2,--3,0
E,-1,2,3,0|E,1,-2,3,0|E,1,2,3,|E,1,2,,0|E,1,2,3,a|E,1,2,3,00|E,1,2,3,G|E,1,2,3.0,0|E,1_0,2,3,0
E,١,2,3,0|E,65536,2,3,0|E,1,4294967296,3,0|E,1,2,2147483648,0|E,1,2,-2147483649,0|e,1,2,3,0
 E,1,2,3,0|E,1,2,3,0 |E,1,2,3,0\r|X,1,2,3,0|I,pico,1.0,8192|I,1pico,1.0,8192,1000
I,pico,,8192,1000|I,pico,1.0,08192,1000|I,pico,1.0,-8192,1000|I,pico,1.0,8192,0|
"""


@pytest.mark.parametrize("body", [body for line in WRONG.split("\n") for body in line.split("|")])
def test_another_spelling_is_no_line_even_with_its_checksum(body):
    assert decode(signed(body.encode())) is None


def test_a_banner_with_a_wrong_checksum_is_none():
    banner = Banner("pico", "1.0", 8192, 1000)
    line = encode(banner)[:-1]
    assert decode(line) == banner
    assert decode(line[:-1] + (b"0" if line[-1:] != b"0" else b"1")) is None


# A stream of bytes.


@given(st.lists(READINGS, max_size=5), st.binary(max_size=40), st.lists(st.integers(0, 60)))
def test_lines_come_back_however_they_are_cut(readings, before, cuts):
    stream = before.replace(b"\n", b"") + b"\n" + b"".join(encode(reading) for reading in readings)
    decoder, got = Decoder(), []
    for cut in cuts:
        got += decoder.feed(stream[:cut])
        stream = stream[cut:]
    assert got + decoder.feed(stream) == readings
    assert decoder.rejected == 0


def test_lines_that_are_too_long_are_counted_with_the_damaged_ones():
    decoder = Decoder()
    decoder.feed(b"\nE,1\n" + b"x" * 97 + b"\n" + b"y" * 96 + b"\n")
    assert decoder.rejected == 3
    decoder.feed(b"z" * 96)
    assert decoder.rejected == 3
    decoder.feed(b"z")
    assert decoder.rejected == 4


@given(st.lists(st.binary(max_size=200), max_size=10))
def test_no_bytes_make_it_raise(pieces):
    decoder = Decoder()
    for piece in pieces:
        for said in decoder.feed(piece):
            assert decode(encode(said)[:-1]) == said
        decode(piece)


ASKED = {
    b"?\n": 1, b"?": 0, b"?\r\n": 1, b"?\r": 1, b"\n\n?\n?\n": 2, b"??\n": 0, b" ?\n": 0,
    b"?x\n?\n": 1, b"?z": 0, b"x?\n": 0, b"": 0,
}  # fmt: skip


@pytest.mark.parametrize(("sent", "asked"), ASKED.items())
def test_a_question_is_a_mark_alone_on_its_line(sent, asked):
    assert codec.count_requests(sent)[0] == asked
    total, rest = 0, b""
    for byte in sent:
        requests, rest = codec.count_requests(rest + bytes([byte]))
        total += requests
    assert total == asked


# Damage.


def bursts(stream, least_first):
    """Return the stream with every change within eight neighbouring bits, one after the other."""
    bits = 8 * len(stream)
    whole = int.from_bytes(stream, "little" if least_first else "big")
    for start in range(bits):
        for pattern in range(1, 256, 2):
            if start + pattern.bit_length() <= bits:
                changed = whole ^ pattern << start
                yield changed.to_bytes(len(stream), "little" if least_first else "big")


def test_no_burst_of_eight_bits_passes_for_another_reading():
    # Over three lines, their stars, checksums and ends included: all that one burst can touch.
    readings = {Reading(1022, 123455789, -4095, 0), EXAMPLE, Reading(1024, 123457789, 0, 15)}
    stream = b"".join(encode(reading) for reading in sorted(readings))
    # On a wire the least bit of a byte goes first; in memory one writes the greatest first.
    for least_first in (True, False):
        tried = 0
        for damaged in bursts(stream, least_first):
            assert set(Decoder().feed(b"\n" + damaged)) <= readings, damaged
            tried += 1
        assert tried == 128 * (8 * len(stream) - 7) + 127
