"""Choice of learner and reward, by name or from a guest's module, and their compilation.

A name is one of the project's, or MODULE:NAME of an object outside the package. A policy records a
guest's as MODULE:NAME@DIGEST, where DIGEST begins the SHA-256 of the source file: trained again, it
needs the same source.

Numba compiles a guest's functions, in each process anew. Code that Numba cannot compile is
rejected: in plain Python a training would take hours.
"""

import functools
import inspect
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numba

from equipoise.errors import InputError, SettingsError
from equipoise.jit import compilable, disabled, function_pointer
from equipoise.learning.learner import (
    Learner,
    LearnerKernel,
    learn_signature,
    learn_with,
    reward_signature,
    rewards_of,
    rewards_signature,
    update_signature,
)
from equipoise.learning.q_learning import learner as q_learning
from equipoise.learning.rewards import REWARDS
from equipoise.settings import LearningSettings
from equipoise.user_code import format_error, guest_code, load_object, source_digest

LEARNERS: Final[Mapping[str, Learner]] = {"q_learning": q_learning}
"""Learners of the project by name, for `equipoise train --learner NAME`."""


def with_digests(settings: LearningSettings) -> LearningSettings:
    """Return settings in which the name of a guest's learner or reward carries its digest.

    Raises:
        InputError: A guest's object cannot be loaded, or its source is not the recorded one.
        SettingsError: The name is unknown.
    """
    names = {"learner": settings.learner, "reward": settings.reward}
    for (option, name), known in zip(names.items(), (LEARNERS, REWARDS), strict=True):
        item = _load(name, option, known)
        if ":" not in name:
            continue
        bare, _, recorded = name.partition("@")
        with guest_code(bare):
            source = item.update if isinstance(item, Learner) else item
            digest = source_digest(source)[:16]
        if recorded and recorded != digest:
            raise InputError(
                f"the source of {bare} has changed: its digest is {digest}, expected {recorded}; "
                "restore the file, or train anew with the name alone"
            )
        names[option] = f"{bare}@{digest}"
    return settings.model_copy(update=names)


def load_learner(settings: LearningSettings) -> Learner:
    """Return the learner that settings name.

    Raises:
        InputError: A guest's learner cannot be loaded, or has another type.
        SettingsError: The name is unknown.
    """
    learner = _load(settings.learner, "learner", LEARNERS)
    if inspect.isfunction(function := getattr(learner, "py_func", learner)):
        learner = Learner(function)
    if not isinstance(learner, Learner):
        raise InputError(
            f"{settings.learner} is of type {type(learner).__name__}, expected a function "
            "update(tables, transition, params) or an equipoise.learning.learner.Learner; give one"
        )
    tables: Any = learner.tables
    if not isinstance(tables, int) or tables < 0:
        raise InputError(f"{settings.learner}: tables is {tables!r}; expected 0 or more")
    return learner


def compile_learner(settings: LearningSettings) -> LearnerKernel:
    """Return the learner and the reward that settings name, compiled for the episode loop.

    Raises:
        InputError: A guest's function has another type or cannot be compiled.
        SettingsError: The name is unknown.
    """
    learner = load_learner(settings)
    reward = _load(settings.reward, "reward", REWARDS)
    if not callable(reward):
        raise InputError(
            f"{settings.reward} is of type {type(reward).__name__}, expected a function "
            "reward(state, u, next_state, failed); give one"
        )
    guest, guest_reward = ":" in settings.learner, ":" in settings.reward
    if guest or guest_reward:
        _raised.clear()
        sys.unraisablehook = _keep
    with guest_code(settings.learner):
        learn = learn_with(_callable(learner.update, update_signature()))
        learn = function_pointer(learn, learn_signature(), cached=not guest)
    with guest_code(settings.reward):
        written = rewards_of(_callable(getattr(reward, "py_func", reward), reward_signature()))
        rewards = function_pointer(written, rewards_signature(), cached=not guest_reward)
    return LearnerKernel(learn=learn, rewards=rewards)


def raise_guest_error(settings: LearningSettings) -> None:
    """Raise the first error of a guest's compiled functions, if there was one.

    A function that Numba compiled as a pointer cannot raise it: Numba passes it to Python's hook
    for such errors, which would print it.

    Raises:
        InputError: A function raised an error.
    """
    if _raised:
        raise InputError(
            f"the learner {settings.learner} or the reward {settings.reward} raised "
            f"{_raised.pop()}; correct it"
        )


_raised: list[str] = []
_print_unraisable: Final = sys.unraisablehook
_NUMBA_PLACE: Final = re.compile(r"\.? Raised from | for '\$")
"""Begin of Numba's own statement of the place, at the end of a reason."""


def _keep(unraisable: "sys.UnraisableHookArgs") -> None:
    if "numba" not in str(unraisable.object):
        _print_unraisable(unraisable)
    elif not _raised and unraisable.exc_value is not None:
        _raised.append(format_error(unraisable.exc_value))


def _load(name: str, option: str, known: Mapping[str, Any]) -> Any:
    if ":" in name:
        return load_object(name.partition("@")[0], f"learning.{option}")
    if name not in known:
        raise SettingsError(
            f"unknown {option} {name!r:.60}; choose {', '.join(known)}, or give MODULE:NAME"
        )
    return known[name]


@functools.cache
def _callable(function: Any, signature: Any) -> Any:
    """Return a function that kernels can call; a guest's has its indices checked.

    Raises:
        InputError: Numba cannot compile a guest's function for its signature.
    """
    if disabled() or function.__module__.startswith("equipoise."):
        return compilable(function)
    try:
        return numba.njit(signature, error_model="numpy", boundscheck=True)(function)
    except Exception as error:  # Numba's, and a TypeError for a wrong number of arguments
        file, line = function.__code__.co_filename, function.__code__.co_firstlineno
        lines = [text.strip() for text in str(error).splitlines()]
        reason = next(text for text in lines if text and not text.startswith("Failed in"))
        places = re.findall(rf'{re.escape(Path(file).name)}(?:", line |:| \()(\d+)', str(error))
        raise InputError(
            f"{function.__name__} cannot be compiled: {_NUMBA_PLACE.split(reason)[0].rstrip(':.')} "
            f"({file}, line {[line, *places][-1]}); write it with numbers, tuples, the module math "
            "and NumPy's arrays, and mark functions that it calls with numba.njit"
        ) from None
