"""Policies bound to their task, and policies by name.

`load_policy` reads the file of a table, a network (`.onnx`), Python (`module:name`) or a built-in
name (`lqr`, `lqr-snapped`, `pd`, `random`). A table brings along the task of its training. The
others take pendulum, arm, actuator and settings from the caller, by default those that ship.

A function in Python is called with each observation. An object has `act(observation)`, and
`reset()` if it keeps a state. A class is made without arguments, and made again for each trial if
it has no `reset`.
"""

import hashlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, Final, Protocol, Self, runtime_checkable

import numpy as np

from equipoise import paper
from equipoise.arguments import checked
from equipoise.arm.arm import Arm
from equipoise.arm.urdf import read_arm
from equipoise.arrays import Array
from equipoise.control.linear import baselines
from equipoise.control.policy import (
    BoundPolicy,
    KernelPolicy,
    TabularPolicy,
    TaskPolicy,
    shipped_policy,
)
from equipoise.errors import ArtefactError, InputError, import_optional
from equipoise.files import DIGEST_PREFIX, MAX_FILE_SIZE, StrPath, read_bytes
from equipoise.model.actuator import Actuator, read_actuator
from equipoise.model.pendulum import Pendulum, read_pendulum
from equipoise.settings import Settings
from equipoise.user_code import load_object, source_digest, user_code

BUILT_IN: Final = {"lqr": "LQR", "lqr-snapped": "LQR, snapped", "pd": "PD", "random": "random"}
"""Built-in policies, and their names among the baselines."""


@runtime_checkable
class Acting(Protocol):
    """An object with `act`; its `reset` is called if it has one."""

    def act(self, observation: Array) -> float:
        """Return u [m/s^2] for the observation (x, x_dot, phi, phi_dot), shape (4,)."""
        ...


PolicySource = Acting | Callable[[Array], float] | Callable[[], Acting]
"""An object with `act`, a function of the observation, or a class of such objects."""


