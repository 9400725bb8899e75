"""MuJoCo's C functions, as kernels call them.

A kernel takes the addresses of function, model and data as numbers: nothing of one process is
written into its machine code, so that the next process finds it in the cache and calls its own.
"""

import ctypes
import functools
import importlib
import sys
from typing import Any, NamedTuple

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, overload

from equipoise.model.physics_engine import mujoco


class Engine(NamedTuple):
    """Addresses of MuJoCo's step functions, and of their model and data."""

    before: int
    """`mj_step1`: the quantities that depend on positions and velocities."""
    after: int
    """`mj_step2`: the accelerations under the applied forces, and the integration."""
    model: int
    """The model."""
    data: int
    """Its state; no other thread may use it at the same time."""


def engine(model: Any, data: Any) -> Engine:
    """Return the addresses for a MuJoCo model and its data, which have to outlive them."""
    library = _library()
    before, after = (
        ctypes.cast(function, ctypes.c_void_p).value or 0
        for function in (library.mj_step1, library.mj_step2)
    )
    return Engine(before, after, model._address, data._address)


@functools.cache
def _library() -> ctypes.CDLL:
    """Return the library that MuJoCo's own Python module has loaded, with its profiler off.

    MuJoCo reads a clock at the start and the end of each stage of a step, a sixth of the step.
    """
    mujoco()  # loads it
    if sys.platform == "win32":  # modules there do not export the symbols of their libraries
        library = ctypes.CDLL("mujoco.dll")
    else:
        library = ctypes.CDLL(importlib.import_module("mujoco._functions").__file__)
    ctypes.c_void_p.in_dll(library, "mjcb_time").value = None
    return library


def call(function: int, model: int, data: int) -> None:
    """Call a C function by its address, from a kernel or from Python.

    Args:
        function: Address of a `void (mjModel *, mjData *)`.
        model: Address of the model.
        data: Address of the data.
    """
    ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(function)(model, data)


def _typed_call(_: Any, function: Any, model: Any, data: Any) -> Any:
    def generate(context: Any, builder: Any, _: Any, numbers: Any) -> Any:
        pointer = ir.IntType(8).as_pointer()
        c_function = ir.FunctionType(ir.VoidType(), [pointer, pointer]).as_pointer()
        function, *arguments = numbers
        builder.call(
            builder.inttoptr(function, c_function),
            [builder.inttoptr(argument, pointer) for argument in arguments],
        )
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64), generate


_call: Any = intrinsic(_typed_call)


@overload(call, strict=False)  # the annotations are not those that Numba would write
def _compiled_call(function: Any, model: Any, data: Any) -> Any:
    return lambda function, model, data: _call(function, model, data)
