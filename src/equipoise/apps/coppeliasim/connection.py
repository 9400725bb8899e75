"""Calls to CoppeliaSim through its own client, `coppeliasim-zmqremoteapi-client`.

The client (2.0.4) waits for ever for a server that does not answer, cannot encode an integer of
NumPy, and raises a bare `Exception` for an error of CoppeliaSim. `Connection` sets limits of time,
converts arguments to numbers of Python, and raises the errors of Equipoise.
"""

import re
from typing import Any, Final

import numpy as np

from equipoise.artefacts import shortened
from equipoise.errors import InputError, LinkError, OutsideError, import_optional
from equipoise.printable import printable

PATIENCE: Final = 10.0
"""Longest wait for an answer [s]; CoppeliaSim answers within a step of its simulation, or within a
pass of its idle loop, an eighth of a second."""
LUA_PLACE: Final = r"^(\S+:)?\d+: (in )?(sim\.\w+: )?|_=NL=_.*"
"""Place in Lua code with which an error of CoppeliaSim begins: file, line and function; and the
lines after its first one."""


class Connection:
    """Connection to a CoppeliaSim that runs its ZeroMQ remote API."""

    def __init__(self, host: str, port: int, patience: float = PATIENCE) -> None:
        """Connect.

        Args:
            host: Name or address of the machine.
            port: Port of the server.
            patience: Longest wait for an answer [s].

        Raises:
            MissingExtraError: The client is not installed.
            InputError: The host is no name and no address.
            LinkError: No CoppeliaSim answers there.
        """
        self.host, self.port, self.address = host, port, f"{host}:{port}"
        self._patience = patience
        made = import_optional("coppeliasim_zmqremoteapi_client", "coppeliasim").RemoteAPIClient
        zmq = import_optional("zmq", "coppeliasim")
        self._error, self._silence = zmq.ZMQError, zmq.Again
        try:
            self._client: Any = made(host, port, verbose=0)
        except self._error as error:
            raise InputError(f"{self.address} is no address ({error})") from None
        wait = round(1e3 * patience)
        for option, value in ((zmq.RCVTIMEO, wait), (zmq.SNDTIMEO, wait), (zmq.LINGER, 0)):
            self._client.socket.setsockopt(option, value)
        # CoppeliaSim forgets a client that is silent for ten minutes; now for a day [s].
        self._client.timeout = 86400.0
        try:
            self._constants: Any = self._guarded("require", self._client.require, "sim")
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the socket; nothing can be called afterwards."""
        self._client.socket.close()

    def constant(self, name: str) -> Any:
        """Return a constant of `sim`.

        Raises:
            LinkError: CoppeliaSim does not know it.
        """
        return self._guarded(name, getattr, self._constants, name)

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function of `sim`.

        Args:
            name: Its name.
            arguments: Numbers, texts, and sequences or arrays of them.

        Returns:
            What it returns: None, one value, or a tuple.

        Raises:
            OutsideError: CoppeliaSim reports an error.
            LinkError: It does not answer, or not by its protocol.
        """
        return self._guarded(name, self._client.call, f"sim.{name}", as_plain(arguments))

    def _guarded(self, name: str, function: Any, *arguments: Any) -> Any:
        if self._client.socket.closed:
            raise LinkError(
                f"the connection to {self.address} is closed: it failed, or another world of this "
                "process took the CoppeliaSim; build the world again"
            )
        try:
            return function(*arguments)
        except self._silence:
            self.close()  # a request without an answer blocks the socket
            raise LinkError(
                f"no CoppeliaSim answers at {self.address} within {self._patience:g} s; start it, "
                "with its ZMQ remote API server (after a crash it may listen on the next port)"
            ) from None
        except self._error as error:
            raise LinkError(f"the connection to {self.address} failed: {error}") from None
        except Exception as error:
            text = printable(shortened(re.sub(LUA_PLACE, "", str(error)), 300))
            if type(error) is not Exception:
                raise LinkError(
                    f"what answers at {self.address} does not speak the protocol of CoppeliaSim "
                    f"4.6 ({type(error).__name__}: {text}); check host and port"
                ) from None
            raise OutsideError(f"CoppeliaSim at {self.address} refuses {name}: {text}") from None
        except BaseException:
            self.close()  # Ctrl-C: the answer is still to come
            raise


def as_plain(value: Any) -> Any:
    """Return numbers, arrays and sequences of them as numbers and lists of Python.

    Example:
        >>> as_plain((np.int64(3), np.array([0.5, 1.0])))
        [3, [0.5, 1.0]]
    """
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [as_plain(entry) for entry in value]
    return value
