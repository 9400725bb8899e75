"""Gymnasium environments: the balancing task in any world, simulated or on a rig.

`import equipoise.envs` registers them for `gymnasium.make("equipoise/Balance-v0")`.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from equipoise.envs.balance import BalanceDiscreteEnv, BalanceEnv, BoxIndexObservation

__all__ = ["BalanceDiscreteEnv", "BalanceEnv", "BoxIndexObservation", "register"]

IDS = {
    "equipoise/Balance-v0": "equipoise.envs.balance:BalanceEnv",
    "equipoise/BalanceDiscrete-v0": "equipoise.envs.balance:BalanceDiscreteEnv",
}
"""Entry point of each environment, by its id."""


def register() -> None:
    """Register the environments with Gymnasium; what is registered already stays."""
    from gymnasium.envs.registration import register, registry

    for name, entry_point in IDS.items():
        if name not in registry:
            vector = entry_point.replace("balance:", "vector:").replace("Env", "VectorEnv")
            register(id=name, entry_point=entry_point, vector_entry_point=vector)


def __getattr__(name: str) -> object:
    """Return a class, imported when it is asked for."""
    if name in __all__:
        from equipoise.envs import balance

        return getattr(balance, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


register()
