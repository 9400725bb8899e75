"""Arms by name or file, for the command line, `rig.toml` and studies.

A package registers an arm under the entry point group `equipoise.arms`: its name, and a function
without arguments that returns an `Arm`. The iiwas are registered in the same way.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from equipoise.arm.arm import Arm
from equipoise.arm.chain import Triple
from equipoise.arm.urdf import read_urdf
from equipoise.entry_points import how_to_install, registered
from equipoise.errors import ArmError
from equipoise.files import StrPath, quoted

SUFFIXES: Final = (".urdf", ".xml")
"""File suffixes of URDFs."""


def read_arm(
    source: Arm | StrPath | None,
    *,
    home: Sequence[float] | None = None,
    pivot: Triple | None = None,
    **urdf: Any,
) -> Arm:
    """Return an arm itself, or the arm of a registered name or of a URDF file.

    Args:
        source: The arm, its registered name, or the path of a URDF; by default the iiwa7.
        home: Posture at x = 0, all joints [rad]; by default the arm's own, or a search.
        pivot: The pendulum's pivot in the flange frame [m]; by default the arm's own.
        urdf: Other arguments of `read_urdf`; None stands for the default.

    Raises:
        ArmError: The arm is unknown, or an argument does not fit it.
    """
    if isinstance(source, Arm):
        return source
    name = "iiwa7" if source is None else str(source)
    options = {key: value for key, value in urdf.items() if value is not None}
    if Path(name).suffix.lower() in SUFFIXES:
        return read_urdf(name, home=home, pivot=pivot, **options)
    arms = registered("equipoise.arms")
    if name not in arms:
        known = f"choose {', '.join(sorted(arms))} or a file that ends in .urdf"
        raise ArmError(f"there is no arm {quoted(name)}; {how_to_install(name) or known}")
    if options:
        raise ArmError(
            f"{' and '.join(options)} belong to an arm from a URDF, and {name} is a registered arm;"
            " leave them out"
        )
    arm = arms[name].load()()
    if not isinstance(arm, Arm):
        found = type(arm).__name__
        raise ArmError(f"{arms[name].value} returns a {found}, expected an equipoise.Arm")
    fields = dict(arm)
    fields |= {} if home is None else {"home": tuple(home)}
    fields |= {} if pivot is None else {"pivot": pivot}
    return Arm(**fields)
