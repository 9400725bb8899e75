"""Gymnasium environments of the balancing task: `equipoise/Balance-v0` and others.

`import equipoise.envs` registers them.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from equipoise.envs.balance import BalanceEnv

__all__ = ["BalanceEnv", "register"]

IDS = {"equipoise/Balance-v0": False, "equipoise/BalanceDiscrete-v0": True}
"""Whether the actions of an environment are discrete, by its id."""


def register() -> None:
    """Register the environments with Gymnasium, unless they are registered already."""
    from gymnasium.envs.registration import register, registry

    for name, discrete in IDS.items():
        if name not in registry:
            register(
                id=name,
                entry_point="equipoise.envs.balance:BalanceEnv",
                kwargs={"discrete": discrete},
            )


def __getattr__(name: str) -> object:
    """Return the class of the environment, imported on its first use."""
    if name == "BalanceEnv":
        from equipoise.envs import balance

        return balance.BalanceEnv
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


register()
