"""Exceptions of Equipoise.

The tree, with the exit code of the command line in brackets::

    EquipoiseError
    ├── InputError (ValueError)              [2] invalid input
    │   ├── SettingsError                        unknown or invalid setting
    │   ├── RecordingError                       recording unsuitable for identification
    │   ├── ArtefactError                        corrupt, foreign or mismatched file
    │   ├── ArmError                             invalid arm description or posture
    │   └── MissingExtraError (ImportError)      optional dependency is not installed
    └── OutsideError (OSError)               [3] failure of disk, link or device
        └── LinkError (ConnectionError)          no valid answer from robot or sensor

A message gives the fault with its value, the expected value, and a remedy.
"""

from importlib import import_module
from typing import Any, Final

INTERRUPTED: Final = 130
"""Exit code of an interrupted command."""


class EquipoiseError(Exception):
    """Base class of all exceptions of Equipoise."""

    exit_code = 2


class InputError(EquipoiseError, ValueError):
    """Invalid input; a corrected input works."""


class SettingsError(InputError):
    """Unknown setting, or a value of the wrong type or out of range."""


class RecordingError(InputError):
    """Recording unsuitable for identification."""


class ArtefactError(InputError):
    """File that is corrupt, of another format or version, or inconsistent with another file."""


class ArmError(InputError):
    """Incomplete arm description, or a posture outside its limits."""


class MissingExtraError(InputError, ImportError):
    """Missing optional dependency."""


class OutsideError(EquipoiseError, OSError):
    """Failure outside the program: disk full, link lost, device disconnected."""

    exit_code = 3


class LinkError(OutsideError, ConnectionError):
    """Robot or sensor that is disconnected, silent, or sends invalid data."""


def import_optional(module: str, extra: str) -> Any:
    """Import a module of an optional package.

    Args:
        module: Name of the module.
        extra: Name of the extra that installs the package.

    Raises:
        MissingExtraError: The package is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        package = module.replace("_", "-")
        raise MissingExtraError(
            f"this needs the package {package}, which is not installed; install it with: "
            f"python -m pip install {package} (or '.[{extra}]' in the sources of Equipoise)"
        ) from None
