"""Policies in Python: a function, a class or an object, given directly or as `module:name`.

A function is called with each observation. An object has `act(observation)`, and `reset()` if it
keeps a state. A class is made without arguments, and made again for each trial if it has no
`reset`.
"""

import hashlib
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any, Self

from equipoise.artefacts import DIGEST_PREFIX
from equipoise.control.policy import Array, Policy
from equipoise.errors import InputError
from equipoise.user_code import guest_code, load_object, source_digest


class PythonPolicy:
    """A policy from any function, class or object in Python."""

    def __init__(
        self,
        source: Policy | Callable[[Array], float],
        name: str | None = None,
        module: ModuleType | None = None,
    ) -> None:
        """Wrap a policy.

        Args:
            source: A function of the observation (x, x_dot, phi, phi_dot), SI units, shape (4,),
                that returns the acceleration u of the flange along x [m/s^2]; or an object with
                such an `act`; or a class of such objects that takes no arguments.
            name: Name in messages and files; by default that of the function or class.
            module: Module that holds `source`, where that was read as `module:name`.

        Raises:
            InputError: `source` is no policy, its class cannot be made, or its source is unknown.
        """
        own = str(getattr(source, "__name__", type(source).__name__))
        self.name, self._source, self._module = name or own, source, module
        self._policy: Any = self._made() if isinstance(source, type) else source
        if not callable(getattr(self._policy, "act", self._policy)):
            raise InputError(
                f"{self.name} is of type {type(self._policy).__name__}, expected a function "
                "observation -> u or an object with act(observation); give one of those"
            )
        defined = source if hasattr(source, "__qualname__") else type(source)
        text = f"{own} {source_digest(module or defined)}"
        self.digest = DIGEST_PREFIX + hashlib.sha256(text.encode()).hexdigest()
        """SHA-256 of the source file and the name."""

    @classmethod
    def load(cls, name: str) -> Self:
        """Import the policy `module:name`, from the current folder or an installed package.

        Args:
            name: Name of the module and of the function, class or object in it.

        Raises:
            InputError: The name cannot be imported, or is no policy.
        """
        source = load_object(name, "the policy")
        return cls(source, name, sys.modules[name.partition(":")[0].removesuffix(".py")])

    def __reduce__(self) -> Any:
        """Send a policy that was read by name to another process by that name."""
        if self._module is not None:
            return PythonPolicy.load, (self.name,)
        return PythonPolicy, (self._source, self.name)

    def reset(self) -> None:
        """Call the policy's `reset`; create a new object of a class without one."""
        if hasattr(self._policy, "reset"):
            self._policy.reset()
        elif isinstance(self._source, type):
            self._policy = self._made()

    def act(self, observation: Array) -> float:
        """Return the result of the policy for the observation, shape (4,), unchecked."""
        return getattr(self._policy, "act", self._policy)(observation)

    def _made(self) -> Any:
        cure = "give a class that needs no arguments, or an object of it"
        with guest_code(f"calling {self.name}()", cure):
            return self._source()  # type: ignore[reportCallIssue]  # a class
