"""Arms by name or file, for the command line, `rig.toml` and studies.

A package registers an arm under the entry point group `equipoise.arms`: its name, and a function
without arguments that returns an `Arm`. The iiwas are registered in the same way.
"""

from collections.abc import Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Final

from equipoise.artefacts import StrPath, quoted
from equipoise.errors import ArmError
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.chain import Triple
from equipoise.model.arms.urdf import read_urdf
from equipoise.user_code import guest_code

GROUP: Final = "equipoise.arms"
"""Entry point group of arms."""
SUFFIXES: Final = (".urdf", ".xml")
"""File suffixes of URDFs."""


def read_arm(given: Arm | StrPath | None) -> Arm:
    """Return a given arm, that of a registered name or a URDF file, or by default the iiwa7.

    Raises:
        ArmError: There is no such arm.
    """
    if isinstance(given, Arm):
        return given
    return resolve_arm("iiwa7" if given is None else str(given))


def resolve_arm(
    name: str,
    *,
    home: Sequence[float] | None = None,
    pivot: Triple | None = None,
    **urdf: Any,
) -> Arm:
    """Return the arm of a registered name or of a URDF file.

    Args:
        name: Registered name, or path of a URDF.
        home: Posture at x = 0, all joints [rad]; by default the arm's own, or a search.
        pivot: The pendulum's pivot in the flange frame [m]; by default the arm's own.
        urdf: Other arguments of `read_urdf`; None stands for the default.

    Raises:
        ArmError: The arm is unknown, or an argument does not fit it.
        InputError: The package that registers the arm is defective.
    """
    given = {key: value for key, value in urdf.items() if value is not None}
    if Path(name).suffix.lower() in SUFFIXES:
        return read_urdf(name, home=home, pivot=pivot, **given)
    registered = {point.name: point for point in entry_points(group=GROUP)}
    if name not in registered:
        raise ArmError(
            f"there is no arm {quoted(name)}; choose {', '.join(sorted(registered))} or a file "
            "that ends in .urdf"
        )
    if given:
        raise ArmError(
            f"{' and '.join(given)} belong to an arm from a URDF, and {name} is a registered arm; "
            "leave them out"
        )
    what, cure = f"the arm {name} of {registered[name].value}", "repair or remove its package"
    with guest_code(what, cure):
        arm = registered[name].load()()
        if not isinstance(arm, Arm):
            found = type(arm).__name__
            raise ArmError(f"{what} is a {found}, expected an equipoise.Arm; {cure}")
    fields: dict[str, Any] = {field: getattr(arm, field) for field in Arm.model_fields}
    fields |= {} if home is None else {"home": tuple(home)}
    fields |= {} if pivot is None else {"pivot": pivot}
    return Arm(**fields)
