"""`franky-sim` in a process of its own, in lockstep with virtual time.

The driver's library keeps Python's lock while it waits for the controller, so that both cannot
share a process. Each millisecond of virtual time is one cycle of the controller: it processes the
driver's command, moves the arm, and sends its state.
"""

import multiprocessing
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any, Final

from equipoise.errors import EquipoiseError, MissingExtraError
from equipoise.rig.simulated_rig import Bodies

POLL: Final = 0.002
"""Real time without a cycle after which a waiting client is served [s]."""


def require_emulator() -> None:
    """Check that `franky-sim` is installed.

    Raises:
        MissingExtraError: It is not.
    """
    if find_spec("franky_sim") is None:
        raise MissingExtraError(
            "an emulated FR3 needs the package franky-sim, which is not installed; install it: "
            "python -m pip install './plugins/equipoise-franka[emulator]'"
        )


class Lockstep:
    """The rig of another process: its acts, its time, and what is seen of it."""

    def __init__(self, bodies: Bodies) -> None:
        """Start the process.

        Raises:
            InputError: The arm is no FR3.
            MissingExtraError: `franky-sim` is not installed.
            OutsideError: No address is free.
        """
        require_emulator()
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, bodies), daemon=True)
        self._process.start()
        theirs.close()
        self.settings = bodies.settings
        """Settings of the world."""
        self.host: str = self._receive()
        """Address of the controller."""
        self.advance(bodies.start)

    def advance(self, now: float) -> None:
        """Advance the rig to a time [s], and update `q`, `theta` and `button` of the bench."""
        self.q, self.theta, self.button = self._call("advance", now)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        """Return an act of the rig or its controller, such as `lift`."""
        if name.startswith("_"):
            raise AttributeError(name)
        return partial(self._call, name)

    def _call(self, name: str, *arguments: Any, **options: Any) -> Any:
        self._pipe.send((name, arguments, options))
        return self._receive()

    def _receive(self) -> Any:
        received = self._pipe.recv()
        if isinstance(received, EquipoiseError):
            raise received
        return received

    def close(self) -> None:
        """End the process."""
        self._pipe.close()
        self._process.join(5.0)


def _serve(pipe: Any, bodies: Bodies) -> None:
    from equipoise_franka.franky import FrankyRig

    try:
        rig = FrankyRig(bodies)
    except EquipoiseError as error:
        pipe.send(error)
        return
    pipe.send(rig.controller.hostname)
    while True:
        try:
            if not pipe.poll(POLL):
                rig.controller.reply()
                continue
            name, arguments, options = pipe.recv()
        except EOFError:
            return
        owner = rig if hasattr(rig, name) else rig.controller
        result = getattr(owner, name)(*arguments, **options)
        pipe.send((rig.q, rig.theta, rig.button) if name == "advance" else result)
