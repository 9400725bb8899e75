"""Types of arrays, and records: the states that kernels change in place.

A record is one block of memory with named fields, declared as a class::

    class State(Protocol):
        q: Annotated[Array, (6, 16)]

`new_records(State)` returns an array of one such record. Numba's kernels take that array in a
microsecond; `states[0].q[i, n]` reads an entry.
"""

import functools
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, Final, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
"""Numbers; the docstring of each function gives the shape."""
IntArray = npt.NDArray[np.int64]
"""Whole numbers, such as indices and counts."""
Records = npt.NDArray[Any]
"""Array of one record."""

R = TypeVar("R")

CACHE_LINE: Final = 64
"""Size of a cache line [bytes], and of the widest registers."""


@functools.cache
def record_type(declared: Any) -> np.dtype[np.void]:
    """Return the type of the records that a class declares, from the annotations of its fields.

    Args:
        declared: Class whose fields are `float`, `int`, `bool`, another such class, or any of them
            with a shape: `Annotated[Array, (6, 16)]`, `Annotated[Sequence[Motion], (12,)]`.
    """
    kinds: dict[Any, Any] = {float: np.float64, Array: np.float64, int: np.int64}
    kinds |= {IntArray: np.int64, bool: np.bool_}
    columns: list[Any] = []
    for name, hint in get_type_hints(declared, include_extras=True).items():
        annotated = hasattr(hint, "__metadata__")
        kind, *shape = get_args(hint) if annotated else (hint,)
        if get_origin(kind) is Sequence:
            (kind,) = get_args(kind)
        columns.append((name, kinds.get(kind) or record_type(kind), *shape))
    return np.dtype((np.record, np.dtype(columns, align=True)))


def new_records(declared: Any) -> Records:
    """Return an array of one record of zeros, which begins on a cache line.

    A wide register that is loaded from elsewhere or stored there touches two lines.
    """
    kind = record_type(declared)
    memory = np.zeros(kind.itemsize + CACHE_LINE, np.uint8)
    first = -memory.ctypes.data % CACHE_LINE
    return memory[first : first + kind.itemsize].view(kind)


def fields(records: Records, declared: type[R]) -> R:
    """Return the fields of the record of an array, arrays all, as attributes.

    Reading one takes a tenth of the time that an attribute of NumPy's record takes.
    """
    kind, views = records.dtype, SimpleNamespace()
    for name in kind.names or ():
        field, nested = records[name], kind[name].names is not None
        setattr(views, name, fields(field, object) if nested else field[0])
    own: Any = views
    return own


def first_lane(record: Any) -> Array:
    """Return the entries of a record of lanes, from `fields`, in the first lane."""
    return np.array([entry[0] for entry in vars(record).values()])


def rows_of(records: Records, lanes: int) -> IntArray:
    """Return the bits of a record as rows of lanes, shape (rows, lanes), to copy whole lanes.

    Args:
        records: Array of one record, of numbers of 64 bits; the last axis of each field is that of
            the lanes.
        lanes: Number of lanes.
    """
    return records.view(np.int64).reshape(-1, lanes)
