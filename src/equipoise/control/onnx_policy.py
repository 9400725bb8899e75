"""Policies as networks in the ONNX format, run by ONNX Runtime on the CPU.

The network has one input of four numbers, the observation (x, x_dot, phi, phi_dot) in SI units,
and one output of one number, the acceleration u [m/s^2]. Dimensions of one around them, such as
that of a batch, do not matter.
"""

import hashlib
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from equipoise.artefacts import DIGEST_PREFIX, StrPath
from equipoise.control.policy import Array
from equipoise.errors import InputError, import_optional

TYPES: Final = {"tensor(float)": np.float32, "tensor(double)": np.float64}
"""Element types of the input."""


class OnnxPolicy:
    """A network without a state."""

    def __init__(self, path: StrPath) -> None:
        """Read a network.

        Args:
            path: File that holds it, with its weights.

        Raises:
            InputError: The file is no such network.
            MissingExtraError: ONNX Runtime is not installed.
        """
        self._path = Path(path).absolute()
        try:
            network = self._path.read_bytes()
        except OSError as error:
            raise InputError(f"cannot read {path}: {error.strerror or error}") from None
        self.digest = DIGEST_PREFIX + hashlib.sha256(network).hexdigest()
        """SHA-256 of the file."""
        self._session = _session(network, self._path)
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        expected = (
            f"{path} has {len(inputs)} inputs and {len(outputs)} outputs; expected one input of 4 "
            "numbers (x, x_dot, phi, phi_dot) and one output of one number (u)"
        )
        if len(inputs) != 1 or len(outputs) != 1 or inputs[0].type not in TYPES:
            raise InputError(expected)
        shape = [size if isinstance(size, int) else 1 for size in inputs[0].shape]
        if shape and not isinstance(inputs[0].shape[-1], int):
            shape[-1] = 4
        self._input: npt.NDArray[Any] = np.zeros(shape, TYPES[inputs[0].type])
        self._feed = {inputs[0].name: self._input}
        try:
            fits = self._input.size == 4 and self._run().size == 1
        except Exception as error:  # the runtime has many kinds
            raise InputError(f"{path} does not run ({error}); export it again") from None
        if not fits:
            raise InputError(expected)

    def __reduce__(self) -> Any:
        """Send the network to another process by its file."""
        return OnnxPolicy, (str(self._path),)

    def reset(self) -> None:
        """Do nothing: the network has no state."""

    def act(self, observation: Array) -> float:
        """Return the output of the network for the observation, shape (4,), unchecked."""
        self._input.ravel()[:] = observation
        return self._run().item()

    def _run(self) -> Array:
        return np.asarray(self._session.run(None, self._feed)[0])


def _session(network: bytes, path: Path) -> Any:
    """Return a session of ONNX Runtime on one thread: a small network gains nothing from more."""
    runtime = import_optional("onnxruntime", "onnx")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return runtime.InferenceSession(network, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the runtime has many kinds
        raise InputError(f"{path} is no network that ONNX Runtime reads ({error})") from None
