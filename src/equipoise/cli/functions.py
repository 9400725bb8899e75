"""`--policy module:name`: a function or class of the user's own Python."""

import importlib
import sys
from pathlib import Path

from equipoise.control.python_policy import PythonPolicy, format_error
from equipoise.errors import InputError


def read_function(name: str) -> PythonPolicy:
    """Import what `module:name` says, from the current folder or what is installed.

    Raises:
        InputError: It cannot be imported, or is no policy.
    """
    module_name, _, attribute = name.partition(":")
    module_name = module_name.removesuffix(".py") if attribute else module_name
    parts = module_name.split(".")
    if not attribute.isidentifier() or not all(part.isidentifier() for part in parts):
        raise InputError(
            f"--policy is {name!r}, expected MODULE:NAME, e.g. own_policy:act for the function act "
            "of own_policy.py in this folder"
        )
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise _broken(module_name, error) from error
        raise InputError(
            f"there is no module {module_name!r} in {here} or among what is installed; "
            "check --policy MODULE:NAME"
        ) from None
    except Exception as error:
        raise _broken(module_name, error) from error
    if not hasattr(module, attribute):
        raise InputError(
            f"the module {module_name!r} ({module.__file__}) has no {attribute!r}; "
            "check --policy MODULE:NAME"
        )
    return PythonPolicy(getattr(module, attribute), name)


def _broken(module: str, error: Exception) -> InputError:
    return InputError(f"importing {module!r} raised {format_error(error)}; correct it")
