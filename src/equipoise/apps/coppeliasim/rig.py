"""Control of a CoppeliaSim: one driver at a time, its scene, and the steps of its simulation.

A driver leaves a marker in CoppeliaSim, the named parameter `equipoise.driver`: its process, and
the parameters of the user as they were. While the process lives, other drivers are refused. The
marker of a killed process stays, and the next driver restores these parameters from it.

Another program may stop or change the simulation nevertheless. Its time then no longer advances by
one step at a time, or a parameter has another value: an error, never the end of a trial.
"""

import os
import platform
import signal
import sys
import threading
import time
import weakref
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from math import sin
from typing import Any, Final
from uuid import uuid4

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from equipoise.apps.coppeliasim.address import SETPOINT_PERIOD, Address
from equipoise.apps.coppeliasim.connection import Connection
from equipoise.apps.coppeliasim.scene import Scene, build_scene, find_scene, remove_scene
from equipoise.artefacts import Value
from equipoise.errors import InputError, OutsideError
from equipoise.model.pendulum import PendulumParameters
from equipoise.printable import printable
from equipoise.settings import GRAVITY
from equipoise.worlds.interface import Setup
from equipoise.worlds.twin.physics import TICK

Array = npt.NDArray[np.float64]
MARKER: Final = "equipoise.driver"
"""Name of the parameter in CoppeliaSim that holds the marker of its driver."""
KINDS: Final = {
    "intparam_idle_fps": "Int32",
    "boolparam_realtime_simulation": "Bool",
    "floatparam_simulation_time_step": "Float",
    "intparam_dynamic_engine": "Int32",
    "floatparam_physicstimestep": "Float",
    "arrayparam_gravity": "Array",
}
"""Types of the parameters that are changed. They are read before the first one is set, and set in
this order: CoppeliaSim returns the step of the engine as a part of the step of the simulation."""
STOP_TIME: Final = 10.0
"""Longest time for CoppeliaSim to stop a simulation [s]."""
POLL: Final = 0.005
"""Period of the questions whether it has stopped [s]."""
RESTORE_PATIENCE: Final = 2.0
"""Longest wait for an answer at the end [s]: Ctrl-C ends a run soon, also without an answer."""
CHECK_STEPS: Final = 200
"""Number of steps between two checks of marker and parameters: one or two seconds of a trial."""
FALL_ANGLE: Final = 0.5
"""Angle at which the pendulum is released to check an engine [rad]."""
FALL_STEPS: Final = 20
"""Number of steps for which it falls: 0.1 s."""


class Marker(Value):
    """Driver of a CoppeliaSim."""

    key: str
    """Random name of the driver."""
    host: str
    """Name of its computer."""
    pid: int
    """Number of its process."""
    before: dict[str, Any]
    """Parameters of CoppeliaSim before the driver changed them, by name."""


_OPEN: dict[str, Any] = {}
"""End of each rig of this process, by the key of its marker: a new one ends it first."""


