"""Compilation of kernels with Numba, and the cache of their machine code.

`@kernel` is `numba.njit` with fixed options: lazy typing, so that importing a module compiles
nothing; `nogil`, so that threads run in parallel; no `fastmath`, so that equal input gives equal
bits; and a cache on disk. Kernels call functions that are marked `@inlined` or `@compilable`;
called from Python, these run as plain Python. With `NUMBA_DISABLE_JIT=1` kernels do, too.

Numba's cache depends only on the file of a kernel, but a kernel also contains the code of the
functions that it calls. Therefore the cache lies in a folder that is named by a digest of all files
of `KERNEL_FILES`, in the user's cache directory (`EQUIPOISE_CACHE_DIR` moves it). Loading cached
code runs it, so the folder is created for this user alone. Where it cannot be written, as on a full
disk, kernels compile in each process, after one warning.

`pointer` compiles a function to an address that kernels `call`: one compiled loop serves every arm.
"""

import ctypes
import functools
import hashlib
import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, TypeVar

import numba
import numpy as np
import platformdirs
from llvmlite import binding, ir
from numba import typeof, types
from numba.extending import intrinsic, lower_builtin, overload, register_jitable, type_callable

from equipoise.arrays import Array, record_type
from equipoise.printable import printable

logger = logging.getLogger(__name__)

F = TypeVar("F", bound=Callable[..., Any])
Kernel = Callable[..., Any]
"""A kernel, or a function that kernels call."""

PACKAGE = Path(__file__).parent
KERNEL_FILES: Final = (
    *("arrays.py", "elementary.py", "jit.py", "outcomes.py", "paper.py"),
    *("arm/**/*.py", "control/*.py", "identification/*.py", "learning/*.py", "model/*.py"),
    *("safety/*.py", "simulation/**/*.py"),
)
"""Files that hold kernels, or constants of kernels."""
CACHE_SPACE: Final = 50_000_000
"""Free space that the machine code of all kernels needs [bytes]."""
_numba: Any = numba  # its types lack some options
_config: Any = _numba.config


def cache_directory() -> Path:
    """Return the directory of reproducible files: machine code."""
    moved = os.environ.get("EQUIPOISE_CACHE_DIR")
    return Path(moved) if moved else Path(platformdirs.user_cache_dir("equipoise", appauthor=False))


