"""Every error that Equipoise raises on purpose.

The tree, with the exit code of the command line in brackets::

    EquipoiseError
    ├── InputError (ValueError)              [2] what was given cannot be used
    │   ├── SettingsError                        an unknown or impossible setting
    │   ├── RecordingError                       a recording that identifies nothing
    │   ├── ArtefactError                        a corrupt, foreign or mismatched file
    │   ├── ArmError                             an arm description or posture that cannot work
    │   └── MissingExtraError (ImportError)      an optional dependency is not installed
    └── OutsideError (OSError)               [3] disk, link or device failed
        └── LinkError (ConnectionError)          robot or sensor does not answer as it should

A message says what was expected, what came, and what to do about it.
"""


class EquipoiseError(Exception):
    """Root of the tree: catch this to catch all of ours."""

    exit_code = 2


class InputError(EquipoiseError, ValueError):
    """What was given cannot be used; another input will."""


class SettingsError(InputError):
    """A setting is unknown, of the wrong type or out of range."""


class RecordingError(InputError):
    """A recording does not hold what its identification needs."""


class ArtefactError(InputError):
    """A file of ours is corrupt, of another format or version, or does not match another."""


class ArmError(InputError):
    """An arm description is incomplete, or a posture is out of its limits."""


class MissingExtraError(InputError, ImportError):
    """An optional dependency is not installed."""

    def __init__(self, package: str, extra: str) -> None:
        """Name the missing `package` and the `extra` that installs it."""
        super().__init__(
            f"this needs the package {package}, which is not installed; install it with: "
            f"python -m pip install {package} (or '.[{extra}]' in the sources of Equipoise)"
        )


class OutsideError(EquipoiseError, OSError):
    """The world outside failed: disk full, link lost, device gone."""

    exit_code = 3


class LinkError(OutsideError, ConnectionError):
    """A robot or a sensor is gone, is silent, or says what it should not."""
