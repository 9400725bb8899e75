"""Scenes of the playground: a rig, a policy and a start, as a short TOML file to pass on."""

from collections.abc import Mapping
from math import radians
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field, ValidationError

from equipoise.artefacts import Name, Seed, Sentence, StrPath, Value, first_fault
from equipoise.errors import InputError
from equipoise.paper import PHI_LIMIT_DEG
from equipoise.settings import read_toml

PolicyChoice = Literal["paper", "robust", "lqr", "trained", "yours"]
"""Policies of the playground: the paper's table, the shipped one, LQR, the one trained there, and
the one of `--policy`."""
MAX_LEAN: Final = 10.0
"""Largest lean at the start [deg]: within the outer boxes."""


class Scene(Value):
    """A scene; the defaults are the shipped policy on the nominal twin."""

    about: Sentence = ""
    """What to look at, in a few sentences."""
    policy: PolicyChoice = "robust"
    """Policy that balances."""
    predict: bool = True
    """Whether the policy sees the state at which its command takes effect."""
    delay: Annotated[float, Field(ge=0.0, le=0.06)] = 0.010
    """Transport delay of the robot's commands [s]."""
    zero: Annotated[float, Field(ge=-radians(3.0), le=radians(3.0))] = 0.0
    """Error of the encoder's zero [rad]."""
    friction: Annotated[float, Field(ge=0.0, le=2.0)] = 0.1
    """Dry friction of the pendulum over its inertia [1/s^2]."""
    lean: float = radians(3.0)
    """Angle from upright at the start [rad]."""
    seed: Seed = 0
    """Seed of jitter, noise and training."""

    def text(self) -> str:
        """Return the scene as TOML, for a file."""
        lines = ["# A scene of the playground: equipoise play FILE. Seconds and radians."]
        for name, value in self.model_dump().items():
            quoted = str(value).lower() if isinstance(value, bool) else value
            lines.append(f"{name} = {_toml(value) if isinstance(value, str) else quoted}")
        return "\n".join(lines) + "\n"


def _toml(text: str) -> str:
    """Return a text as a basic string of TOML."""
    escaped = "".join(
        {"\\": "\\\\", '"': '\\"'}.get(c, c if c.isprintable() else f"\\U{ord(c):08X}")
        for c in text
    )
    return f'"{escaped}"'


SCENES: Final[Mapping[str, Scene]] = {
    "balance": Scene(
        about="The shipped table on the digital twin. Push the pendulum: how much can it take?"
    ),
    "why-it-falls": Scene(
        about="The same rig, but the policy sees the present, not the moment at which its command "
        "arrives. Lower the delay: from where on does it stand? Then switch the prediction on.",
        predict=False,
        delay=0.030,
    ),
    "paper": Scene(
        about="The paper's table, trained in the ideal world without a delay. What the simulation "
        "did not have, the robot has.",
        policy="paper",
        predict=False,
    ),
    "zero-error": Scene(
        about="The encoder's zero is 1.5 degrees off. Watch the flange: it drives to one side "
        "until the controller has found the error.",
        zero=radians(1.5),
    ),
    "friction": Scene(
        about="A sticky pivot. The pendulum rests beside upright, and the policy hunts around it.",
        friction=1.0,
    ),
    "lqr": Scene(
        about="A linear regulator instead of a table: it answers small angles with small "
        "accelerations. The table has eight, so that it is never quite at rest.",
        policy="lqr",
    ),
}
"""Scenes by name."""


def check_lean(lean_deg: float) -> str:
    """Return why the pendulum cannot start at an angle from upright [deg]; empty if it can.

    Example:
        >>> check_lean(3.0)
        ''
    """
    if abs(lean_deg) <= MAX_LEAN:
        return ""
    place = "hangs" if abs(lean_deg) > 90.0 else "leans too far"
    return (
        f"At {lean_deg:+.0f} degrees the pendulum {place}. The boxes of the table end at "
        f"{PHI_LIMIT_DEG:g} degrees from upright; beyond them it has no action, and the flange "
        "cannot bring it back on a track of 44 cm. Swinging it up is another task: on the robot "
        "an operator lifts it by hand."
    )


def read_scene(name: StrPath | Name) -> Scene:
    """Return a scene by its name, or from a file.

    Raises:
        InputError: There is no such scene, or the file is none.
    """
    known = SCENES.get(str(name))
    if known is not None:
        return known
    path = Path(name)
    if not path.suffix and not path.exists():
        raise InputError(
            f"there is no scene {str(name)!r}; choose one of {', '.join(SCENES)}, or give a file"
        )
    return scene_of(read_toml(path, "a scene"), str(path))


def scene_of(values: Mapping[str, Any], source: str) -> Scene:
    """Return a scene from the values of a file.

    Args:
        values: Fields of the scene.
        source: Name of the file, for the message.

    Raises:
        InputError: A value is invalid.
    """
    try:
        scene = Scene.model_validate(dict(values))
    except ValidationError as error:
        fault = first_fault(error)
        raise InputError(f"{source}: {fault.where}: {fault.what}, got {fault.got}") from None
    if reason := check_lean(scene.lean / radians(1.0)):
        raise InputError(f"{source}: lean: {reason}")
    return scene
