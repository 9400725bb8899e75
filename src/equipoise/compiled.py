"""One way to compile a kernel, and one place where the machine code is kept.

`@kernel` is `numba.njit` with the project's choices: lazily typed, so that importing a module
compiles nothing; `nogil`, so that threads run side by side; never `fastmath`, so that equal input
gives equal bits; and cached on disk.

Numba's own cache looks at the file of a kernel only, while a kernel also contains the code of the
kernels that it calls. Ours is keyed by a digest of *all* files that hold kernels, lies in the
user's cache directory (`EQUIPOISE_CACHE_DIR` moves it). Cached code is run when it is loaded: a
folder in which others may write is not used (`equipoise.private_folder`). There, and where nothing
can be written, the kernels compile anew in each process, after one warning.

`@compilable` leaves a function to Python and lets kernels call it.

`handle` makes a type that holds many arrays and numbers behind one reference: a kernel that Python
calls once in each step takes it in a microsecond, and its parts in a hundred.

`function_pointer` compiles a function of fixed signature that kernels take as an *argument*: this
is how one training loop serves every arm (a dispatcher passed as an argument would never be found
in the cache).
"""

import functools
import hashlib
import logging
import os
import sys
import tempfile
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numba
import platformdirs
from numba.core import caching, config, event

from equipoise.printable import printable
from equipoise.private_folder import make_private_folder, writable_by_others

logger = logging.getLogger(__name__)

F = TypeVar("F", bound=Callable[..., Any])

PACKAGE = Path(__file__).parent
KERNEL_ROOMS = ("model", "control", "learning", "devices/twin", "simulation")
"""Folders of the package whose files hold kernels."""


def cache_directory() -> Path:
    """Return the directory for what can be made again: machine code, generated arms."""
    moved = os.environ.get("EQUIPOISE_CACHE_DIR")
    return Path(moved) if moved else Path(platformdirs.user_cache_dir("equipoise", appauthor=False))


