"""The firmware on this machine: its protocol core byte by byte, and the whole sketch.

Pins, time and serial port of the sketch are a test's (`Arduino.h` beside this file); that it also
compiles for each board is for the Arduino IDE to show (firmware/README.md).
"""

import itertools
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from equipoise.robots.encoder.codec import (
    Banner,
    Decoder,
    Flags,
    Reading,
    count_requests,
    decode,
    encode,
)

HERE = Path(__file__).parent
SKETCH = HERE.parents[1] / "firmware" / "equipoise_encoder"
COMPILER = shutil.which("g++")

pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no g++ to compile it with")


def compiled(folder, *sources):
    program = folder / "program"
    strict = ["-std=c++11", "-O1", "-Wall", "-Wextra", "-Wconversion", "-Werror"]
    checks = ["-fsanitize=undefined,address", "-fno-sanitize-recover=all"]
    command = [COMPILER, *strict, *checks, f"-I{SKETCH}", f"-I{HERE}", "-o", program, *sources]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return program


@pytest.fixture(scope="module")
def core(tmp_path_factory):
    return compiled(tmp_path_factory.mktemp("core"), HERE / "core.cpp", SKETCH / "eline.cpp")


@pytest.fixture(scope="module")
def sketch(tmp_path_factory):
    return compiled(tmp_path_factory.mktemp("sketch"), HERE / "sketch.cpp", SKETCH / "eline.cpp")


