"""Control of a CoppeliaSim: its scene, the parameters of its simulation, and its steps.

Everything that is built is below one dummy, which carries the user's parameters: a run that was
killed is undone by the next one. Another program may stop the simulation, or change it or its
objects. Then its time does not advance by one step at a time, or the flange is not where the
kinematics say: an error, never the end of a trial.
"""

import json
import signal
import threading
import time
import weakref
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from equipoise.apps.coppeliasim.connection import FORGOTTEN, Connection
from equipoise.apps.coppeliasim.scene import build_scene
from equipoise.arrays import Array
from equipoise.errors import InputError, OutsideError
from equipoise.model.arms.arm import Arm
from equipoise.rig.host import SIGNALS, handled_signals

Parameters = list[tuple[str, int, Any]]
"""Type, number and value of parameters of the simulation."""

TAG: Final = "equipoise"
"""Tag of the data of our root object, in the simulator: the user's parameters, as JSON."""
TOLERANCE: Final = 1e-6
"""Largest difference of the flange from the kinematics, in position [m] and rotation [-]; 1e-15
was measured in CoppeliaSim 4.10.0."""


class CoppeliaRig:
    """Scene in a connected CoppeliaSim, with control of its simulation.

    When the object is dropped, the simulation is stopped, the scene removed, and the changed
    parameters are set as before. A later object takes the CoppeliaSim over from an earlier one,
    also from that of another process.
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
            OutsideError: It runs a simulation of the user, reports an error, or the arm that it
                built is not that of the model.
        """
        sim = self.sim = Connection(host, port)
        self._arm, self._period, self._time, self._steps = arm, period, 0.0, 0
        try:
            earlier = _roots(sim)
            if not earlier and sim.call("getSimulationState") != sim.constant("simulation_stopped"):
                raise OutsideError(
                    f"the CoppeliaSim at {sim.address} runs a simulation; stop it, or give the "
                    "address of another one"
                )
            stop(sim)
            changed: Parameters = [
                ("Int32", sim.constant("intparam_idle_fps"), 0),
                ("Bool", sim.constant("boolparam_realtime_simulation"), False),
                ("Float", sim.constant("floatparam_simulation_time_step"), period),
            ]
            before = [(kind, key, sim.call(f"get{kind}Param", key)) for kind, key, _ in changed]
            before = next(iter(earlier.values()), before)
        except BaseException:
            sim.close()
            raise
        with _deferred_signals() as caught:
            root = sim.call("createDummy", 0.02)
            sim.call("writeCustomStringData", root, TAG, json.dumps(before))
            self.close = weakref.finalize(self, _give_back, sim, root, before)
            """Ends the simulation, as when the object is dropped."""
            try:
                _remove(sim, earlier)
                _set_parameters(sim, changed)
                self._scene = build_scene(sim, arm, root)
                self._free = [self._scene.joints[i] for i in arm.free]
                self.place(arm.home_free)
                if caught:
                    raise KeyboardInterrupt
            except BaseException:
                self.close()
                raise

    def reset(self) -> None:
        """Stop the simulation; the next step starts it again."""
        self.swing(0.0)  # an error if another client took the CoppeliaSim over
        stop(self.sim)
        self._steps = 0

    def step(self) -> None:
        """Advance by one step of the simulation, which advances here alone.

        Raises:
            OutsideError: Another program stopped, paused or changed the simulation.
        """
        if not self._steps:  # `stopSimulation` ends the stepping of all clients
            self.sim.call("setStepping", True)
            self.sim.call("startSimulation")
        self.sim.call("step", True)
        now = self.sim.call("getSimulationTime")
        moved = now - self._time
        if self._steps and abs(moved - self._period) > 1e-3 * self._period:
            raise OutsideError(
                f"the simulation in the CoppeliaSim at {self.sim.address} advanced by {moved:g} s, "
                f"expected {self._period:g} s: another program uses it, or Equipoise paused for "
                f"more than {FORGOTTEN:g} s; end that program, and start again"
            )
        self._steps, self._time = self._steps + 1, now

    def place(self, q: Sequence[float] | Array) -> tuple[Array, Array]:
        """Set the positions of the free joints.

        Args:
            q: Free joints [rad], shape (6,).

        Returns:
            Position [m], shape (3,), and rotation, shape (3, 3), of the flange in CoppeliaSim.

        Raises:
            OutsideError: The flange is not where the kinematics of the arm say.
        """
        for hinge, angle in zip(self._free, q, strict=True):
            self.sim.call("setJointPosition", hinge, angle)
        pose = np.array(self.sim.call("getObjectPose", self._scene.flange))
        position, R = pose[:3], Rotation.from_quat(pose[3:]).as_matrix()
        expected = self._arm.kinematics(q)
        away = np.append(position - expected.position, R - expected.rotation)
        if not np.abs(away).max() < TOLERANCE:
            degrees = np.degrees(Rotation.from_matrix(R @ expected.rotation.T).magnitude())
            raise OutsideError(
                f"the flange in the CoppeliaSim at {self.sim.address} is "
                f"{1e3 * np.linalg.norm(away[:3]):.3g} mm and {degrees:.3g} degrees from its place "
                "in the model: another program moved the arm, or CoppeliaSim built another one; "
                "end that program, and start again"
            )
        return position, R

    def swing(self, phi: float) -> None:
        """Set the angle of the pendulum from upright [rad]."""
        self.sim.call("setJointPosition", self._scene.spindle, phi)

    def joints(self) -> Array:
        """Return the positions of all joints [rad], shape (n,)."""
        return np.array([self.sim.call("getJointPosition", hinge) for hinge in self._scene.joints])


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


def _set_parameters(sim: Connection, values: Parameters) -> None:
    for kind, parameter, value in values:
        sim.call(f"set{kind}Param", parameter, value)


def _roots(sim: Connection) -> dict[int, Parameters]:
    """Return the root objects of Equipoise, with the parameters that the user had set."""
    whole, every = sim.constant("handle_scene"), sim.constant("handle_all")
    parentless = sim.call("getObjectsInTree", whole, every, 2)
    texts = {root: sim.call("readCustomStringData", root, TAG) for root in parentless}
    return {root: json.loads(text) for root, text in texts.items() if text}


def _remove(sim: Connection, roots: dict[int, Parameters]) -> None:
    for root in roots:
        sim.call("removeObjects", sim.call("getObjectsInTree", root))


def _give_back(sim: Connection, root: int, before: Parameters) -> None:
    """Stop, set the parameters as before, remove the scene, and disconnect."""
    with suppress(OutsideError, InputError), _deferred_signals():
        sim.close()  # an interrupted or unanswered request blocks its socket
        # Ctrl-C ends a run soon, also without an answer: wait for 2 s at most.
        sim = Connection(sim.host, sim.port, patience=2.0)
        try:
            if not (roots := _roots(sim)).keys() - {root}:  # no later client took it over
                stop(sim)
                _set_parameters(sim, before)
                _remove(sim, roots)
        finally:
            sim.close()


@contextmanager
def _deferred_signals() -> Generator[list[int]]:
    """Collect the signals that would interrupt the main thread in this context."""
    caught = list[int]()
    if threading.current_thread() is not threading.main_thread():
        yield caught
        return
    heard = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    with handled_signals(heard, lambda number, _: caught.append(number)):
        yield caught
