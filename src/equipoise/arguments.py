"""Validation of the arguments of public functions, by their annotations.

A wrong type, a number out of range or not finite gives one error before any work. Integers become
floats where a float is declared, and NumPy's numbers those of Python.
"""

import functools
import inspect
import os
from collections.abc import Callable
from concurrent.futures import Executor
from types import UnionType
from typing import (
    Annotated,
    Any,
    Protocol,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from pydantic import ConfigDict, Field, GetPydanticSchema, TypeAdapter, ValidationError
from pydantic_core.core_schema import is_instance_schema

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
    hints = get_type_hints(function, include_extras=True)
    function.__annotations__ = get_type_hints(function)  # for readers of help, without the bounds
    signature = inspect.signature(function)

    @functools.cache
    def adapters() -> dict[str, TypeAdapter[Any]]:
        config = ConfigDict(arbitrary_types_allowed=True, allow_inf_nan=False)
        types = {name: _instances(hints.get(name, Any)) for name in signature.parameters}
        return {name: TypeAdapter(kind, config=config) for name, kind in types.items()}

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        bound = signature.bind(*args, **kwargs)
        for name, value in bound.arguments.items():
            try:
                bound.arguments[name] = adapters()[name].validate_python(value)
            except ValidationError as error:
                faults = error.errors(include_url=False, include_context=False)
                expected = dict.fromkeys(
                    fault["msg"].removeprefix("Input should be ") for fault in faults
                )
                message = f"{name} is {quoted(value)}; expected {' or '.join(expected)}"
                raise InputError(message) from None
        return function(*bound.args, **bound.kwargs)

    return cast("F", call)


def _instances(hint: Any) -> Any:
    """Return an annotation in which a value of Equipoise has to be an instance of its class."""
    if get_origin(hint) in (Union, UnionType):
        return Union[tuple(map(_instances, get_args(hint)))]  # noqa: UP007  (of any number)
    if Protocol in getattr(hint, "__bases__", ()):  # a user's object, which its user checks
        return Any
    hint = os.PathLike if get_origin(hint) is os.PathLike else hint
    own = isinstance(hint, type) and hint.__module__.startswith(("equipoise.", "os"))
    if not own or issubclass(hint, tuple):
        return hint
    return Annotated[Any, GetPydanticSchema(lambda *_: is_instance_schema(hint))]
