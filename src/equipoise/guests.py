"""Import of plug-in objects from outside the package, named as MODULE:NAME.

A custom policy, reward or learner is an object in a Python module of the current folder or of an
installed package. Results identify it by the digest of its source file.
"""

import hashlib
import importlib
import inspect
import sys
import traceback
from pathlib import Path
from typing import Any

from equipoise.errors import InputError


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
    try:
        module = importlib.import_module(module_name)
    except Exception as error:
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing is None or not f"{module_name}.".startswith(f"{missing}."):
            message = f"importing {module_name!r} raised {format_error(error)}; correct it"
            raise InputError(message) from error
        message = f"there is no module {module_name!r} in {here} or installed; {check}"
        raise InputError(message) from None
    if not hasattr(module, attribute):
        where = f"{module_name!r} ({module.__file__})"
        raise InputError(f"the module {where} has no {attribute!r}; {check}")
    return getattr(module, attribute)


def source_digest(function: Any) -> str:
    """Return the SHA-256 of the file that defines a function or class.

    Raises:
        InputError: The object has no source file.
    """
    try:
        source = Path(inspect.getsourcefile(inspect.unwrap(function)) or "").read_bytes()
    except (TypeError, OSError):
        message = f"{function!r:.60} has no source file, expected a function of a .py file"
        raise InputError(message) from None
    return hashlib.sha256(source).hexdigest()


def format_error(error: BaseException, hidden: str = __file__) -> str:
    """Return the type of an error, its text, and the line of code that raised it.

    Args:
        error: The error.
        hidden: Path of the caller's file, whose lines are skipped.
    """
    frames = traceback.extract_tb(error.__traceback__)
    lines = [(f.filename, f.lineno) for f in frames if f.filename not in (hidden, __file__)]
    where = " ({}, line {})".format(*lines[-1]) if lines else ""
    return f"{type(error).__name__}: {error}{where}"
