"""Choice of algorithm and reward, by name or from a user's module, and their compilation.

A name is one of the project's, or MODULE:NAME of an object outside the package. A policy records a
user's as MODULE:NAME@DIGEST, where DIGEST begins the SHA-256 of the source file: trained again, it
needs the same source.

Numba compiles a user's functions, in each process anew. Code that Numba cannot compile is
rejected: in plain Python a training would take hours.
"""

import inspect
from collections.abc import Mapping
from typing import Any, Final

import numba

from equipoise.control.policy import Observation
from equipoise.errors import InputError, SettingsError
from equipoise.files import shortened
from equipoise.jit import inlined
from equipoise.learning.q_learning import (
    Algorithm,
    Transition,
    UpdateParams,
    new_tables,
    q_learning,
)
from equipoise.learning.rewards import REWARDS
from equipoise.settings import LearningSettings
from equipoise.user_code import load_object, source_digest, user_code

ALGORITHMS: Final[Mapping[str, Algorithm]] = {"q_learning": Algorithm(q_learning)}
"""Algorithms of the project by name, for `equipoise train --algorithm NAME`."""


def with_digests(settings: LearningSettings) -> LearningSettings:
    """Return settings in which the name of a user's algorithm or reward carries its digest.

    Raises:
        InputError: A user's object cannot be loaded, or its source is not the recorded one.
        SettingsError: The name is unknown.
    """
    names = {"algorithm": settings.algorithm, "reward": settings.reward}
    for (option, name), known in zip(names.items(), (ALGORITHMS, REWARDS), strict=True):
        item = _load(name, option, known)
        if ":" not in name:
            continue
        bare, _, recorded = name.partition("@")
        with user_code(bare):
            source = item.update if isinstance(item, Algorithm) else item
            digest = source_digest(source)[:16]
        if recorded and recorded != digest:
            raise InputError(
                f"the source of {bare} has changed: its digest is {digest}, expected {recorded}; "
                "restore the file, or train anew with the name alone"
            )
        names[option] = f"{bare}@{digest}"
    return settings.model_copy(update=names)


def load_algorithm(settings: LearningSettings) -> Algorithm:
    """Return the algorithm that settings name.

    Raises:
        InputError: A user's algorithm cannot be loaded, or has another type.
        SettingsError: The name is unknown.
    """
    algorithm = _load(settings.algorithm, "algorithm", ALGORITHMS)
    if inspect.isfunction(function := getattr(algorithm, "py_func", algorithm)):
        algorithm = Algorithm(function)
    if not isinstance(algorithm, Algorithm):
        raise InputError(
            f"{settings.algorithm} is of type {type(algorithm).__name__}, expected a function "
            "update(tables, transition, params) or an "
            "equipoise.learning.q_learning.Algorithm; give one"
        )
    tables: Any = algorithm.tables
    if not isinstance(tables, int) or tables < 0:
        raise InputError(f"{settings.algorithm}: tables is {tables!r}; expected 0 or more")
    return algorithm


def compile_functions(settings: LearningSettings) -> tuple[Any, Any, bool]:
    """Return update and reward that settings name, callable in kernels.

    Returns:
        Update, reward, and whether both are the project's, so that their code can be cached.

    Raises:
        InputError: A user's function has another type or cannot be compiled.
        SettingsError: The name is unknown.
    """
    algorithm, reward = load_algorithm(settings), _load(settings.reward, "reward", REWARDS)
    transition = Transition(0, 0, 0.0, 0, False, False, 0.0, 0.0, 0)
    params = UpdateParams(0.0, 0.0, 0.0, 0.0, False)
    kinds = map(numba.typeof, (new_tables(1, algorithm.tables), transition, params))
    update = _compiled(algorithm.update, tuple(kinds))
    return update, compile_reward(reward), ":" not in settings.algorithm + settings.reward


def compile_reward(reward: Any) -> Any:
    """Return a reward of the project or of a user, callable in kernels.

    Raises:
        InputError: It is no function, or cannot be compiled.
    """
    function = getattr(reward, "py_func", reward)
    if not inspect.isfunction(function):
        raise InputError(
            f"the reward is of type {type(reward).__name__}, expected a function "
            "reward(state, u, next_state, failed); give one"
        )
    state = Observation(0.0, 0.0, 0.0, 0.0)
    kinds = map(numba.typeof, (state, 0.0, state, False))
    return _compiled(function, numba.float64(*kinds))


def _load(name: str, option: str, known: Mapping[str, Any]) -> Any:
    if ":" in name:
        return load_object(name.partition("@")[0], f"learning.{option}")
    if name not in known:
        raise SettingsError(
            f"unknown {option} {name!r:.60}; choose {', '.join(known)}, or give MODULE:NAME"
        )
    return known[name]


def _compiled(function: Any, signature: Any) -> Any:
    """Return a function that kernels can call; a user's has its indices checked.

    Args:
        function: A function of the project or of a user.
        signature: Numba's types of its arguments, and of its result if that matters.

    Raises:
        InputError: Numba cannot compile a user's function for these arguments.
    """
    if function.__module__.startswith("equipoise."):
        return inlined(function)
    try:
        return numba.njit(signature, error_model="numpy", boundscheck=True)(function)
    except Exception as error:  # Numba's, and a TypeError for a wrong number of arguments
        code, reason = function.__code__, " ".join(str(error).split())
        raise InputError(
            f"{function.__name__} cannot be compiled ({code.co_filename}, line "
            f"{code.co_firstlineno}): {shortened(reason, 600)}; write it with numbers, tuples, the "
            "module math and NumPy's arrays, and mark functions that it calls with numba.njit"
        ) from None
