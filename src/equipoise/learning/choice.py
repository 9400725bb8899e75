"""Choice of learner and reward, by name or from a guest's module, and their compilation.

A name is one of the project's, or MODULE:NAME of an object outside the package. A policy records a
guest's as MODULE:NAME@DIGEST, where DIGEST begins the SHA-256 of the source file: trained again, it
needs the same source.

A guest's functions run once in Python, on sample numbers, so that an error is reported with its
line; then Numba compiles them, in each process anew. Code that Numba cannot compile is rejected: in
plain Python a training would take hours.
"""

import functools
import inspect
import math
import sys
from collections.abc import Callable
from difflib import get_close_matches
from typing import Any, Final

import numba
from numba.core.errors import NumbaError

from equipoise.control.controller import Observation
from equipoise.errors import InputError, SettingsError
from equipoise.jit import compilable, disabled, function_pointer
from equipoise.learning import rewards
from equipoise.learning.learner import (
    Learner,
    LearnerKernel,
    Transition,
    UpdateParams,
    choose_signature,
    choose_with,
    learn_signature,
    learn_with,
    new_tables,
    rewards_of,
    rewards_signature,
)
from equipoise.learning.learners import learner_names, named_learner
from equipoise.settings import BoxSettings, LearningSettings
from equipoise.user_code import format_error, guest_code, load_object, source_digest

DIGEST_LENGTH: Final = 16
"""Number of hexadecimal digits of a guest's digest in a name."""
LEARNER: Final = "learning.learner"
REWARD: Final = "learning.reward"
STATE: Final = Observation(0.01, -0.1, 0.02, 0.3)
"""State on which a guest's functions are tried [m], [m/s], [rad], [rad/s]."""


def reward_names() -> list[str]:
    """Return the names of all rewards of the project, in the order of their file."""
    return [
        name
        for name, item in vars(rewards).items()
        if inspect.isfunction(item) and item.__module__ == rewards.__name__
    ]


def with_digests(settings: LearningSettings) -> LearningSettings:
    """Return settings in which the name of a guest's learner or reward carries its digest.

    Raises:
        InputError: A guest's object cannot be loaded, or its source is not the recorded one.
        SettingsError: The name is unknown.
    """
    learner = _with_digest(settings.learner, LEARNER, learner_names())
    reward = _with_digest(settings.reward, REWARD, reward_names())
    return settings.model_copy(update={"learner": learner, "reward": reward})


def load_learner(settings: LearningSettings) -> Learner:
    """Return the learner that settings name.

    Raises:
        InputError: A guest's learner cannot be loaded, or has another type.
        SettingsError: The name is unknown.
    """
    name = settings.learner
    if ":" not in name:
        _check_known(name, LEARNER, learner_names())
        return named_learner(name)
    learner = _guest(name, LEARNER)
    with guest_code(name):
        if inspect.isfunction(function := getattr(learner, "py_func", learner)):
            learner = Learner(function)
        if not isinstance(learner, Learner):
            raise InputError(
                f"{name} is of type {type(learner).__name__}, expected a function update(tables, "
                "transition, params) or an equipoise.learning.learner.Learner; give one"
            )
        return learner


def compile_learner(settings: LearningSettings) -> LearnerKernel:
    """Return the learner and the reward that settings name, compiled for the episode loop.

    Raises:
        InputError: A guest's function raises, returns no finite number, or cannot be compiled.
        SettingsError: The name is unknown.
    """
    learner = load_learner(settings)
    guest, guest_reward = ":" in settings.learner, ":" in settings.reward
    if guest or guest_reward:
        _raised.clear()
        sys.unraisablehook = _keep
    with guest_code(settings.learner):
        if guest:
            _try_learner(learner, settings.learner)
        ahead = learner.chooses_ahead
        select, update = _callable(learner.select), _callable(learner.update)
        learn = learn_with(update, select, ahead)
        choose = _compiled(choose_with(select), choose_signature(), guest, settings.learner)
        learn = _compiled(learn, learn_signature(), guest, settings.learner)
    with guest_code(settings.reward):
        if guest_reward:
            reward = _guest_reward(_guest(settings.reward, REWARD), settings.reward)
        else:
            _check_known(settings.reward, REWARD, reward_names())
            reward = _callable(getattr(rewards, settings.reward))
        paid = _compiled(rewards_of(reward), rewards_signature(), guest_reward, settings.reward)
    return LearnerKernel(choose=choose, learn=learn, rewards=paid, chooses_ahead=ahead)


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


