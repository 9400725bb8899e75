"""Learners, one file each: the name of the file is the name of the learner."""

from collections.abc import Mapping
from typing import Final

from equipoise.learning.learner import Learner
from equipoise.learning.learners import double_q, q_learning, sarsa

LEARNERS: Final[Mapping[str, Learner]] = {
    "q_learning": q_learning.learner,
    "sarsa": sarsa.learner,
    "double_q": double_q.learner,
}
"""Learners of the project by name, for `equipoise train --learner NAME`."""
