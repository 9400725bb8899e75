"""Compilation of kernels with Numba, and the cache of their machine code.

`@kernel` is `numba.njit` with fixed options: lazy typing, so that importing a module compiles
nothing; `nogil`, so that threads run in parallel; no `fastmath`, so that equal input gives equal
bits; and a cache on disk.

Numba's own cache depends only on the file of a kernel, but a kernel also contains the code of the
kernels that it calls. This cache depends on a digest of all files of `KERNEL_PACKAGES` and of those
beside them, in the user's cache directory (`EQUIPOISE_CACHE_DIR` moves it). Loading cached code
runs it, so the folder is created for this user alone. Where it cannot be written, as on a full
disk, kernels compile in each process, after one warning.

`@compilable` keeps a function in Python and lets kernels call it.

`struct_ref` creates a type that holds many arrays and numbers behind one reference: passing it from
Python to a kernel takes a microsecond, passing its parts takes a hundred.

`function_pointer` compiles a function of fixed signature that kernels take as an *argument*, so
that one training loop serves every arm (a dispatcher as an argument would always miss the cache).
"""

import ctypes
import functools
import hashlib
import logging
import os
import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import numba
import platformdirs
from numba.core import caching, config, event

from equipoise import linking
from equipoise.printable import printable

logger = logging.getLogger(__name__)

F = TypeVar("F", bound=Callable[..., Any])

PACKAGE = Path(__file__).parent
_njit: Any = numba.njit  # its types lack some options
KERNEL_PACKAGES: Final = ("control", "identification", "learning", "model", "safety", "worlds")
"""Packages whose files hold kernels, or constants of kernels."""
OPTIONS: Final[dict[str, Any]] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
"""Options of Numba of every kernel."""


def cache_directory() -> Path:
    """Return the directory of reproducible files: machine code."""
    moved = os.environ.get("EQUIPOISE_CACHE_DIR")
    return Path(moved) if moved else Path(platformdirs.user_cache_dir("equipoise", appauthor=False))


