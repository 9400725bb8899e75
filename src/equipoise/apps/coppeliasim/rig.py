"""Control of a CoppeliaSim: its scene, the parameters of its simulation, and its steps.

Another program may stop or change the simulation. Its time then no longer advances by one step at a
time: an error, never the end of a trial.
"""

import time
import weakref
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from equipoise.apps.coppeliasim.connection import Connection
from equipoise.apps.coppeliasim.scene import build_scene, remove_scene
from equipoise.errors import InputError, OutsideError
from equipoise.model.arms.arm import Arm

Array = npt.NDArray[np.float64]

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
            changes = {
                ("Int32", sim.constant("intparam_idle_fps")): 0,
                ("Bool", sim.constant("boolparam_realtime_simulation")): False,
                ("Float", sim.constant("floatparam_simulation_time_step")): period,
            }
            before = {key: sim.call(f"get{key[0]}Param", key[1]) for key in changes}
        except BaseException:
            sim.close()
            raise
        self.close = weakref.finalize(self, _give_back, sim, before)
        """Ends the simulation, as when the object is dropped."""
        _open[sim.address] = self.close
        try:
            _set_parameters(sim, changes)
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
    stopped, until = sim.constant("simulation_stopped"), time.monotonic() + 10.0
    if sim.call("getSimulationState") == stopped:
        return
    sim.call("stopSimulation")
    while sim.call("getSimulationState") != stopped:
        if time.monotonic() > until:
            raise OutsideError(
                f"the CoppeliaSim at {sim.address} did not stop within 10 s; stop it"
            )
        time.sleep(0.005)


def _set_parameters(sim: Connection, values: dict[tuple[str, int], Any]) -> None:
    for (kind, parameter), value in values.items():
        sim.call(f"set{kind}Param", parameter, value)


def _give_back(sim: Connection, before: dict[tuple[str, int], Any]) -> None:
    """Stop, remove the scene, set the parameters as before, and disconnect."""
    with suppress(OutsideError, InputError):
        sim.close()  # an interrupted or unanswered request blocks its socket
        # Ctrl-C ends a run soon, also without an answer: wait for 2 s at most.
        sim = Connection(sim.host, sim.port, patience=2.0)
        try:
            stop(sim)
            remove_scene(sim)
            _set_parameters(sim, before)
        finally:
            sim.close()
