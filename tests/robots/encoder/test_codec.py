"""The E-line protocol: what is a line, what is none, and what a damaged one can pass for."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from equipoise.errors import InputError
from equipoise.robots.encoder.codec import (
    MAX_LINE,
    REQUEST,
    Banner,
    Decoder,
    Flags,
    Reading,
    Requests,
    crc8,
    decode,
    encode,
)

READINGS = st.builds(
    Reading,
    st.integers(0, 2**16 - 1),
    st.integers(0, 2**32 - 1),
    st.integers(-(2**31), 2**31 - 1),
    st.integers(0, 15),
)
EXAMPLE = Reading(1023, 123456789, -4096, 1)


def signed(body):
    """Return a line with the right checksum, found bit by bit from the polynomial as printed."""
    register = 0
    for byte in body:
        for place in range(8):
            carry = (register & 1) ^ (byte >> place & 1)
            register = register >> 1 ^ (0b10001100 if carry else 0)
    return body + b"*%02X" % register


def test_the_constants_are_those_of_the_firmware():
    """As `firmware/` has them, and docs/reference/e-line.md."""
    assert (REQUEST, MAX_LINE) == (b"?\n", 96)
    flags = (Flags.DOWN, Flags.PRESSED, Flags.INDEX, Flags.ILLEGAL)
    assert [int(flag) for flag in flags] == [1, 2, 4, 8]


def test_the_checksum_is_crc_8_maxim():
    assert crc8(b"") == 0
    assert crc8(b"123456789") == 0xA1
    # The ROM code of a 1-Wire chip in Maxim's application note 27.
    assert crc8(bytes.fromhex("021CB801000000")) == 0xA2


@given(READINGS)
@example(Reading(0, 0, -(2**31), 0))
@example(Reading(2**16 - 1, 2**32 - 1, 2**31 - 1, 15))
def test_every_reading_comes_back(reading):
    line = encode(reading)
    assert line.endswith(b"\n")
    assert line[:-1] == signed(line[:-4])
    assert decode(line[:-1]) == reading


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"E",
        b"E,1,2,3",
        b"E,1,2,3,0,0",
        b"E,01,2,3,0",
        b"E,+1,2,3,0",
        b"E, 1,2,3,0",
        b"E,1,2,-0,0",
        b"E,1,2,03,0",
        b"E,1,2,--3,0",
        b"E,-1,2,3,0",
        b"E,1,-2,3,0",
        b"E,1,2,3,",
        b"E,1,2,,0",
        b"E,1,2,3,a",
        b"E,1,2,3,00",
        b"E,1,2,3,G",
        b"E,1,2,3.0,0",
        b"E,1_0,2,3,0",
        "E,١,2,3,0".encode(),
        b"E,65536,2,3,0",
        b"E,1,4294967296,3,0",
        b"E,1,2,2147483648,0",
        b"E,1,2,-2147483649,0",
        b"e,1,2,3,0",
        b" E,1,2,3,0",
        b"E,1,2,3,0 ",
        b"E,1,2,3,0\r",
        b"X,1,2,3,0",
        b"I,pico,1.0,8192",
        b"I,1pico,1.0,8192,1000",
        b"I,pico,,8192,1000",
        b"I,pico,1.0,08192,1000",
        b"I,pico,1.0,-8192,1000",
        b"I,pico,1.0,8192,0",
    ],
)
def test_another_spelling_is_no_line_even_with_its_checksum(body):
    assert decode(signed(body)) is None


def test_a_banner_with_a_wrong_checksum_is_none():
    line = encode(Banner("pico", "1.0", 8192, 1000))[:-1]
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
    decoder, requests = Decoder(), Requests()
    for piece in pieces:
        for said in decoder.feed(piece):
            assert decode(encode(said)[:-1]) == said
        requests.feed(piece)
        decode(piece)


@pytest.mark.parametrize(
    ("sent", "asked"),
    [
        (b"?\n", 1),
        (b"?", 0),
        (b"?\r\n", 1),
        (b"?\r", 1),
        (b"\n\n?\n?\n", 2),
        (b"??\n", 0),
        (b" ?\n", 0),
        (b"?x\n?\n", 1),
        (b"?z", 0),
        (b"x?\n", 0),
        (b"", 0),
    ],
)
def test_a_question_is_a_mark_alone_on_its_line(sent, asked):
    assert Requests().feed(sent) == asked
    requests = Requests()
    assert sum(requests.feed(bytes([byte])) for byte in sent) == asked


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


def heard(stream):
    """Return what is read between two silent ends of lines."""
    return Decoder().feed(b"\n" + stream)


def no_burst_passes_for_another_reading(readings):
    lines = [encode(reading) for reading in readings]
    stream = b"".join(lines)
    # On a wire the least bit of a byte goes first; in memory one writes the greatest first.
    for least_first in (True, False):
        tried = 0
        for damaged in bursts(stream, least_first):
            assert set(heard(damaged)) <= set(readings), damaged
            tried += 1
        assert tried == 128 * (8 * len(stream) - 7) + 127


def some_readings(seed, n):
    """Return readings of all lengths that follow each other."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        seq, t_us, count = (
            int(rng.integers(10 ** rng.integers(1, digits + 1))) for digits in (4, 9, 9)
        )
        count *= int(rng.choice((-1, 1)))
        yield [
            Reading(seq + i, t_us + 1000 * i, count + i, int(rng.integers(16))) for i in range(3)
        ]


