"""Philox against the published known answers, and normal numbers against their distribution.

Statistics run on fixed seeds, so that they never fail by luck on code that has not changed.
"""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from equipoise.model import random
from equipoise.model.random import normal_pair, philox, uniform

WORD = 2**32
TOP = WORD - 1
word = st.integers(0, TOP)
uncompiled = getattr(philox, "py_func", philox)


def seed_of(key):
    """Return the seed whose 64 bits, in two's complement, are the two words of a key."""
    bits = key[0] | key[1] << 32
    return bits - 2**64 if bits >= 2**63 else bits


def words(counter, key):
    """Return the words of a counter (four words) and a key (two words), both low word first."""
    return tuple(int(number) for number in philox(seed_of(key), *counter))


@pytest.mark.parametrize(
    ("counter", "key", "answer"),
    # Random123, tests/kat_vectors, "philox4x32 10".
    [
        ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((TOP, TOP, TOP, TOP), (TOP, TOP), (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_philox_gives_the_known_answers(counter, key, answer):
    assert words(counter, key) == answer
    assert uncompiled(key[0] | key[1] << 32, *counter) == answer


@given(seed=st.integers(0, 2**63 - 1), counter=st.tuples(word, word, word, word))
@example(seed=2**63 - 1, counter=(TOP, TOP, TOP, TOP))
def test_compiled_words_are_those_of_python_integers(seed, counter):
    # Python's integers do not wrap around, machine integers do.
    assert words(counter, (seed & TOP, seed >> 32)) == uncompiled(seed, *counter)


def test_no_two_purposes_share_a_stream():
    # Noise takes six words: those of its stream and of the one after it.
    single = (random.TRAINING_EPISODE, random.TRAINING_START, random.TRAINING_ACTION)
    double = (random.TRAINING_NOISE, random.SELECTION, random.TARGET_TEST, random.TEST)
    taken = [*single, *double, *(stream + 1 for stream in double)]
    assert len(set(taken)) == len(taken)


def test_uniform_reaches_its_lower_end_and_never_its_upper_one():
    assert uniform(0, -3.0, 5.0) == -3.0
    assert uniform(TOP, -3.0, 5.0) < 5.0
    assert uniform(TOP, -3.0, 5.0) == pytest.approx(5.0, rel=1e-8)
    assert uniform(WORD // 2, -3.0, 5.0) == 1.0
    assert uniform(0, 1.0, 0.0) == 1.0
    assert 0.0 < uniform(TOP, 1.0, 0.0) < 1e-9


@given(word0=word, word1=word)
def test_a_pair_is_that_of_box_and_muller(word0, word1):
    radius = np.sqrt(-2 * np.log(1 - word0 / WORD))
    angle = 2 * np.pi * word1 / WORD
    got = normal_pair(word0, word1)
    # Polynomials against the library's functions: a few units in the last place of the radius.
    assert got == pytest.approx((radius * np.cos(angle), radius * np.sin(angle)), abs=1e-14)
