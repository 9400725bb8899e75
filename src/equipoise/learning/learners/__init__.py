"""Learners, one file each: the name of the file is the name of the learner.

Each file holds `learner`, a `Learner`. A new file needs no entry elsewhere.
"""

import pkgutil
from importlib import import_module

from equipoise.learning.learner import Learner


def learner_names() -> list[str]:
    """Return the names of all learners of the project, sorted."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__))


def named_learner(name: str) -> Learner:
    """Return the learner of a name in `learner_names()`."""
    return import_module(f"{__name__}.{name}").learner