@functools.cache
def kernel_sources_digest() -> str:
    """Return a digest of every file that holds kernels, and of this one."""
    files = [Path(__file__), *(f for room in KERNEL_ROOMS for f in (PACKAGE / room).rglob("*.py"))]
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(str(file.relative_to(PACKAGE)).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


@functools.cache
def _usable(folder: Path, contents: bool) -> bool:
    """Return whether a cache folder can be written, by this user alone; it is made if missing."""
    try:
        make_private_folder(folder)
        tempfile.TemporaryFile(dir=folder).close()
        problem = writable_by_others(folder, contents=contents)
    except OSError as error:
        problem = f"cannot write {folder}: {error.strerror or error}"
    if problem:
        warn_of_cache(cache_directory(), problem)
    return not problem


@functools.cache
def warn_of_cache(cache: Path, problem: str) -> None:
    """Warn of a problem with the cache, once."""
    logger.warning(
        "the cache %s is not used: %s. Code is compiled anew in each process; set "
        "EQUIPOISE_CACHE_DIR to a folder of your own that can be written",
        printable(str(cache)),
        printable(problem),
    )


def cache_folder(*names: str) -> Path | None:
    """Return a folder of the cache; none where it cannot be used, after a warning."""
    top = cache_directory()
    folder = top.joinpath(*names)
    return folder if _usable(top, False) and _usable(folder, True) else None


@functools.cache
def _machine_code_directory() -> Path | None:
    return cache_folder("kernels", kernel_sources_digest())


def cache_is_empty() -> bool:
    """Return whether kernels are kept, and none is there yet."""
    directory = None if disabled() else _machine_code_directory()
    return directory is not None and not any(directory.glob("*.nbi"))


@contextmanager
def watching_compilation(compiled: Callable[[], None]) -> Generator[None]:
    """Call `compiled` for each function that Numba compiles in this context."""

    class _Listener(event.Listener):
        def on_start(self, event: event.Event) -> None:
            pass

        def on_end(self, event: event.Event) -> None:
            compiled()

    with event.install_listener("numba:compile", _Listener()):
        yield


class _Locator(caching._CacheLocator):
    """Tells Numba where the machine code of one function lies and when it is stale.

    Numba's own methods only raise: that they return anything is not in their types.
    """

    def __init__(self, py_func: Callable[..., Any], py_file: str, directory: Path) -> None:
        self._directory = directory
        # Files of one name in two folders share the directory: the path tells them apart.
        place = hashlib.sha256(py_file.encode()).hexdigest()[:8]
        self._place = f"{py_func.__code__.co_firstlineno}-{place}"
        self._stamp = hashlib.sha256(Path(py_file).read_bytes()).hexdigest()

    def get_cache_path(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        return str(self._directory)

    def get_source_stamp(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self._stamp

    def get_disambiguator(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self._place

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> "_Locator | None":
        directory = _machine_code_directory()
        return None if directory is None else cls(py_func, py_file, directory)


class _CacheImpl(caching.CompileResultCacheImpl):
    _locator_classes = [_Locator]  # noqa: RUF012  (the name and type are Numba's)


class _KernelCache(caching.FunctionCache):
    _impl_class = _CacheImpl

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return machine code from the cache; none where its file is damaged."""
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # a damaged pickle fails in any way there is
            logger.debug("damaged file in the cache: %r", error)
            with suppress(OSError):
                self.flush()  # or the new code could not be added
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write machine code to the cache; go on without, where the disk is full."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            warn_of_cache(cache_directory(), f"the disk takes no more ({error.strerror})")


def _cached(compiled: Any) -> None:
    if _machine_code_directory() is not None:
        compiled._cache = _KernelCache(
            compiled.py_func if hasattr(compiled, "py_func") else compiled._pyfunc
        )


def disabled() -> bool:
    """Return whether kernels stay plain Python, by `NUMBA_DISABLE_JIT=1`."""
    return bool(vars(config)["DISABLE_JIT"])  # set by Numba from NUMBA_DISABLE_JIT


def kernel(function: F) -> F:
    """Compile `function` on its first call; with `NUMBA_DISABLE_JIT=1` leave it as it is."""
    return _lazily_compiled(function)


def inlined(function: F) -> F:
    """Compile `function` into each kernel that calls it.

    For the formulas inside loops over lanes: a processor runs such a loop many numbers at a time
    only if nothing is called in it.
    """
    return _lazily_compiled(function, forceinline=True)


def compilable(function: F) -> F:
    """Leave `function` to Python as it is, and compile it into each kernel that calls it.

    For rules that a rig asks in Python, where nothing may compile in the midst of a run, and trials
    in kernels: equal code for both.
    """
    if disabled():
        return function
    from numba.extending import register_jitable

    return register_jitable(error_model="numpy")(function)


def _lazily_compiled(function: F, **options: Any) -> F:
    if disabled():
        return function
    options |= {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
    dispatcher: Any = numba.njit(**options)(function)
    _cached(dispatcher)
    # A whole number that is written out has a type of its own for Numba, and the kernel that takes
    # it would be compiled once more for it.
    resolve = dispatcher.get_call_template
    dispatcher.get_call_template = lambda args, kws: resolve(
        tuple(map(numba.types.unliteral, args)),
        {name: numba.types.unliteral(kind) for name, kind in kws.items()},
    )
    return dispatcher


@functools.cache
def function_pointer(function: F, signature: Any, cached: bool = True) -> F:
    """Compile `function` for one `signature`, as a value that kernels take as an argument.

    Args:
        function: A plain function of a real `.py` file.
        signature: Numba signature, e.g. `void(float64[::1], float64[::1])`.
        cached: Whether to keep the machine code on disk; not for code from outside the package,
            whose changes the digest of the cache does not see. Such code has its indices checked.

    Returns:
        The compiled function; with `NUMBA_DISABLE_JIT=1`, `function` itself.
    """
    if disabled():
        return function
    from numba.core.ccallback import CFunc
    from numba.core.sigutils import normalize_signature

    options = {"error_model": "numpy", "boundscheck": not cached}
    pointer: Any = CFunc(function, normalize_signature(signature), {}, options)
    if cached:
        _cached(pointer)
    pointer.compile()
    return pointer


def handle(name: str, module: str, fields: Sequence[str]) -> Any:
    """Return a type of values that kernels take by reference, with fields of any types.

    Make its values in a kernel (`return NAME(...)`): what makes them is then cached, too.

    Args:
        name: Name of the type; assign it to a variable of this name.
        module: `__name__` of the module that defines it.
        fields: Names of the fields.

    Returns:
        A type that is made from its fields, in their order; with `NUMBA_DISABLE_JIT=1`, a named
        tuple.
    """
    if disabled():
        # The fields are known at run time only.
        return NamedTuple(name, [(field, Any) for field in fields])  # pyright: ignore
    from numba.experimental import structref

    kind = type(f"{name}Type", (numba.types.StructRef,), {"__module__": module})
    proxy = type(name, (structref.StructRefProxy,), {"__module__": module})
    structref.define_proxy(proxy, structref.register(kind), list(fields))
    vars(sys.modules[module])[kind.__name__] = kind  # Numba's cache finds the type by its name
    return proxy