def _keep(unraisable: "sys.UnraisableHookArgs") -> None:
    if "numba" not in str(unraisable.object):
        _print_unraisable(unraisable)
    elif not _raised and unraisable.exc_value is not None:
        _raised.append(format_error(unraisable.exc_value))


@functools.cache
def _callable(function: Any) -> Any:
    """Return a function that kernels can call; a guest's has its indices checked."""
    if disabled() or function.__module__.startswith("equipoise."):
        return compilable(function)
    return numba.njit(error_model="numpy", boundscheck=True)(function)


def _compiled(function: Any, signature: Any, guest: bool, name: str) -> Any:
    try:
        return function_pointer(function, signature, cached=not guest)
    except NumbaError as error:
        raise InputError(
            f"{name} cannot be compiled: {_reason(error)}; write it with numbers, tuples, the "
            "module math and NumPy's arrays, and mark functions that it calls with numba.njit"
        ) from error


def _reason(error: NumbaError) -> str:
    """Return the cause in Numba's message: its first line that is not a heading."""
    lines = [line.strip() for line in str(error).splitlines()]
    said = [line for line in lines if line and not line.startswith(("Failed in", "During", "- "))]
    places = [line for line in lines if line.startswith('File "')]
    return " at ".join([said[0].rstrip(":."), *(place.rstrip(":") for place in places[:1])])


def _guest_reward(function: Any, name: str) -> Callable[..., float]:
    """Return a guest's reward as a function of five parameters, tried once in Python."""
    function = getattr(function, "py_func", function)
    count = len(inspect.signature(function).parameters) if inspect.isfunction(function) else 0
    if count not in (4, 5):
        raise InputError(
            f"{name} is {function!r:.60}, expected a function "
            "reward(state, u, next_state, failed); give one"
        )
    for failed in (False, True):
        given = (STATE, 1.0, STATE, failed, -1.0)
        value = function(*given[:count])
        if not isinstance(value, (int, float)) or not math.isfinite(value):
            raise InputError(
                f"{name} returned {value!r:.60} for failed = {failed}, expected a finite number; "
                "correct it"
            )
    inner = _callable(function)
    if count == 5:
        return inner

    def reward(
        state: Observation, u: float, next_state: Observation, failed: bool, _: float
    ) -> float:
        return inner(state, u, next_state, failed)

    return reward if disabled() else numba.njit(error_model="numpy")(reward)


def _try_learner(learner: Learner, name: str) -> None:
    """Call the functions of a guest's learner once in Python, with a result and with a failure."""
    boxes = BoxSettings().count
    tables = new_tables(boxes, learner.tables)
    params = UpdateParams(0.5, 0.0, 0.1, 0.5, True)
    after = Transition(0, 0, -0.1, 0.9, boxes - 1, 7, False, False, 0.1, 0.5, 0)
    action = learner.select(tables, 0, 0.1, 0.5, 0.5)
    for transition in (after, after._replace(failed=True, ended=True)):
        learner.update(tables, transition, params)
    if action not in range(tables.Q.shape[1]):
        raise InputError(
            f"{name} selected {action!r:.60}, expected the index of an action, 0 to 7; correct it"
        )


def _with_digest(name: str, setting: str, known: list[str]) -> str:
    if ":" not in name:
        _check_known(name, setting, known)
        return name
    bare, _, recorded = name.partition("@")
    item = load_object(bare, setting)
    with guest_code(bare):
        digest = source_digest(item.update if isinstance(item, Learner) else item)[:DIGEST_LENGTH]
    if recorded and recorded != digest:
        raise InputError(
            f"the source of {bare} has changed: its digest is {digest}, expected {recorded}; "
            "restore the file, or train anew with the name alone"
        )
    return f"{bare}@{digest}"


def _guest(name: str, setting: str) -> Any:
    return load_object(name.partition("@")[0], setting)


def _check_known(name: str, setting: str, known: list[str]) -> None:
    if name not in known:
        close = get_close_matches(name, known, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"
        raise SettingsError(
            f"{setting} is {name!r:.60}, which is no name of the project; {hint} A guest's is "
            "MODULE:NAME"
        )