def test_no_burst_of_eight_bits_passes_for_another_reading():
    # Over three lines, their stars, checksums and ends included: all that one burst can touch.
    no_burst_passes_for_another_reading(
        [Reading(1022, 123455789, -4095, 0), EXAMPLE, Reading(1024, 123457789, 0, 15)]
    )


def share_that_passes(damage, n, seed):
    """Return which share of differently damaged lines passes for another reading."""
    rng = np.random.default_rng(seed)
    tried = passed = 0
    while tried < n:
        reading = Reading(
            int(rng.integers(2**16)),
            int(rng.integers(2**32)),
            int(rng.integers(-(10**5), 10**5)),
            0,
        )
        line = encode(reading)[:-1]
        damaged = damage(rng, line)
        if damaged == line or b"\n" in damaged:
            continue
        tried += 1
        passed += decode(damaged) is not None
    return passed / tried


def digits_changed(rng, line):
    """Change the digits of a field into others: what the grammar cannot see."""
    body = bytearray(line)
    places = [i for i, byte in enumerate(body[:-3]) if 0x31 <= byte <= 0x39]
    for place in rng.choice(places, size=min(4, len(places)), replace=False):
        body[place] = 0x31 + int(rng.integers(9))
    return bytes(body)


def two_far_bits(rng, line):
    body = bytearray(line)
    for place in rng.integers(8 * len(line), size=2):
        body[place // 8] ^= 1 << place % 8
    return bytes(body)


def bytes_changed(rng, line):
    body = bytearray(line)
    for place in rng.integers(len(line), size=int(rng.integers(2, 6))):
        body[place] = int(rng.integers(256))
    return bytes(body)


def a_piece_lost(rng, line):
    place = int(rng.integers(len(line)))
    return line[:place] + line[place + int(rng.integers(1, 8)) :]


def two_lines_as_one(rng, line):
    other = encode(Reading(*(int(n) for n in rng.integers(10**4, size=3)), 0))[:-1]
    return line[: int(rng.integers(len(line)))] + other[int(rng.integers(len(other))) :]


DAMAGES = (digits_changed, two_far_bits, bytes_changed, a_piece_lost, two_lines_as_one)


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda damage: damage.__name__)
def test_other_damage_passes_at_most_once_in_128(damage):
    # Eight bits let 1/256 of wholly random damage pass; 10,000 trials put 1/128 six deviations off.
    assert share_that_passes(damage, 10_000, 1) <= 1 / 128


# Noise, a great deal of it.

GRAINS = st.sampled_from(
    [b"E,", b"I,", b",", b"*", b"\n", b"\r", b"-", b"0", b"1", b"9", b"F", b"?", b"\x00", b"\xff"]
)


def noisy(grains, seed, lines):
    """Return a stream of noise, true lines, damaged lines and what looks almost like lines."""
    rng = np.random.default_rng(seed)
    stream = bytearray()
    for i in range(lines):
        kind = int(rng.integers(4))
        if kind == 0:
            body = b"".join(grains[int(k)] for k in rng.integers(len(grains), size=12))
        elif kind == 1:
            body = rng.bytes(int(rng.integers(40)))
        else:
            body = encode(Reading(i % 65536, int(rng.integers(2**32)), i, 0))[:-1]
            if kind == 3:
                body = DAMAGES[int(rng.integers(len(DAMAGES)))](rng, body)
        stream += body + b"\n"
    return bytes(stream)


def survives(grains, seed, lines, cut):
    stream = noisy(grains, seed, lines)
    decoder, got = Decoder(), 0
    for at in range(0, len(stream), cut):
        for said in decoder.feed(stream[at : at + cut]):
            # Whatever is accepted is a line of the protocol, in its one spelling.
            assert decode(encode(said)[:-1]) == said
            got += 1
    assert got + decoder.rejected >= lines - 1
    return got


@settings(max_examples=20)
@given(st.lists(GRAINS, min_size=1, max_size=8), st.integers(0, 2**32), st.integers(1, 4096))
def test_noise_never_makes_it_raise(grains, seed, cut):
    survives(grains, seed, 100, cut)


def test_a_reading_that_no_line_can_hold_is_refused():
    with pytest.raises(InputError):
        encode(EXAMPLE._replace(seq=2**16))
