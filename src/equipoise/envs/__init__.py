"""Gymnasium environments: the balancing task in any simulated world.

`import equipoise.envs` registers them for `gymnasium.make("equipoise/Balance-v0")`.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from equipoise.envs.balance import BalanceDiscreteEnv, BalanceEnv, BoxIndexObservation

__all__ = ["BalanceDiscreteEnv", "BalanceEnv", "BoxIndexObservation", "register"]

IDS = {"equipoise/Balance-v0": "Balance", "equipoise/BalanceDiscrete-v0": "BalanceDiscrete"}
"""First part of the name of each environment's classes, by its id."""


def register() -> None:
    """Register the environments with Gymnasium, unless they are registered already."""
    from gymnasium.envs.registration import register, registry

    for name, kind in IDS.items():
        if name not in registry:
            register(
                id=name,
                entry_point=f"equipoise.envs.balance:{kind}Env",
                vector_entry_point=f"equipoise.envs.vector:{kind}VectorEnv",
            )


def __getattr__(name: str) -> object:
    """Return a class, imported on its first use."""
    if name in __all__:
        from equipoise.envs import balance

        return getattr(balance, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


register()
