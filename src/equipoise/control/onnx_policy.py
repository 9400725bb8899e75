"""Policies as networks in the ONNX format, run by ONNX Runtime on the CPU.

The network has one input of shape (1, 4), the observation (x, x_dot, phi, phi_dot) in SI units, and
one output of one number: the acceleration u [m/s^2], or an integer, the index of one of the paper's
actions.
"""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from equipoise import paper
from equipoise.arrays import Array
from equipoise.errors import InputError, import_optional
from equipoise.files import DIGEST_PREFIX, MAX_FILE_SIZE, StrPath, read_bytes


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