class CoppeliaRig:
    """Scene in a connected CoppeliaSim, with control of its simulation.

    When the object is dropped, or another one is built there, the simulation is stopped, the scene
    removed, and the changed parameters are set as before.
    """

    def __init__(self, address: Address, setup: Setup, pendulum: PendulumParameters) -> None:
        """Connect, and build the scene.

        Args:
            address: Machine, engine and numbers.
            setup: Arm and time between ticks.
            pendulum: Nominal parameters.

        Raises:
            LinkError: No CoppeliaSim answers.
            OutsideError: It has another driver, runs a simulation, lacks the engine, or reports an
                error.
        """
        sim = self.sim = Connection(address.host, address.port)
        self.address = address
        self.period = setup.h if address.engine is None else SETPOINT_PERIOD
        """Step of the simulation [s]."""
        self._home = np.array(setup.arm.home_free)
        try:
            _take(sim)
            self._parameters = self._wanted()
            before = {name: _parameter(sim, name) for name in self._parameters}
        except BaseException:
            sim.close()
            raise
        self._steps, self._time = 0, 0.0
        self._marker = marker = Marker(
            key=uuid4().hex, host=platform.node(), pid=os.getpid(), before=before
        )
        self.close = weakref.finalize(self, _give_back, sim, marker)
        """Ends the simulation, as when the object is dropped."""
        _OPEN[marker.key] = self.close
        try:
            sim.call("setNamedStringParam", MARKER, marker.model_dump_json())
            _set(sim, self._parameters)
            with _uninterrupted(deliver=True):  # a call cut off leaves an object without a name
                self.scene: Scene = build_scene(sim, setup.arm, address, pendulum)
            self.free = [self.scene.joints[i] for i in setup.arm.free]
            """Handles of the free joints."""
            self.check()
            if address.engine is not None:
                self._check_fall(address.engine, pendulum)
        except BaseException:
            self.close()
            raise

    def _wanted(self) -> dict[str, Any]:
        """Return the parameters of the simulation by name."""
        wanted = {
            "intparam_idle_fps": 0,
            "boolparam_realtime_simulation": False,
            "floatparam_simulation_time_step": self.period,
        }
        if self.address.engine is None:
            return wanted
        return wanted | {
            "intparam_dynamic_engine": self.sim.constant(f"physics_{self.address.engine}"),
            "floatparam_physicstimestep": TICK,
            "arrayparam_gravity": (0.0, 0.0, -GRAVITY),
        }

    def start(self) -> None:
        """Start the simulation, which then advances in `step` alone.

        `stopSimulation` ends the stepping of all clients, and each `setStepping` counts.
        """
        self.sim.call("setStepping", True)
        self.sim.call("startSimulation")

    def stop(self) -> None:
        """Stop the simulation, if it runs; CoppeliaSim then restores its initial state.

        Raises:
            OutsideError: Another program changed the simulation.
        """
        self.check()
        self._steps = 0
        stop(self.sim)

    def step(self) -> None:
        """Advance by one step of the simulation.

        Raises:
            OutsideError: Another program stopped, paused or changed the simulation.
        """
        self.sim.call("step", True)
        now = self.sim.call("getSimulationTime")
        moved = now - self._time
        if self._steps and abs(moved - self.period) > 1e-3 * self.period:
            self._check_state()
            raise self._disturbed(
                f"advanced the simulation by {moved:g} s in a step of {self.period:g} s"
            )
        self._steps, self._time = self._steps + 1, now
        if self._steps % CHECK_STEPS == 0:
            self.check()

    def check(self) -> None:
        """Check that nobody else changed the simulation: before a failure counts, and at a reset.

        Raises:
            OutsideError: They are not.
        """
        if self._steps:
            self._check_state()
        if (found := _marker(self.sim)) is None or found.key != self._marker.key:
            raise self._disturbed("took it over" if found else f"removed the parameter {MARKER}")
        for name, wanted in self._parameters.items():
            value = _parameter(self.sim, name)
            if not np.allclose(value, wanted, rtol=1e-6, atol=1e-9):
                raise self._disturbed(f"set sim.{name} to {value}, expected {wanted}")

    def _check_state(self) -> None:
        state = self.sim.call("getSimulationState")
        for name in ("stopped", "paused"):
            if state == self.sim.constant(f"simulation_{name}"):
                raise self._disturbed(f"{name} the simulation")

    def _disturbed(self, what: str) -> OutsideError:
        return OutsideError(
            f"another program uses the CoppeliaSim at {self.sim.address}, and {what}: the trial "
            "has no result; end that program, and start again"
        )

    def _check_fall(self, engine: str, pendulum: PendulumParameters) -> None:
        """Check that the pendulum falls: an engine that is not installed moves nothing."""
        sim, spindle = self.sim, self.scene.spindle
        self.place(self._home)
        self.aim(self._home)
        sim.call("setJointPosition", spindle, FALL_ANGLE)
        sim.call("setJointTargetForce", spindle, 0.0, False)
        self.start()
        for _ in range(FALL_STEPS):
            self.step()
        fallen = sim.call("getJointPosition", spindle) - FALL_ANGLE
        self.stop()
        t = FALL_STEPS * self.period
        expected = 0.5 * pendulum.w2 * sin(FALL_ANGLE) * t * t
        if not fallen > 0.5 * expected:
            raise OutsideError(
                f"the engine {engine} of the CoppeliaSim at {sim.address} does not run: a pendulum "
                f"released at {FALL_ANGLE:g} rad fell by {fallen:.3f} rad in {t:g} s, expected "
                f"{expected:.2f} rad; install the plug-in of the engine, or choose another one"
            )

    def place(self, q: Sequence[float] | Array) -> None:
        """Set the positions of the free joints [rad], shape (6,)."""
        for hinge, angle in zip(self.free, q, strict=True):
            self.sim.call("setJointPosition", hinge, angle)

    def aim(self, q: Sequence[float] | Array) -> None:
        """Set the targets of their controllers [rad], shape (6,)."""
        for hinge, angle in zip(self.free, q, strict=True):
            self.sim.call("setJointTargetPosition", hinge, angle)

    def joints(self) -> Array:
        """Return the positions of all joints [rad], shape (n,)."""
        return np.array([self.sim.call("getJointPosition", hinge) for hinge in self.scene.joints])

    def pose(self, object_handle: int) -> tuple[Array, Array]:
        """Return position [m], shape (3,), and rotation, shape (3, 3), of an object."""
        pose = np.array(self.sim.call("getObjectPose", object_handle))
        return pose[:3], Rotation.from_quat(pose[3:]).as_matrix()

    def velocity(self, object_handle: int) -> tuple[Array, Array]:
        """Return linear [m/s] and angular velocity [rad/s] of an object, shape (3,) each."""
        linear, angular = self.sim.call("getObjectVelocity", object_handle)
        return np.array(linear), np.array(angular)


