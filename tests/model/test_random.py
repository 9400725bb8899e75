"""Philox against the published known answers, and its numbers against their distributions.

Statistics run on fixed seeds, so that they never fail by luck on code that has not changed. A fair
generator with other seeds gives a p-value below 1e-5, or a z-score above 5 (which is rarer), in one
of the some 70 tests with a chance below 1e-3.
"""

from math import sqrt

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy import stats

from equipoise.jit import kernel
from equipoise.model import random
from equipoise.model.random import normal_pair, philox, uniform

WORD = 2**32
TOP = WORD - 1
word = st.integers(0, TOP)
COUNT = 100_000
P_VALUE = 1e-5
Z_SCORE = 5.0


def plain(function):
    """Return a kernel as the Python that one reads."""
    return getattr(function, "py_func", function)


def seed_of(key):
    """Return the seed whose 64 bits, in two's complement, are the two words of a key."""
    bits = key[0] | key[1] << 32
    return bits - 2**64 if bits >= 2**63 else bits


def words(counter, key):
    """Return the words of a counter (four words) and a key (two words), both low word first."""
    return tuple(int(number) for number in philox(seed_of(key), *counter))


@kernel
def filled(out, seed, learner, stream, by_index):
    """Fill a block of words, one row for each step (or index)."""
    for i in range(out.shape[0]):
        step, index = (0, i) if by_index else (i, 0)
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = philox(seed, step, index, learner, stream)


def block(count=COUNT, seed=0, learner=0, stream=1, by_index=False):
    out = np.zeros((count, 4), np.int64)
    filled(out, seed, learner, stream, by_index)
    return out


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
    assert plain(philox)(key[0] | key[1] << 32, *counter) == answer


@given(seed=st.integers(0, 2**63 - 1), counter=st.tuples(word, word, word, word))
@example(seed=2**63 - 1, counter=(TOP, TOP, TOP, TOP))
def test_compiled_words_are_those_of_python_integers(seed, counter):
    # Python's integers do not wrap around, machine integers do.
    assert words(counter, (seed & TOP, seed >> 32)) == plain(philox)(seed, *counter)


@pytest.mark.parametrize("place", range(5))
def test_each_of_seed_step_index_learner_and_stream_matters(place):
    numbers = [3, 1, 4, 1, 5]
    seen = set()
    for _ in range(200):
        seen.add(tuple(int(number) for number in philox(*numbers)))
        numbers[place] += 1
    assert len(seen) == 200


def test_each_bit_of_counter_and_key_turns_half_of_the_words_bits():
    def bits(numbers):
        return np.array([[n >> i & 1 for i in range(32)] for n in numbers]).ravel()

    rng = np.random.default_rng(1)
    turned = []
    for _ in range(20):
        counter, key = rng.integers(0, WORD, 4).tolist(), rng.integers(0, WORD, 2).tolist()
        base = bits(words(counter, key))
        for place in range(6):
            for bit in range(0, 32, 5):
                other = [*counter, *key]
                other[place] ^= 1 << bit
                turned.append(np.sum(base != bits(words(other[:4], other[4:]))))
    # Binomial with n = 128, p = 1/2: mean 64, variance 32.
    z = (np.mean(turned) - 64) / sqrt(32 / len(turned))
    assert abs(z) < Z_SCORE
    assert np.var(turned) == pytest.approx(32, rel=0.2)
    assert min(turned) > 64 - 6 * sqrt(32)


@pytest.mark.compiled_only
@pytest.mark.parametrize("by_index", [False, True])
@pytest.mark.parametrize("column", range(4))
def test_words_are_uniform(column, by_index):
    numbers = block(by_index=by_index)[:, column] / WORD
    assert stats.kstest(numbers, "uniform").pvalue > P_VALUE
    counts = np.bincount((numbers * 256).astype(int), minlength=256)
    assert stats.chisquare(counts).pvalue > P_VALUE
    for power in (1, 2, 3):
        mean, square = 1 / (power + 1), 1 / (2 * power + 1)
        sigma = sqrt((square - mean**2) / COUNT)
        assert abs(np.mean(numbers**power) - mean) < Z_SCORE * sigma


def correlation_z(a, b):
    """Return the z-score of a correlation that is zero where `a` and `b` are independent."""
    return np.corrcoef(a, b)[0, 1] * sqrt(len(a))


@pytest.mark.parametrize(
    "other",
    [
        {"seed": 1},
        {"seed": WORD},
        {"learner": 1},
        {"stream": 2},
        {"stream": 12},
        {"by_index": True},
    ],
    ids=str,
)
@pytest.mark.compiled_only
def test_seeds_learners_streams_and_episodes_are_independent(other):
    here, there = block()[1:] / WORD, block(**other)[1:] / WORD
    for column in range(4):
        assert abs(correlation_z(here[:, column], there[:, column])) < Z_SCORE
        both = np.histogram2d(here[:, column], there[:, column], bins=8)[0]
        assert stats.chisquare(both.ravel()).pvalue > P_VALUE


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


@kernel
def normals(numbers, out):
    """Make pairs of normal numbers of words."""
    for i in range(numbers.shape[0]):
        out[i, 0], out[i, 1] = normal_pair(numbers[i, 0], numbers[i, 1])
        out[i, 2], out[i, 3] = normal_pair(numbers[i, 2], numbers[i, 3])


@pytest.mark.compiled_only
def test_pairs_are_standard_normal_and_independent():
    out = np.zeros((COUNT, 4))
    normals(block(seed=2), out)
    for column in out.T:
        assert stats.kstest(column, "norm").pvalue > P_VALUE
        # Moments of a standard normal number and their standard errors.
        for power, mean, variance in [(1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96)]:
            error = np.mean(column**power) - mean
            assert abs(error) < Z_SCORE * sqrt(variance / COUNT), power
    for i in range(4):
        for j in range(i):
            assert abs(correlation_z(out[:, i], out[:, j])) < Z_SCORE
            assert abs(correlation_z(out[:, i] ** 2, out[:, j] ** 2)) < Z_SCORE
    # Tails: beyond 4 sigma there are 6.33e-5 of the numbers, here 25 of 400,000.
    beyond = int(np.sum(np.abs(out) > 4))
    expected = 4 * COUNT * 2 * stats.norm.sf(4)
    assert stats.binomtest(beyond, 4 * COUNT, expected / (4 * COUNT)).pvalue > P_VALUE
