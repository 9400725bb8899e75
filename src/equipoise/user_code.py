"""Import of plug-in objects from outside the package, named as MODULE:NAME, and calls of them.

A custom policy, reward or algorithm is an object in a Python module of the current folder or of an
installed package. Results identify it by the digest of its source file. All code from outside the
package runs inside `user_code`: whatever it raises, even a request to exit, becomes one message.
"""

import hashlib
import importlib
import inspect
import os
import sys
import traceback
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from equipoise.errors import EquipoiseError, InputError
from equipoise.files import shortened
from equipoise.printable import printable


@contextmanager
def user_code(
    what: str, remedy: str = "correct it", where: Callable[[], str] = lambda: ""
) -> Generator[None]:
    """Run code from outside the package; convert what it raises, except Ctrl-C.

    Args:
        what: Name of the code in messages.
        remedy: Remedy in the message.
        where: Returns the situation of the call for the message, with a leading space.

    Raises:
        InputError: The code raised an exception of any type, `SystemExit` among them.
        EquipoiseError: The code raised this error itself, with a message.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        if isinstance(error, EquipoiseError) and str(error):
            raise
        raise InputError(f"{what} raised {format_error(error)}{where()}; {remedy}") from error


def load_object(name: str, option: str) -> Any:
    """Import the object `MODULE:NAME` from the current folder or an installed package.

    Args:
        name: Module and attribute, e.g. `own_policy:balance`; the module may end in `.py`.
        option: Name of the option or setting for messages, e.g. `--policy`.

    Raises:
        InputError: The name is malformed, the module cannot be imported, or the object is missing.
    """
    module_name, _, attribute = name.partition(":")
    module_name = module_name.removesuffix(".py") if attribute else module_name
    parts = module_name.split(".")
    if not attribute.isidentifier() or not all(part.isidentifier() for part in parts):
        raise InputError(
            f"{option} is {name!r}, expected MODULE:NAME, e.g. own:balance for the object balance "
            "of own.py in this folder"
        )
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    check = f"check {option} MODULE:NAME"
    with user_code(f"importing {module_name!r}"):
        try:
            module = importlib.import_module(module_name)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
                raise
            message = f"there is no module {module_name!r} in {here} or installed; {check}"
            raise InputError(message) from None
        if not hasattr(module, attribute):
            where = f"{module_name!r} ({getattr(module, '__file__', 'built in')})"
            raise InputError(f"the module {where} has no {attribute!r}; {check}")
        return getattr(module, attribute)


def source_digest(function: Any) -> str:
    """Return the SHA-256 of the file that defines a function or class.

    Raises:
        InputError: The object has no source file.
    """
    with user_code(f"finding the source of a {type(function).__name__}"):
        try:
            source = Path(inspect.getsourcefile(inspect.unwrap(function)) or "").read_bytes()
        except (TypeError, OSError):
            message = f"{function!r:.60} has no source file, expected a function of a .py file"
            raise InputError(message) from None
    return hashlib.sha256(source).hexdigest()


def format_error(error: BaseException) -> str:
    """Return type, text and origin of a user's error, escaped for display on one line."""
    frames = traceback.extract_tb(error.__traceback__)
    # This package, and Python's import.
    folders = (Path(__file__).parent, Path(inspect.getfile(importlib)).parent)
    others = (*(f"{folder}{os.sep}" for folder in folders), "<frozen ")
    lines = [(f.filename, f.lineno) for f in frames if not f.filename.startswith(others)]
    where = " ({}, line {})".format(*lines[-1]) if lines else ""
    try:
        text = str(error)
    except BaseException:  # a user's own `__str__`
        text = "without a text"
    short = shortened(text, 500)  # characters: a few lines of a terminal
    return printable(f"{type(error).__name__}: {short}{where}")
