"""MuJoCo's C functions, as kernels call them.

A kernel takes the addresses of function, model and data as numbers: nothing of one process is
written into its machine code, so that the next process finds it in the cache and calls its own.
"""

import ctypes
import functools
import importlib
import sys
from typing import Any, Final, NamedTuple

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, overload

from equipoise.model.physics_engine import mujoco

UPDATE: Final = ("kinematics", "comPos", "crb", "factorM", "comVel", "passive")
"""Stages of `mj_step1` that the twin needs, in their order, without the last, `mj_rne`."""


class Engine(NamedTuple):
    """Addresses of MuJoCo's functions, and of their model and data."""

    before: int
    """`mj_step1`: the quantities that depend on positions and velocities."""
    after: int
    """`mj_step2`: the accelerations under the applied forces, and the integration."""
    update: tuple[int, ...]
    """The stages `UPDATE`."""
    bias: int
    """`mj_rne`: Coriolis, centrifugal and gravitational forces, the last stage of `mj_step1`."""
    accelerate: int
    """`mj_fwdAcceleration`: the accelerations without constraints, the first of `mj_step2`."""
    solve: int
    """`mj_solveM`: the accelerations under given forces alone."""
    integrate: int
    """`mj_Euler`: the integration, the last of `mj_step2`."""
    model: int
    """The model."""
    data: int
    """Its state; no other thread may use it at the same time."""
    forces: int
    """The array in it for `bias`."""


def engine(model: Any, data: Any) -> Engine:
    """Return the addresses for a MuJoCo model and its data, which have to outlive them."""
    library = _library()

    def address(name: str) -> int:
        return ctypes.cast(library[f"mj_{name}"], ctypes.c_void_p).value or 0

    return Engine(
        before=address("step1"),
        after=address("step2"),
        update=tuple(map(address, UPDATE)),
        bias=address("rne"),
        accelerate=address("fwdAcceleration"),
        solve=address("solveM"),
        integrate=address("Euler"),
        model=model._address,
        data=data._address,
        forces=data.qfrc_bias.ctypes.data,
    )


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


def call(function: int, arguments: tuple[int, ...]) -> None:
    """Call a C function by its address, from a kernel or from Python.

    Args:
        function: Address of a function without a result.
        arguments: Addresses and whole numbers, the model and the data first.
    """
    ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * len(arguments))(function)(*arguments)


def _typed_call(_: Any, function: Any, arguments: Any) -> Any:
    def generate(context: Any, builder: Any, _: Any, values: Any) -> Any:
        word = ir.IntType(64)
        c_function = ir.FunctionType(ir.VoidType(), [word] * len(arguments)).as_pointer()
        words = cgutils.unpack_tuple(builder, values[1])
        builder.call(builder.inttoptr(values[0], c_function), words)
        return context.get_dummy_value()

    return types.void(types.int64, types.UniTuple(types.int64, len(arguments))), generate


_call: Any = intrinsic(_typed_call)


@overload(call, strict=False)  # the annotations are not those that Numba would write
def _compiled_call(function: Any, arguments: Any) -> Any:
    return lambda function, arguments: _call(function, arguments)