def told(program, commands):
    """Return what a program writes, as bytes."""
    asked = "\n".join(commands).encode()
    done = subprocess.run([program], input=asked, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout


def test_readings_are_the_codecs_byte_for_byte(core):
    rng = np.random.default_rng(0)
    readings = [
        Reading(0, 0, 0, 0),
        Reading(65535, 2**32 - 1, 2**31 - 1, 15),
        Reading(65535, 2**32 - 1, -(2**31), 15),
    ]
    for _ in range(10_000):
        seq, t_us, counts = (int(rng.integers(2 ** rng.integers(1, b))) for b in (17, 33, 32))
        counts *= int(rng.choice((-1, 1)))
        readings.append(Reading(seq, t_us, counts, int(rng.integers(16))))
    commands = [f"reading {r.seq} {r.t_us} {r.counts} {r.flags}" for r in readings]
    assert told(core, commands) == b"".join(encode(reading) for reading in readings)


def test_banners_are_the_codecs_or_refused_as_there(core):
    longest = Banner("A" * 32, "1" * 16, 999_999_999, 999_999)
    good = [Banner("pico_2-b", "1.0", 8192, 1000), longest]
    bad = [
        longest._replace(**change)
        for change in (
            *({"name": "A" * 33}, {"name": "1a"}, {"firmware": "1" * 17}),
            *({"counts_per_rev": 0}, {"rate_hz": 0}, {"rate_hz": 1_000_000}),
        )
    ]
    for banner in bad:
        assert decode(encode(banner)[:-1]) is None
    banners = [*good, *bad]
    expected = b"".join(map(encode, good)) + len(bad) * b"refused\n"
    commands = [f"banner {b.name} {b.firmware} {b.counts_per_rev} {b.rate_hz}" for b in banners]
    assert told(core, commands) == expected


def test_questions_are_found_as_the_codec_finds_them(core):
    rng = np.random.default_rng(2)
    letters = np.array([*b"??\n\rx"])
    sent = [bytes(rng.choice(letters, size=int(n)).tolist()) for n in rng.integers(12, size=2000)]
    # A mark before the digits lets nothing be something.
    asked = [int(n) for n in told(core, [f"ask :{data.hex()}" for data in sent]).split()]
    assert asked == [count_requests(data)[0] for data in sent]
    assert sum(asked) > 500


def reference(before, after):
    """Return the count and the flag of a transition, from the cycle that A and B run through."""
    cycle = [0b00, 0b10, 0b11, 0b01]  # A leads
    steps = (cycle.index(after) - cycle.index(before)) % 4
    return {0: (0, 0), 1: (1, 0), 2: (0, 1), 3: (-1, 0)}[steps]


def test_a_long_walk_of_the_lines_is_counted(core):
    rng = np.random.default_rng(3)
    walk = [0, *(int(ab) for ab in rng.integers(4, size=5000))]
    said = told(core, ["begin 0", *(f"step {ab}" for ab in walk[1:])]).split()
    counts = 0
    for i, (before, after) in enumerate(itertools.pairwise(walk)):
        step, illegal = reference(before, after)
        counts += step
        assert (int(said[2 * i]), int(said[2 * i + 1])) == (counts, illegal)


# The sketch.


def lines_of(sketch, commands):
    decoder = Decoder()
    said = decoder.feed(b"\n" + told(sketch, commands))
    assert decoder.rejected == 0
    return said


def running(begin, end, step=250):
    return [f"at {t % 2**32}" for t in range(begin, end, step)]


def test_the_sketch_introduces_itself_and_sends_a_line_each_millisecond(sketch):
    begin = 2**32 - 20_000
    banner, *lines = lines_of(sketch, [f"boot {begin}", *running(begin, begin + 40_001)])
    assert banner == Banner("equipoise-encoder", "1.0", 8192, 1000)
    assert [line.seq for line in lines] == list(range(40))
    assert [line.t_us for line in lines] == [(begin + 1000 * (i + 1)) % 2**32 for i in range(40)]


def test_the_sketch_counts_what_the_lines_do(sketch):
    # A and B start high. A falls first: A leads, the count grows.
    forwards = [(2, 0), (3, 0), (2, 1), (3, 1)]
    backwards = [(pin, 1 - level) for pin, level in reversed(forwards)]
    commands = ["boot 0"]
    for i, (pin, level) in enumerate(25 * forwards + 15 * backwards, start=1):
        commands += [f"pin {pin} {level}", f"at {250 * i}"]
    lines = [line for line in lines_of(sketch, commands) if isinstance(line, Reading)]
    assert [line.counts for line in lines[:25]] == [4 * (i + 1) for i in range(25)]
    assert lines[-1].counts == 40
    assert all(line.flags == 0 for line in lines)


def test_the_sketch_tells_an_illegal_transition_once(sketch):
    commands = ["boot 0", *running(0, 2500), "both", *running(2500, 6000)]
    lines = [line for line in lines_of(sketch, commands) if isinstance(line, Reading)]
    assert [line.flags for line in lines] == [0, 0, Flags.ILLEGAL, 0, 0]


def test_the_sketch_tells_the_button_without_its_bounce(sketch):
    commands = ["boot 0", *running(0, 10_000)]
    for bounce in range(4):
        commands += [f"pin 4 {bounce % 2}", *running(10_000 + 500 * bounce, 10_500 + 500 * bounce)]
    commands += ["pin 4 0", *running(12_000, 20_000), "pin 4 1", *running(20_000, 30_000)]
    lines = [line for line in lines_of(sketch, commands) if isinstance(line, Reading)]
    assert sum(bool(line.flags & Flags.PRESSED) for line in lines) == 1
    down = [line.t_us for line in lines if line.flags & Flags.DOWN]
    assert down == list(range(10_000, 20_000, 1000))


def test_the_sketch_answers_a_question(sketch):
    commands = ["boot 0", *running(0, 3000), "ask", *running(3000, 6000)]
    said = lines_of(sketch, commands)
    assert [type(line) for line in said].count(Banner) == 2
    assert isinstance(said[3], Banner)


def test_lines_without_room_are_lost_whole_and_their_flags_wait(sketch):
    commands = ["boot 0", *running(0, 10_500), "room 10", "both", "pin 4 0"]
    commands += [*running(10_500, 13_500), "room 100", *running(13_500, 16_000)]
    lines = [line for line in lines_of(sketch, commands) if isinstance(line, Reading)]
    assert [line.seq for line in lines[8:]] == [8, 9, 13, 14]
    assert lines[10].flags == Flags.DOWN | Flags.PRESSED | Flags.ILLEGAL
    assert lines[11].flags == Flags.DOWN


def test_a_late_board_counts_the_periods_it_missed(sketch):
    commands = ["boot 0", *running(0, 3001), "at 7200", *running(7250, 9001)]
    lines = [line for line in lines_of(sketch, commands) if isinstance(line, Reading)]
    later = [(line.seq, line.t_us) for line in lines[2:]]
    assert later == [(2, 3000), (6, 7200), (7, 8000), (8, 9000)]