@functools.cache
def package_digest() -> str:
    """Return a digest of every Python file that machine code can depend on."""
    digest = hashlib.sha256()
    for file in sorted(file for pattern in KERNEL_FILES for file in PACKAGE.glob(pattern)):
        digest.update(str(file.relative_to(PACKAGE)).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


def kernel_folder() -> Path:
    """Return the folder of the machine code of these sources."""
    return cache_directory() / "kernels" / package_digest()


def _can_cache() -> bool:
    """Create the folder of the machine code, and return whether it takes any."""
    folder = kernel_folder()
    try:
        cache_directory().mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
        free = shutil.disk_usage(folder).free
        reason = f"{free / 1e6:.0f} MB are free" if free < CACHE_SPACE else ""
    except OSError as error:
        reason = str(error.strerror)
    if reason:
        logger.warning(
            "cannot write the cache %s (%s): code is compiled anew in each process; make room, or "
            "set EQUIPOISE_CACHE_DIR to a folder of your own that can be written",
            printable(str(cache_directory())),
            reason,
        )
    return not reason


DISABLED: Final = bool(_config.DISABLE_JIT)
"""Whether `NUMBA_DISABLE_JIT=1` keeps kernels as plain Python."""
CACHED: Final = not DISABLED and _can_cache()
"""Whether machine code is cached on disk."""
if CACHED:
    _config.CACHE_DIR = str(kernel_folder())

MAX_UNROLLED: Final = 15
"""Largest number of passes of a loop that LLVM may replace by copies of its body; below the number
of lanes, because only a loop that remains one is vectorised."""
for option in (f"--unroll-full-max-count={MAX_UNROLLED}", "--unroll-max-count=1"):
    binding.set_option("equipoise", option)  # for the whole process


def kernel(function: F, *, cached: bool = True) -> F:
    """Compile a function of Python's, on its first call; code of a user is not cached on disk."""
    return _numba.njit(cache=CACHED and cached, nogil=True, error_model="numpy")(function)


def inlined(function: F) -> F:
    """Compile a function into each kernel that calls it.

    Formulas inside loops over lanes need it: a processor vectorises a loop only without calls.
    """
    return compilable(function, inline=True)


def compilable(function: F, *, inline: bool = False) -> F:
    """Let kernels call a function, which stays a function of Python."""
    return register_jitable(
        error_model="numpy", forceinline=inline, no_cpython_wrapper=True, no_cfunc_wrapper=True
    )(function)


@contextmanager
def watching_compilation(compiled: Callable[[str], None]) -> Generator[None]:
    """Call `compiled` with `FILE.NAME` of each function that Numba compiles in this context."""
    from numba.core import event  # the only place of Numba's documented events

    class _Listener(event.Listener):
        def on_start(self, event: event.Event) -> None:
            pass

        def on_end(self, event: event.Event) -> None:
            data: Any = event.data
            function = data["dispatcher"].py_func
            compiled(f"{Path(function.__code__.co_filename).stem}.{function.__name__}")

    with event.install_listener("numba:compile", _Listener()):
        yield


_library_fma: Any = ctypes.CDLL("ucrtbase" if os.name == "nt" else None).fma
_library_fma.argtypes, _library_fma.restype = [ctypes.c_double] * 3, ctypes.c_double


def fma(a: float, b: float, c: float) -> float:
    """Return a b + c with one rounding; in kernels it is one instruction.

    A compiler must not join a product and a sum by itself, because that changes the result.
    """
    return _library_fma(a, b, c)


@type_callable(fma)
def _type_of_fma(_: Any) -> Any:
    number = types.float64
    return lambda a, b, c: number(number, number, number)


@lower_builtin(fma, types.float64, types.float64, types.float64)
def _code_of_fma(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
    return builder.fma(*values)


def flat(values: Array) -> Array:
    """Return contiguous numbers as an array of one axis; in kernels `ravel` calls into a library.

    In a kernel the result does not own its memory: it has to be the argument of a call alone.
    """
    return values.reshape(-1)


def _typed_place(_: Any, address: Any) -> Any:
    def generate(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        return builder.inttoptr(values[0], ir.IntType(8).as_pointer())

    return types.voidptr(address), generate


_place: Any = intrinsic(_typed_place)


@overload(flat, strict=False)
def _compiled_flat(values: Any) -> Any:
    return lambda values: _numba.carray(_place(values.ctypes.data), (values.size,), np.float64)


_functions: dict[int, tuple[Kernel, Any]] = {}
"""Functions behind the addresses that `pointer` returned, and their machine code, which lives as
long as the process; None without compilation."""


def pointer(function: Kernel, *examples: Any) -> int:
    """Compile a function once, for kernels that `call` it by its address.

    Args:
        function: A function without a result.
        examples: For each argument a value of its type; for a record the class that declares it.

    Returns:
        The address.
    """
    kinds = (
        _numba.from_dtype(record_type(example)) if isinstance(example, type) else typeof(example)
        for example in examples
    )
    return _compiled_pointer(function, *kinds)


@functools.cache
def _compiled_pointer(function: Kernel, *kinds: Any) -> int:
    """Return the address of a function for arguments of Numba's types."""
    code: Any = None
    if not DISABLED:
        options: dict[str, Any] = {"cache": CACHED, "error_model": "numpy"}
        code = _numba.cfunc(types.void(*kinds), **options)(function)
    address: int = len(_functions) + 1 if DISABLED else code.address
    _functions[address] = function, code
    return address


def call(function: int, arguments: tuple[Any, ...]) -> None:
    """Call a function by its address, from a kernel; from Python, as plain Python.

    Args:
        function: Address, from `pointer`.
        arguments: Arguments of exactly the types that it was compiled for.
    """
    _functions[function][0](*arguments)


def _typed_call(_: Any, function: Any, arguments: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kinds = [context.get_value_type(kind) for kind in signature.args[1]]
        address = builder.inttoptr(values[0], ir.FunctionType(ir.VoidType(), kinds).as_pointer())
        builder.call(address, [builder.extract_value(values[1], i) for i in range(len(kinds))])
        return ir.Constant(ir.IntType(8).as_pointer(), None)

    return types.void(types.int64, arguments), generate


_call: Any = intrinsic(_typed_call)


@overload(call, strict=False)  # the annotations are not those that Numba would write
def _compiled_call(function: Any, arguments: Any) -> Any:
    return lambda function, arguments: _call(function, arguments)
