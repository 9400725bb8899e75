"""Equipoise teaches a robot arm to balance an inverted pendulum.

Identify, train, evaluate, deploy.

This module provides the public names. The first use of a name imports its module, so that
`import equipoise` costs nothing. Values are immutable, units are SI and radians::

    Trajectory -> identify -> Pendulum -> train -> TabularPolicy -> evaluate -> Evaluation
    excite -> RunLog -> identify_run -> Actuator ---^            `-> simulate_run -> RunLog
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from equipoise.artefacts import Estimate
    from equipoise.control.bound_policy import bind_policy, load_policy
    from equipoise.control.policy import Policy, TabularPolicy, shipped_policy
    from equipoise.errors import EquipoiseError
    from equipoise.identification.actuator import identify_run
    from equipoise.identification.recording import (
        Trajectory,
        read_swing,
        simulate_swing,
        write_swing,
    )
    from equipoise.identification.swing import identify
    from equipoise.learning.train import train, train_to_target
    from equipoise.logs.run_log import RunLog
    from equipoise.model.actuator import Actuator, shipped_actuator
    from equipoise.model.arms.arm import Arm
    from equipoise.model.arms.iiwa import iiwa
    from equipoise.model.arms.urdf import read_urdf
    from equipoise.model.pendulum import Pendulum, PendulumParameters, shipped_pendulum
    from equipoise.model.worlds import read_world
    from equipoise.reproduction.pipeline import reproduce
    from equipoise.rig.simulate import excite, simulate_run
    from equipoise.settings import Settings, resolve
    from equipoise.worlds.evaluation import Evaluation, evaluate, lower_bound, trials_for

    __version__: str

__all__ = ["PendulumParameters", "Trajectory", "read_swing", "simulate_swing", "write_swing"]
__all__ += ["Estimate", "Pendulum", "identify", "shipped_pendulum"]
__all__ += ["Arm", "iiwa", "read_urdf"]
__all__ += ["Actuator", "excite", "identify_run", "shipped_actuator"]
__all__ += ["TabularPolicy", "shipped_policy", "train", "train_to_target"]
__all__ += ["Policy", "RunLog", "bind_policy", "load_policy", "read_world", "simulate_run"]
__all__ += ["Evaluation", "evaluate", "lower_bound", "reproduce", "trials_for"]
__all__ += ["EquipoiseError", "Settings", "__version__", "resolve"]

_HOMES = {
    "artefacts": ("Estimate",),
    "control.bound_policy": ("bind_policy", "load_policy"),
    "control.policy": ("Policy", "TabularPolicy", "shipped_policy"),
    "rig.simulate": ("excite", "simulate_run"),
    "errors": ("EquipoiseError",),
    "worlds.evaluation": ("Evaluation", "evaluate", "lower_bound", "trials_for"),
    "identification.actuator": ("identify_run",),
    "identification.recording": ("Trajectory", "read_swing", "simulate_swing", "write_swing"),
    "identification.swing": ("identify",),
    "model.actuator": ("Actuator", "shipped_actuator"),
    "model.arms.arm": ("Arm",),
    "model.arms.iiwa": ("iiwa",),
    "model.arms.urdf": ("read_urdf",),
    "model.pendulum": ("Pendulum", "PendulumParameters", "shipped_pendulum"),
    "model.worlds": ("read_world",),
    "logs.run_log": ("RunLog",),
    "settings": ("Settings", "resolve"),
    "reproduction.pipeline": ("reproduce",),
    "learning.train": ("train", "train_to_target"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        value: Any = version("equipoise")
    elif name in _HOME_OF:
        value = getattr(import_module(f"equipoise.{_HOME_OF[name]}"), name)
    else:
        raise AttributeError(f"module 'equipoise' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