def stop(sim: Connection) -> None:
    """Stop the simulation, and wait until it has stopped."""
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


def _set(sim: Connection, values: dict[str, Any]) -> None:
    for name, kind in KINDS.items():
        if name in values:
            sim.call(f"set{kind}Param", sim.constant(name), values[name])


def _marker(sim: Connection) -> Marker | None:
    """Return the marker of the driver of a CoppeliaSim, None without one."""
    text = sim.call("getNamedStringParam", MARKER)
    if not text:
        return None
    try:
        return Marker.model_validate_json(text)
    except ValidationError:
        raise OutsideError(
            f"the CoppeliaSim at {sim.address} has a parameter {MARKER} that no driver of this "
            "version wrote; restart CoppeliaSim"
        ) from None


def _take(sim: Connection) -> None:
    """Restore what a killed driver left; reject a live driver, and a simulation of the user."""
    if (marker := _marker(sim)) is not None and marker.key in _OPEN:
        _OPEN[marker.key]()
        marker = _marker(sim)
    if marker is not None and _is_alive(marker):
        raise OutsideError(
            f"process {marker.pid} on {printable(marker.host)} drives the CoppeliaSim at "
            f"{sim.address}; wait until it ends, or give the address of another CoppeliaSim (if "
            "there is no such run, restart CoppeliaSim)"
        )
    running = sim.call("getSimulationState") != sim.constant("simulation_stopped")
    if running and (marker is None or find_scene(sim) < 0):
        raise OutsideError(
            f"the CoppeliaSim at {sim.address} runs a simulation; stop it, or give the address of "
            "another one"
        )
    if marker is not None:
        _restore(sim, marker)


def _is_alive(marker: Marker) -> bool:
    """Return whether the process of a driver lives, as far as this computer can tell."""
    if marker.host != platform.node() or sys.platform == "win32":
        return True
    if marker.pid == os.getpid():  # its rig is not open
        return False
    try:
        os.kill(marker.pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _restore(sim: Connection, marker: Marker) -> None:
    """Stop, remove the scene, set the parameters as they were, and remove the marker."""
    stop(sim)
    remove_scene(sim)
    _set(sim, marker.before)
    sim.call("setNamedStringParam", MARKER, "")


def _give_back(sim: Connection, marker: Marker) -> None:
    """Restore the CoppeliaSim of a driver and disconnect; without success the marker stays."""
    _OPEN.pop(marker.key, None)
    with _uninterrupted(deliver=False), suppress(OutsideError, InputError):
        sim.close()  # an interrupted or unanswered request blocks its socket
        sim = Connection(sim.host, sim.port, RESTORE_PATIENCE)
        try:
            found = _marker(sim)
            if found is not None and found.key == marker.key:
                _restore(sim, marker)
        finally:
            sim.close()


@contextmanager
def _uninterrupted(*, deliver: bool) -> Generator[None]:
    """Hold Ctrl-C and SIGTERM back, which reach the main thread alone; deliver one at the end."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard = list[int]()
    numbers = signal.SIGINT, signal.SIGTERM
    before = [(each, signal.signal(each, lambda n, _: heard.append(n))) for each in numbers]
    try:
        yield
    finally:
        for number, old in before:
            signal.signal(number, signal.SIG_DFL if old is None else old)
    if deliver and heard:
        signal.raise_signal(heard[0])
