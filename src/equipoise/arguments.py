"""Validation of the arguments of public functions, by their annotations.

A wrong type, a number out of range or not finite gives one error before any work. Integers become
floats where a float is declared, and NumPy's numbers those of Python.
"""

import functools
import inspect
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Annotated, Any, TypeVar, cast

from pydantic import ConfigDict, Field, ValidationError, validate_call

from equipoise.errors import InputError
from equipoise.files import quoted
from equipoise.settings import MAX_TRIAL_DURATION

F = TypeVar("F", bound=Callable[..., Any])

Duration = Annotated[float, Field(gt=0.0, le=MAX_TRIAL_DURATION)]
"""Length of a run or a recording [s]."""
Workers = Annotated[int, Field(ge=1)] | Executor
"""Number of threads, or an executor of other workers."""


def checked(function: F) -> F:
    """Validate the arguments of a function against its annotations on each call.

    The call raises `InputError` for an argument of another type or out of range, and `TypeError`
    for a missing or unknown argument.
    """
    signature = inspect.signature(function)
    config = ConfigDict(arbitrary_types_allowed=True, allow_inf_nan=False)

    @validate_call(config=config)
    @functools.wraps(function)
    def valid(*args: Any, **kwargs: Any) -> tuple[tuple[Any, ...], dict[str, Any]]:
        return args, kwargs

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        signature.bind(*args, **kwargs)
        try:
            args, kwargs = valid(*args, **kwargs)
        except ValidationError as error:
            faults = error.errors(include_url=False, include_context=False)
            name, value = faults[0]["loc"][0], faults[0]["input"]
            if isinstance(name, int):  # given by position
                name = list(signature.parameters)[name]
            expected = dict.fromkeys(
                fault["msg"].removeprefix("Input should be ") for fault in faults
            )
            message = f"{name} is {quoted(value)}; expected {' or '.join(expected)}"
            raise InputError(message) from None
        return function(*args, **kwargs)

    return cast("F", call)