class PythonPolicy:
    """A policy from any function, class or object in Python."""

    def __init__(
        self, source: PolicySource, name: str | None = None, module: ModuleType | None = None
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
                f"the policy {self.name} is of type {type(self._policy).__name__}, expected a "
                "function observation -> u or an object with act(observation); give one of those"
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
        with user_code(f"calling {self.name}()", cure):
            return self._source()  # type: ignore[reportCallIssue]  # a class


class OnnxPolicy:
    """A network without a state, in the ONNX format, run by ONNX Runtime on the CPU.

    It has one input of shape (1, 4), the observation (x, x_dot, phi, phi_dot) in SI units, and one
    output of one number: the acceleration u [m/s^2], or an integer, the index of one of the paper's
    actions.
    """

    def __init__(self, path: StrPath) -> None:
        """Read a network.

        Args:
            path: File that holds it, with its weights.

        Raises:
            InputError: The file is no such network.
            MissingExtraError: ONNX Runtime is not installed.
        """
        self._path = Path(path).absolute()
        network = read_bytes(self._path, MAX_FILE_SIZE, "a network", InputError)
        self.digest = DIGEST_PREFIX + hashlib.sha256(network).hexdigest()
        """SHA-256 of the file."""
        runtime = import_optional("onnxruntime", "onnx")
        options = runtime.SessionOptions()
        # A small network gains nothing from more threads.
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            providers = ["CPUExecutionProvider"]
            self._session = runtime.InferenceSession(network, options, providers=providers)
            (entry,) = self._session.get_inputs()
            self._name = entry.name
            self._type = {"tensor(float)": np.float32, "tensor(double)": np.float64}[entry.type]
            self.act(np.zeros(4))
        except Exception as error:  # the runtime has many kinds
            raise InputError(
                f"{path} does not run ({error}); export a network with one input of shape (1, 4), "
                "the numbers x, x_dot, phi, phi_dot, and one output of one number, u or the index "
                "of an action"
            ) from None

    def __reduce__(self) -> Any:
        """Send the network to another process by its file."""
        return OnnxPolicy, (str(self._path),)

    def reset(self) -> None:
        """Do nothing: the network has no state."""

    def act(self, observation: Array) -> float:
        """Return u [m/s^2] of the network for the observation, shape (4,), unchecked.

        Raises:
            InputError: The index of an action does not exist.
        """
        feed = {self._name: observation[None].astype(self._type)}
        (output,) = self._session.run(None, feed)
        number = np.asarray(output).item()
        if isinstance(number, float):
            return number
        if number not in range(len(paper.ACTIONS)):
            expected = f"0 to {len(paper.ACTIONS) - 1}; return one of these, or u as a float"
            raise InputError(f"{self._path} returned the action {number}, expected {expected}")
        return paper.ACTIONS[number]


AnyPolicy = TaskPolicy | PolicySource | StrPath | None
"""A policy with its task, one for `bind_policy`, or the name of one for `load_policy`."""


def read_policy(policy: AnyPolicy) -> TaskPolicy:
    """Return a given policy with its task: its own, or the one that ships.

    Raises:
        InputError: There is no such policy.
    """
    if isinstance(policy, TabularPolicy | BoundPolicy):
        return policy
    if policy is None or isinstance(policy, str | os.PathLike):
        return load_policy(policy)
    return bind_policy(policy)


@checked
def load_policy(
    name: StrPath | None = None,
    *,
    pendulum: Pendulum | StrPath | None = None,
    arm: Arm | StrPath | None = None,
    actuator: Actuator | StrPath | None = None,
    settings: Settings | None = None,
) -> TaskPolicy:
    """Return the policy of a name, bound to its task.

    Args:
        name: File of a table, file of a network (`.onnx`), `module:name` of a function, class or
            object in Python, or `lqr`, `lqr-snapped`, `pd` or `random`; by default the table that
            ships.
        pendulum: Nominal pendulum, or its file; of a table, the one that it must be trained for.
        arm: Arm, its name or its URDF; of a table, the one that it must be trained on.
        actuator: Model of the arm's response; a table has its own.
        settings: Settings of plant, controller and evaluation; a table has its own.

    Raises:
        InputError: The policy does not exist or cannot be used.
        ArtefactError: The file holds no table, or one for another pendulum or arm.
        MissingExtraError: ONNX Runtime is not installed.
    """
    text = "" if name is None else str(name)
    if text in BUILT_IN:
        plant = (settings or Settings()).plant
        parameters = read_pendulum(pendulum).parameters(linearised=plant.linearised)
        policy = KernelPolicy(baselines(parameters, paper.STEP)[BUILT_IN[text]])
    elif Path(text).suffix.lower() == ".onnx":
        policy = OnnxPolicy(text)
    elif ":" in text and not os.path.exists(text):
        policy = PythonPolicy.load(text)
    else:
        nominal = None if pendulum is None else read_pendulum(pendulum)
        return _table(name, nominal, None if arm is None else read_arm(arm), settings)
    return bind_policy(
        policy, name=text, pendulum=pendulum, arm=arm, actuator=actuator, settings=settings
    )


@checked
def bind_policy(
    policy: PolicySource,
    *,
    name: str | None = None,
    pendulum: Pendulum | StrPath | None = None,
    arm: Arm | StrPath | None = None,
    actuator: Actuator | StrPath | None = None,
    settings: Settings | None = None,
) -> BoundPolicy:
    """Bind a function, a class or an object to a task.

    Args:
        policy: As `PythonPolicy` takes it.
        name: Name in results and messages; by default that of the function or class.
        pendulum: Nominal pendulum, or its file; by default the one that ships.
        arm: Arm, its name or its URDF; by default the iiwa7.
        actuator: Model of the arm's response, its file, or `ideal`; by default the one that ships.
        settings: Settings of plant, controller and evaluation; by default all defaults.

    Raises:
        InputError: `policy` is not a policy.
    """
    known = (KernelPolicy, OnnxPolicy, PythonPolicy)
    own = policy if isinstance(policy, known) else PythonPolicy(policy, name)
    return BoundPolicy(
        policy=own,
        name=name or str(getattr(own, "name", type(own).__name__)),
        digest=own.digest,
        kernel=own.kernel if isinstance(own, KernelPolicy) else None,
        pendulum=read_pendulum(pendulum),
        arm=read_arm(arm),
        actuator=read_actuator(actuator),
        settings=settings or Settings(),
    )


def _table(
    path: StrPath | None, pendulum: Pendulum | None, arm: Arm | None, settings: Settings | None
) -> TabularPolicy:
    """Return the table of a file, if it was trained for the task."""
    if path is not None and (Path(path).suffix == ".py" or not os.path.exists(path)):
        raise InputError(
            f"there is no policy {path}; give a file from equipoise train, a network that ends in "
            f".onnx, MODULE:NAME, or one of {', '.join(BUILT_IN)}"
        )
    table = shipped_policy() if path is None else TabularPolicy.load(path)
    if settings is not None:
        raise InputError("a table has the settings of its training; leave out the settings")
    if pendulum is not None and pendulum.digest != table.pendulum.digest:
        raise ArtefactError(
            "the policy was trained for another pendulum; train one for this pendulum with "
            "equipoise train"
        )
    if arm is not None and arm.digest != table.arm.digest:
        raise ArtefactError(
            f"the policy was trained on the {table.arm.name}, not on this {arm.name}; train one "
            "for it with equipoise train --arm"
        )
    return table
