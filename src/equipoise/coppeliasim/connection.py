"""Calls to CoppeliaSim through its own client, `coppeliasim-zmqremoteapi-client`.

The client (2.0.4) waits for ever for a server that does not answer, or that asks to wait again and
again, and raises a bare `Exception` for an error of CoppeliaSim. `Connection` limits the time of a
call, and raises the errors of Equipoise.
"""

import time
from typing import Any, Final

from equipoise.errors import InputError, LinkError, OutsideError, import_optional
from equipoise.files import shortened
from equipoise.printable import printable

FORGOTTEN: Final = 60.0
"""Silence after which CoppeliaSim forgets a client, and no longer stops for its steps [s]."""


class Connection:
    """Connection to a CoppeliaSim that runs its ZeroMQ remote API."""

    def __init__(self, host: str, port: int, patience: float = 10.0) -> None:
        """Connect.

        Args:
            host: Name or address of the machine.
            port: Port of the server.
            patience: Longest duration of a call [s]; CoppeliaSim answers within a step of its
                simulation, or within a pass of its idle loop, an eighth of a second.

        Raises:
            MissingExtraError: The client is not installed.
            InputError: The host is no name and no address.
            LinkError: No CoppeliaSim answers there.
        """
        self.host, self.port, self.address = host, port, f"{host}:{port}"
        self._patience = patience
        client = import_optional("coppeliasim_zmqremoteapi_client", "coppeliasim")
        zmq = self._zmq = import_optional("zmq", "coppeliasim")
        try:
            self._client: Any = client.RemoteAPIClient(host, port, verbose=0)
        except zmq.ZMQError as error:
            raise InputError(f"{self.address} is no address ({error})") from None
        self._client.timeout = FORGOTTEN
        socket = self._client.socket
        socket.setsockopt(zmq.SNDTIMEO, round(1e3 * patience))
        socket.setsockopt(zmq.LINGER, 0)
        self._receive, socket.recv = socket.recv, self._receive_in_time
        self.constants: Any = self._guarded("require", self._client.require, "sim")
        """Constants of `sim`, as attributes."""

    def close(self) -> None:
        """Close the socket; nothing can be called afterwards."""
        self._client.socket.close()

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function of `sim`.

        Args:
            name: Its name.
            arguments: Numbers but NumPy's integers, texts, and tuples or lists of them.

        Returns:
            What it returns: None, one value, or a tuple.

        Raises:
            OutsideError: CoppeliaSim reports an error.
            LinkError: It does not answer.
        """
        return self._guarded(name, self._client.call, f"sim.{name}", arguments)

    def _guarded(self, name: str, function: Any, *arguments: Any) -> Any:
        self._until = time.monotonic() + self._patience
        try:
            return function(*arguments)
        except self._zmq.Again:
            self.close()  # a request without an answer blocks the socket
            raise LinkError(
                f"no CoppeliaSim answers at {self.address} within {self._patience:g} s, or it "
                f"does not finish {name} then, as another client holds its simulation; start it, "
                "with its ZMQ remote API server (after a crash it may listen on the next port), or "
                "end that client"
            ) from None
        except Exception as error:  # the client raises this class for an error of CoppeliaSim
            text = printable(shortened(str(error).split("_=NL=_")[0], 300))
            raise OutsideError(
                f"the CoppeliaSim at {self.address} refuses {name} ({text}); check the address; if "
                "another program changed the scene, end that program, and start again"
            ) from None
        except BaseException:
            self.close()  # Ctrl-C: the answer is still to come
            raise

    def _receive_in_time(self) -> bytes:
        """Receive a reply, which may be a request to wait, by the deadline of the call."""
        if not self._client.socket.poll(max(1e3 * (self._until - time.monotonic()), 0.0)):
            raise self._zmq.Again
        return self._receive()
