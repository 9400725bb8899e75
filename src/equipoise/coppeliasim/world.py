"""Trials in CoppeliaSim, the successor of the paper's V-REP: worlds `coppeliasim://HOST:PORT`.

As in the paper's simulation the arm is kinematic: the controller of the world `ideal` commands the
joints, CoppeliaSim places them and gives the pose of the flange at the middle and at the end of a
tick. Over a tick the acceleration is constant, so three places give the velocity at its end::

    v = (3 p(h) - 4 p(h / 2) + p(0)) / h        u' = (v - v_before) / h

and the pendulum advances by the step of the training. Every call waits for its answer, and
CoppeliaSim advances in `step` alone. There is one scene: trials run one after the other.
"""

import re
from typing import ClassVar

import numpy as np

from equipoise.arrays import Array
from equipoise.control.control_step import SETPOINTS_PER_TICK
from equipoise.coppeliasim.rig import CoppeliaRig
from equipoise.errors import SettingsError
from equipoise.files import quoted
from equipoise.model.pendulum import step as pendulum_step
from equipoise.model.worlds import World
from equipoise.simulation import ExternalLoop, Setup, Simulation


def read_address(text: str) -> tuple[str, int]:
    """Return host and port of an address.

    Raises:
        SettingsError: The address has another form.

    Example:
        >>> read_address("coppeliasim://localhost")
        ('localhost', 23000)
    """
    match = re.fullmatch(r"coppeliasim://([\w.-]+|\[[\da-fA-F:]+\])(?::(\d{1,5}))?/?", text)
    port = int((match and match[2]) or 23000)  # the default of CoppeliaSim
    if match is None or not 0 < port < 2**16:
        form = "coppeliasim://HOST:PORT"
        raise SettingsError(f"{quoted(text)} is no address of CoppeliaSim; expected {form}")
    return match[1], port


class CoppeliaSimulation(Simulation):
    """Trials in a CoppeliaSim."""

    ideal_arm: ClassVar[bool] = True

    def __init__(self, world: str | World, setup: Setup, *, seed: int, stream: int) -> None:
        """Connect, and build the scene; see `Simulation`.

        Raises:
            LinkError: No CoppeliaSim answers.
            MissingExtraError: The client is not installed.
            OutsideError: CoppeliaSim runs a simulation of the user, reports an error, or built
                another arm than that of the model.
            SettingsError: The address has another form.
        """
        super().__init__(world, setup, seed=seed, stream=stream)
        self.rig = CoppeliaRig(*read_address(str(world)), setup.arm, setup.h)

    def loop(self) -> "CoppeliaLoop":
        """Return a closed loop for `reset`; all of them share the one scene."""
        return CoppeliaLoop(self)


class CoppeliaLoop(ExternalLoop):
    """Closed loop on the kinematic arm, with the pendulum of Equipoise."""

    def __init__(self, simulation: CoppeliaSimulation) -> None:
        """Allocate the controller."""
        super().__init__(simulation)
        self._rig, self._pivot = simulation.rig, np.array(simulation.setup.arm.pivot)
        self._home_x = float(self.params.home_reference[0])

    def release(self, q: Array, start: tuple[float, float, float, float]) -> None:
        """Place the arm, and release the pendulum; see `ExternalLoop.release`."""
        _, x_dot, self._phi, self._phi_dot = start
        self._rig.reset()
        self._rig.swing(self._phi)
        self._places, self._velocity = [self._place(q)], np.array([x_dot, x_dot])

    def send(self, q: Array) -> None:
        """Place the joints [rad]; at the end of the tick advance the pendulum."""
        self._places.append(self._place(q))
        if len(self._places) <= SETPOINTS_PER_TICK:
            return
        (p0, p1, p2), h, before = self._places, self.params.h, self._velocity
        self._places, self._velocity = [p2], (3.0 * p2 - 4.0 * p1 + p0) / h
        u = float(self._velocity[1] - before[1]) / h
        self._phi, self._phi_dot = pendulum_step(self._phi, self._phi_dot, u, h, self.pendulum)
        self._rig.swing(self._phi)
        self._rig.step()

    def _place(self, q: Array) -> Array:
        """Place the joints; return the places of flange and pivot along base x [m], shape (2,)."""
        position, R = self._rig.place(q)
        return np.array([position[0], position[0] + R[0] @ self._pivot])

    def read(self) -> Array:
        """Return the true x, x_dot, phi, phi_dot in SI units, shape (4,)."""
        x = self._places[-1][0] - self._home_x
        return np.array([x, self._velocity[0], self._phi, self._phi_dot])

    def joints(self) -> Array:
        """Return the true positions of all joints [rad], shape (n,)."""
        return self._rig.joints()