@functools.cache
def package_digest() -> str:
    """Return a digest of every Python file that machine code can depend on."""
    digest = hashlib.sha256()
    files = [*PACKAGE.glob("*.py")]
    for package in KERNEL_PACKAGES:
        files += (PACKAGE / package).rglob("*.py")
    for file in sorted(files):
        digest.update(str(file.relative_to(PACKAGE)).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


@functools.cache
def kernel_folder() -> Path:
    """Return the folder of the machine code of these sources, which is created if it can be."""
    folder = cache_directory() / "kernels" / package_digest()
    with suppress(OSError):
        cache_directory().mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    return folder


@functools.cache
def warn_of_cache(reason: str) -> None:
    """Warn once of a cache that cannot be written."""
    logger.warning(
        "cannot write the cache %s (%s): code is compiled anew in each process; make room, or set "
        "EQUIPOISE_CACHE_DIR to a folder of your own that can be written",
        printable(str(cache_directory())),
        reason,
    )


@contextmanager
def watching_compilation(compiled: Callable[[str], None]) -> Generator[None]:
    """Call `compiled` with `FILE.NAME` of each function that Numba compiles in this context."""

    class _Listener(event.Listener):
        def on_start(self, event: event.Event) -> None:
            pass

        def on_end(self, event: event.Event) -> None:
            data: Any = event.data
            function = data["dispatcher"].py_func
            compiled(f"{Path(function.__code__.co_filename).stem}.{function.__name__}")

    with event.install_listener("numba:compile", _Listener()):
        yield


class _Locator(caching._CacheLocator):
    """Location and stamp of the machine code of one function, for Numba.

    The types of Numba's base methods, which only raise, lack the return values.
    """

    def __init__(self, py_func: Callable[..., Any], py_file: str) -> None:
        self._directory = kernel_folder()
        # Files of equal name share the directory: the path distinguishes them.
        place = hashlib.sha256(py_file.encode()).hexdigest()[:8]
        self._place = f"{py_func.__code__.co_firstlineno}-{place}"
        # The source of a generated arm has no file: its name contains the digest of the arm.
        source = Path(py_file).read_bytes() if os.path.exists(py_file) else b""
        self._stamp = hashlib.sha256(source).hexdigest()

    def get_cache_path(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        return str(self._directory)

    def get_source_stamp(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self._stamp

    def get_disambiguator(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self._place

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> "_Locator":
        return cls(py_func, py_file)


class _CacheImpl(caching.CompileResultCacheImpl):
    _locator_classes = [_Locator]  # noqa: RUF012  (the name and type are Numba's)

    def reduce(self, cres: Any) -> Any:
        return linking.called(cres.library), super().reduce(cres)

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        machine_code, result = payload
        linking.load(target_context, machine_code)
        rebuilt = super().rebuild(target_context, result)
        rebuilt.library.called = machine_code
        return rebuilt


class _LinkedCacheImpl(_CacheImpl):
    """Format of the file of a function that kernels call, which has no wrapper for Python."""

    def get_filename_base(self, fullname: str, abiflags: str) -> str:
        return "linked-" + super().get_filename_base(fullname, abiflags)

    def reduce(self, cres: Any) -> Any:
        return linking.reduce(cres)

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        return linking.rebuild(target_context, payload)


class _KernelCache(caching.FunctionCache):
    _impl_class = _CacheImpl

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load machine code from the cache; return None if its file is damaged."""
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # a damaged pickle raises any error
            logger.debug("damaged file in the cache: %r", error)
            with suppress(OSError):
                self.flush()  # or the new code could not be added
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save machine code in the cache, or warn that it cannot be saved."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            warn_of_cache(error.strerror)


class _LinkedCache(_KernelCache):
    _impl_class = _LinkedCacheImpl


def disabled() -> bool:
    """Return whether `NUMBA_DISABLE_JIT=1` keeps kernels as plain Python."""
    return bool(vars(config)["DISABLE_JIT"])  # set by Numba from NUMBA_DISABLE_JIT


def kernel(function: F) -> F:
    """Compile `function` on its first call; with `NUMBA_DISABLE_JIT=1` return it unchanged.

    Numba would hand the options of an inlined caller on to it, if that call is the one that
    compiles it: machine code would depend on the order of the calls.
    """
    if disabled():
        return function
    return _lazy(_njit(**OPTIONS, _nrt=True, forceinline=False)(function), _KernelCache)


def called(function: F) -> F:
    """Compile `function` once, for all kernels that call it.

    Such a function creates no array: it counts no references, which would take longer than what it
    computes.
    """
    return _linked(function, linking.CalledCompiler)


def inlined(function: F) -> F:
    """Compile `function` into each kernel that calls it; it creates no array either.

    Formulas inside loops over lanes need it: a processor vectorises a loop only without calls. So
    do functions of a control step, because a call copies all arrays of its named tuples.
    """
    return _linked(function, linking.InlinedCompiler)


def _linked(function: Callable[..., Any], compiler: Any) -> Any:
    if disabled():
        return function
    options = OPTIONS | {
        "_nrt": False,
        "boundscheck": None,
        "forceinline": compiler is linking.InlinedCompiler,
        "no_cpython_wrapper": True,
        "nopython": True,
    }
    dispatcher = linking.LinkedDispatcher(function, {}, options, compiler)
    dispatcher.for_python = _lazy(_njit(**OPTIONS, _nrt=False)(function), _KernelCache)
    return _lazy(dispatcher, _LinkedCache)


def compilable(function: F) -> F:
    """Keep `function` in Python, and compile it into each kernel that calls it.

    Rigs evaluate rules in Python, because nothing may compile during a run; trials evaluate the
    same code in kernels.
    """
    if disabled():
        return function
    from numba.extending import register_jitable

    return register_jitable(error_model="numpy")(function)


def _lazy(dispatcher: Any, cache: type[_KernelCache]) -> Any:
    dispatcher._cache = cache(dispatcher.py_func)
    # Numba gives an integer literal a type of its own, for which it would compile the kernel again.
    resolve = dispatcher.get_call_template
    dispatcher.get_call_template = lambda args, kws: resolve(
        tuple(map(numba.types.unliteral, args)),
        {name: numba.types.unliteral(kind) for name, kind in kws.items()},
    )
    return dispatcher


_library_fma: Any = ctypes.CDLL("ucrtbase" if os.name == "nt" else None).fma
_library_fma.argtypes, _library_fma.restype = [ctypes.c_double] * 3, ctypes.c_double


def fma(a: float, b: float, c: float) -> float:
    """Return a b + c with one rounding; in kernels it is one instruction.

    A compiler must not join a product and a sum by itself, because that changes the result.
    """
    return _library_fma(a, b, c)


def _teach_numba_fma() -> None:
    from numba.core.typing.templates import signature
    from numba.extending import lower_builtin, type_callable

    number = numba.types.float64

    @type_callable(fma)
    def type_of_fma(context: Any) -> Any:
        return lambda a, b, c: signature(number, number, number, number)

    @lower_builtin(fma, number, number, number)
    def code_of_fma(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.fma(*values)


if not disabled():
    _teach_numba_fma()


@functools.cache
def function_pointer(function: F, signature: Any, cached: bool = True) -> F:
    """Compile `function` for one `signature`, as an argument of kernels.

    Args:
        function: A plain function of a module.
        signature: Numba signature, e.g. `void(float64[::1], float64[::1])`.
        cached: Whether to cache the machine code on disk. The digest of the cache does not cover
            code from outside the package, which is not cached and has its indices checked.

    Returns:
        The compiled function; with `NUMBA_DISABLE_JIT=1`, `function` itself.
    """
    if disabled():
        return function
    from numba.core.ccallback import CFunc
    from numba.core.sigutils import normalize_signature

    options = {"error_model": "numpy", "boundscheck": not cached, "_nrt": not cached}
    pointer: Any = CFunc(function, normalize_signature(signature), {}, options)
    if cached:
        pointer._cache = _KernelCache(function)
    pointer.compile()
    return pointer


def struct_ref(name: str, module: str, fields: Sequence[str]) -> Any:
    """Create a type whose values kernels take by reference, with fields of any types.

    Construct its values in a kernel (`return NAME(...)`), which caches the constructor, too.

    Args:
        name: Name of the type; assign it to a variable of this name.
        module: `__name__` of the module that defines it.
        fields: Names of the fields.

    Returns:
        A type with a constructor of its fields, in their order; with `NUMBA_DISABLE_JIT=1`, a
        named tuple.
    """
    if disabled():
        # The fields are dynamic.
        return NamedTuple(name, [(field, Any) for field in fields])  # pyright: ignore
    from numba.experimental import structref

    kind = type(f"{name}Type", (numba.types.StructRef,), {"__module__": module})
    proxy = type(name, (structref.StructRefProxy,), {"__module__": module})
    structref.define_proxy(proxy, structref.register(kind), list(fields))
    vars(sys.modules[module])[kind.__name__] = kind  # Numba's cache looks up the type by name
    return proxy
