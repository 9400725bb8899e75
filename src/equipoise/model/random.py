"""Counter-based random numbers for kernels: equal key and counter give equal bits.

Philox 4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", 2011). The generator
has no state: every episode can be replayed alone, and results do not depend on the number of
workers. Key and counter identify each draw::

    key      seed (64 bits)
    counter  step, index (episode or trial), part (such as a joint), stream
"""

from math import pi, sqrt
from typing import Final

from equipoise.elementary import log, sincos
from equipoise.jit import inlined

Words = tuple[int, int, int, int]

MASK: Final = 0xFFFFFFFF
TO_UNIT: Final = 1.0 / 4294967296.0

# Streams: each purpose has its own counter, and training, selection and test never share numbers.
# Noise uses its stream and the next one.
TRAINING_EPISODE: Final = 1
TRAINING_START: Final = 2
TRAINING_ACTION: Final = 3
TRAINING_NOISE: Final = 4
TRAINING_ACTUATOR: Final = 6
SELECTION: Final = 8
TARGET_TEST: Final = 10
TEST: Final = 12
ENVIRONMENT: Final = 14
DEPLOYMENT: Final = 16
MAP: Final = 18
TWIN: Final = 20
"""First of the four streams of the twin."""


@inlined
def philox(seed: int, step: int, index: int, part: int, stream: int) -> Words:
    """Return four random words of 32 bits."""
    # Compiled code with 64-bit wrap-around and Python's long integers give the same result.
    c0, c1 = int(step) & MASK, int(index) & MASK
    c2, c3 = int(part) & MASK, int(stream) & MASK
    k0, k1 = int(seed) & MASK, (int(seed) >> 32) & MASK
    for _ in range(10):
        product0 = 0xD2511F53 * c0
        product1 = 0xCD9E8D57 * c2
        c0, c1, c2, c3 = (
            ((product1 >> 32) & MASK) ^ c1 ^ k0,
            product1 & MASK,
            ((product0 >> 32) & MASK) ^ c3 ^ k1,
            product0 & MASK,
        )
        k0 = (k0 + 0x9E3779B9) & MASK
        k1 = (k1 + 0xBB67AE85) & MASK
    return c0, c1, c2, c3


@inlined
def uniform(word: int, low: float, high: float) -> float:
    """Map a word to a uniform number in [low, high); (0, 1] is `uniform(word, 1.0, 0.0)`."""
    return low + (high - low) * (word * TO_UNIT)


@inlined
def turn(word: int) -> float:
    """Map a word to a uniform angle in [0, 2 pi)."""
    return 2.0 * pi * (word * TO_UNIT)


@inlined
def normal_radius(unit: float) -> float:
    """Map a uniform number in (0, 1] to the radius of two standard normal numbers.

    Box and Muller: with a uniform angle, radius * cos(angle) and radius * sin(angle) are two
    independent standard normal numbers.
    """
    return sqrt(-2.0 * log(unit))


@inlined
def normal_pair(word0: int, word1: int) -> tuple[float, float]:
    """Map two words to two independent standard normal numbers."""
    radius = normal_radius(uniform(word0, 1.0, 0.0))
    sine, cosine = sincos(turn(word1))
    return radius * cosine, radius * sine
