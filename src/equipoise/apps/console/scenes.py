"""Scenes of the playground: a rig, a policy and a start."""

from math import radians
from typing import Final, Literal, NamedTuple

from equipoise.errors import InputError

PolicyChoice = Literal["robust", "paper", "lqr", "trained", "yours"]
"""Policies of the playground: the shipped table, the paper's, LQR, the one trained there, and the
one of `--policy`."""


class Scene(NamedTuple):
    """A scene; the defaults are the shipped policy on the nominal twin."""

    about: str = ""
    """What to look at, in a few sentences."""
    policy: PolicyChoice = "robust"
    """Policy that balances."""
    predict: bool = True
    """Whether the policy sees the state at which its command takes effect."""
    delay: float = 0.010
    """Transport delay of the robot's commands [s]."""
    zero: float = 0.0
    """Error of the encoder's zero [rad]."""
    friction: float = 0.1
    """Dry friction of the pendulum over its inertia [1/s^2]."""
    lean: float = radians(3.0)
    """Angle from upright at the start [rad]."""


SCENES: Final = {
    "balance": Scene(
        "The shipped table on the digital twin. Push the pendulum: how much can it take?"
    ),
    "why-it-falls": Scene(
        "The same rig, but the policy sees the present, not the moment at which its command "
        "arrives. Lower the delay: from where on does it stand? Then switch the prediction on.",
        predict=False,
        delay=0.030,
    ),
    "paper": Scene(
        "The paper's table, trained in the ideal world without a delay. What the simulation did "
        "not have, the robot has.",
        policy="paper",
        predict=False,
    ),
    "zero-error": Scene(
        "The encoder's zero is 1.5 degrees off. Watch the flange: it drives to one side until the "
        "controller has found the error.",
        zero=radians(1.5),
    ),
    "friction": Scene(
        "A sticky pivot. The pendulum rests beside upright, and the policy hunts around it.",
        friction=1.0,
    ),
    "lqr": Scene(
        "A linear regulator instead of a table: it answers small angles with small accelerations. "
        "The table has eight, so that it is never quite at rest.",
        policy="lqr",
    ),
}
"""Scenes by name."""


def scene_named(name: str) -> Scene:
    """Return a scene by its name.

    Raises:
        InputError: There is no such scene.
    """
    if name not in SCENES:
        raise InputError(f"there is no scene {name!r}; choose one of {', '.join(SCENES)}")
    return SCENES[name]
