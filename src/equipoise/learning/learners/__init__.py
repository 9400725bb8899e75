"""Learners, one file each: the name of the file is the name of the learner."""

from collections.abc import Mapping
from typing import Final

LEARNERS: Final[Mapping[str, str]] = {
    name: f"{__name__}.{name}" for name in ("q_learning", "sarsa", "watkins", "double_q")
}
"""Modules of the project's learners by name, for `equipoise train --learner NAME`; the help lists
the names without importing them."""
