"""Control of a CoppeliaSim: its scene, the parameters of its simulation, and its steps.

Another program may stop or change the simulation. Its time then no longer advances by one step at a
time: an error, never the end of a trial.
"""

import time
import weakref
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from equipoise.apps.coppeliasim.connection import Connection
from equipoise.apps.coppeliasim.scene import build_scene, remove_scene
from equipoise.errors import InputError, OutsideError
from equipoise.model.arms.arm import Arm

Array = npt.NDArray[np.float64]
KINDS: Final = {
    "intparam_idle_fps": "Int32",
    "boolparam_realtime_simulation": "Bool",
    "floatparam_simulation_time_step": "Float",
}
"""Types of the parameters that are changed."""
STOP_TIME: Final = 10.0
"""Longest time for CoppeliaSim to stop a simulation [s]."""
POLL: Final = 0.005
"""Period of the questions whether it has stopped [s]."""
RESTORE_PATIENCE: Final = 2.0
"""Longest wait for an answer at the end [s]: Ctrl-C ends a run soon, also without an answer."""

_open: dict[str, Any] = {}
"""End of the rig of each address in this process: a new one ends it first."""


class CoppeliaRig:
    """Scene in a connected CoppeliaSim, with control of its simulation.

    When the object is dropped, or another one is built there, the simulation is stopped, the scene
    removed, and the changed parameters are set as before.
    """

    def __init__(self, host: str, port: int, arm: Arm, period: float) -> None:
        """Connect, and build the scene.

        Args:
            host: Name or address of the machine.
            port: Port of the server.
            arm: The arm.
            period: Step of the simulation [s].

        Raises:
            LinkError: No CoppeliaSim answers.
            OutsideError: It runs a simulation, or reports an error.
        """
        if (end := _open.pop(f"{host}:{port}", None)) is not None:
            end()
        sim = self.sim = Connection(host, port)
        self._period, self._time, self._steps = period, 0.0, 0
        try:
            if sim.call("getSimulationState") != sim.constant("simulation_stopped"):
                raise OutsideError(
                    f"the CoppeliaSim at {sim.address} runs a simulation; stop it, or give the "
                    "address of another one"
                )
            before = {name: _parameter(sim, name) for name in KINDS}
        except BaseException:
            sim.close()
            raise
        self.close = weakref.finalize(self, _give_back, sim, before)
        """Ends the simulation, as when the object is dropped."""
        _open[sim.address] = self.close
        try:
            for name, value in zip(KINDS, (0, False, period), strict=True):
                _set_parameter(sim, name, value)
            self._scene = build_scene(sim, arm)
        except BaseException:
            self.close()
            raise
        self._free = [self._scene.joints[i] for i in arm.free]

    def start(self) -> None:
        """Start the simulation again, which then advances in `step` alone.

        `stopSimulation` ends the stepping of all clients, and each `setStepping` counts.
        """
        stop(self.sim)
        self._steps = 0
        self.sim.call("setStepping", True)
        self.sim.call("startSimulation")

    def step(self) -> None:
        """Advance by one step of the simulation.

        Raises:
            OutsideError: Another program stopped, paused or changed the simulation.
        """
        self.sim.call("step", True)
        now = self.sim.call("getSimulationTime")
        moved = now - self._time
        if self._steps and abs(moved - self._period) > 1e-3 * self._period:
            raise OutsideError(
                f"another program uses the CoppeliaSim at {self.sim.address}: the simulation "
                f"advanced by {moved:g} s, expected {self._period:g} s; end that program, and "
                "start again"
            )
        self._steps, self._time = self._steps + 1, now

    def place(self, q: Sequence[float] | Array) -> None:
        """Set the positions of the free joints [rad], shape (6,)."""
        for hinge, angle in zip(self._free, q, strict=True):
            self.sim.call("setJointPosition", hinge, angle)

    def swing(self, phi: float) -> None:
        """Set the angle of the pendulum from upright [rad]."""
        self.sim.call("setJointPosition", self._scene.spindle, phi)

    def joints(self) -> Array:
        """Return the positions of all joints [rad], shape (n,)."""
        return np.array([self.sim.call("getJointPosition", hinge) for hinge in self._scene.joints])

    def flange(self) -> tuple[Array, Array]:
        """Return position [m], shape (3,), and rotation, shape (3, 3), of the flange."""
        pose = np.array(self.sim.call("getObjectPose", self._scene.flange))
        return pose[:3], Rotation.from_quat(pose[3:]).as_matrix()


def stop(sim: Connection) -> None:
    """Stop the simulation, if it runs; CoppeliaSim then restores its initial state."""
    stopped, until = sim.constant("simulation_stopped"), time.monotonic() + STOP_TIME
    if sim.call("getSimulationState") == stopped:
        return
    sim.call("stopSimulation")
    while sim.call("getSimulationState") != stopped:
        if time.monotonic() > until:
            raise OutsideError(
                f"the CoppeliaSim at {sim.address} did not stop within {STOP_TIME:g} s; stop it"
            )
        time.sleep(POLL)


def _parameter(sim: Connection, name: str) -> Any:
    return sim.call(f"get{KINDS[name]}Param", sim.constant(name))


def _set_parameter(sim: Connection, name: str, value: Any) -> None:
    sim.call(f"set{KINDS[name]}Param", sim.constant(name), value)


def _give_back(sim: Connection, before: dict[str, Any]) -> None:
    """Stop, remove the scene, set the parameters as before, and disconnect."""
    with suppress(OutsideError, InputError):
        sim.close()  # an interrupted or unanswered request blocks its socket
        sim = Connection(sim.host, sim.port, RESTORE_PATIENCE)
        try:
            stop(sim)
            remove_scene(sim)
            for name, value in before.items():
                _set_parameter(sim, name, value)
        finally:
            sim.close()
