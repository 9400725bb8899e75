"""The published numbers, against the paper's LaTeX source typed by another hand."""

import pytest

from equipoise import paper
from tests.reference import intervals as printed

AXES = [
    (paper.PHI_INTERVALS_DEG, printed.PHI_DEG),
    (paper.PHI_DOT_INTERVALS_DEG, printed.PHI_DOT_DEG),
    (paper.X_INTERVALS, printed.X),
    (paper.X_DOT_INTERVALS, printed.X_DOT),
]


@pytest.mark.parametrize(("ours", "theirs"), AXES)
def test_intervals_have_the_ends_of_the_source_and_their_brackets(ours, theirs):
    assert [printed.read(s) for s in ours] == [printed.read(s) for s in theirs]


def test_the_actions_are_the_eight_of_section_4_1():
    assert paper.ACTIONS == (-2, -1.5, -1, -0.5, 0.5, 1, 1.5, 2)


def test_single_numbers_are_those_of_their_sections():
    assert paper.HELD_JOINT == 3  # 3.1 "we fix the redundant joint (third) of the robot"
    assert paper.FREE_SWING_PERIOD == 0.75  # 3.2 "around 0.75 seconds"
    assert paper.PHI_LIMIT_DEG == 11  # 4.1 "{+11, -11} degrees"
    assert paper.X_LIMIT == 0.22  # 4.1 "{+0.22, -0.22} meters"
    assert paper.EPISODES == 10_000  # 4.2 "trained in 10,000 episodes"
    assert paper.STEP == 0.01  # 4.2 "a time step h = 0.01 seconds"
    assert paper.SECONDS_BALANCED == 5  # 4.3 "for the first 5 seconds"
    assert paper.X_AT_FAILURE == -0.22  # 4.3 "exceeding the limit at -0.22 meters"
    assert paper.PHI_AT_FAILURE_DEG == -3.44  # 4.3 "the pendulum's angle is -3.44"
