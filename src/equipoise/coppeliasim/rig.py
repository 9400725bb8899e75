"""Control of a CoppeliaSim: its scene, the parameters of its simulation, and its steps.

No scene file is needed: base, links, joints, flange and pendulum are created one by one below one
dummy, with all joints at zero. The limits of the joints follow at home: CoppeliaSim moves a joint
into its limits, and those of some arms exclude zero. A joint of CoppeliaSim turns about its z axis.
All joints are kinematic: they are set, and nothing moves or collides by itself.

The dummy carries the user's parameters: a run that was killed is undone by the next one. Another
program may stop the simulation, or change it or its objects. Then its time does not advance by one
step at a time, or the flange is not where the kinematics say: an error, never the end of a trial.

Calls go through CoppeliaSim's own client, `coppeliasim-zmqremoteapi-client`. The client (2.0.4)
waits for ever for a server that does not answer, or that asks to wait again and again, and raises a
bare `Exception` for an error of CoppeliaSim. `Connection` limits the time of a call, and raises the
errors of Equipoise.
"""

import json
import signal
import threading
import time
import weakref
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from equipoise.arm.arm import Arm
from equipoise.arm.chain import rotation_from_rpy, turned_to
from equipoise.arm.scene import SHORTEST, SIZES, sizes_for
from equipoise.arrays import Array
from equipoise.errors import InputError, LinkError, OutsideError, import_optional
from equipoise.files import shortened
from equipoise.printable import printable
from equipoise.rig.host import SIGNALS, handled_signals

FORGOTTEN: Final = 60.0
"""Silence after which CoppeliaSim forgets a client, and no longer stops for its steps [s]."""
Parameters = list[tuple[str, int, Any]]
"""Type, number and value of parameters of the simulation."""
TAG: Final = "equipoise"
"""Tag of the data of our root object, in the simulator: the user's parameters, as JSON."""


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
        earlier, constants = _roots(sim), sim.constants
        if not earlier and sim.call("getSimulationState") != constants.simulation_stopped:
            raise OutsideError(
                f"the CoppeliaSim at {sim.address} runs a simulation; stop it, or give the "
                "address of another one"
            )
        stop(sim)
        changed: Parameters = [
            ("Int32", constants.intparam_idle_fps, 0),
            ("Bool", constants.boolparam_realtime_simulation, False),
            ("Float", constants.floatparam_simulation_time_step, period),
        ]
        before = [(kind, key, sim.call(f"get{kind}Param", key)) for kind, key, _ in changed]
        before = next(iter(earlier.values()), before)
        with _deferred_signals() as caught:
            root = sim.call("createDummy", 0.02)
            sim.call("writeCustomStringData", root, TAG, json.dumps(before))
            self.close = weakref.finalize(self, _give_back, sim, root, before)
            """Ends the simulation, as when the object is dropped."""
            try:
                _undo(sim, earlier, changed)
                self._joints, self._flange, self._spindle = build_scene(sim, arm, root)
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
        for hinge, angle in zip(self._arm.without_held(self._joints), q, strict=True):
            self.sim.call("setJointPosition", hinge, angle)
        pose = np.array(self.sim.call("getObjectPose", self._flange))
        position, R = pose[:3], Rotation.from_quat(pose[3:]).as_matrix()
        expected = self._arm.kinematics(q)
        # Distance [m] and rotation [-]; 1e-15 was measured in CoppeliaSim 4.10.0.
        away = np.append(position - expected.position, R - expected.rotation)
        if not np.abs(away).max() < 1e-6:
            raise OutsideError(
                f"the flange in the CoppeliaSim at {self.sim.address} is "
                f"{1e3 * np.linalg.norm(away[:3]):.3g} mm from its place in the model, or turned: "
                "another program moved the arm, or CoppeliaSim built another one; end that "
                "program, and start again"
            )
        return position, R

    def swing(self, phi: float) -> None:
        """Set the angle of the pendulum from upright [rad]."""
        self.sim.call("setJointPosition", self._spindle, phi)

    def joints(self) -> Array:
        """Return the positions of all joints [rad], shape (n,)."""
        return np.array([self.sim.call("getJointPosition", hinge) for hinge in self._joints])


def build_scene(sim: Connection, arm: Arm, root: int) -> tuple[list[int], int, int]:
    """Build arm and pendulum at home; return the handles of all joints, flange and spindle.

    Args:
        sim: Connection; its simulation is stopped.
        arm: The arm.
        root: Handle of the dummy below which everything is built.

    Raises:
        OutsideError: CoppeliaSim reports an error.
    """
    sim.call("setObjectAlias", root, "equipoise")
    hand = 2.0 * sizes_for(arm).hand
    base = _transform((0.0, 0.0, -0.01))
    parent = _shape(sim, "base", "cuboid", (0.3, 0.3, 0.02), base, root)  # [m]
    frame, joints = np.eye(4), list[int]()
    steps = [*(joint.xyz for joint in arm.joints[1:]), arm.flange_xyz]
    for number, (joint, step) in enumerate(zip(arm.joints, steps, strict=True), 1):
        frame = frame @ _transform(joint.xyz, rotation_from_rpy(joint.rpy))
        hinge = _joint(sim, f"joint{number}", frame, joint.axis, parent)
        length = float(np.linalg.norm(step))
        kind, size, middle = "spheroid", (hand, hand, hand), np.eye(4)
        if length > SHORTEST:
            kind, size = "cylinder", (hand, hand, length)
            middle = _transform(0.5 * np.array(step), turned_to(np.array(step)))
        parent = _shape(sim, f"link{number}", kind, size, frame @ middle, hinge)
        joints.append(hinge)
    frame = frame @ _transform(arm.flange_xyz, rotation_from_rpy(arm.flange_rpy))
    flange = _add(sim, "Dummy", (0.02,), "flange", frame, parent)
    frame = frame @ _transform(arm.pivot, arm.kinematics(arm.home_free).rotation.T)
    spindle = _joint(sim, "phi", frame, (0.0, 1.0, 0.0), parent)
    sim.call("setJointInterval", spindle, True, (-np.pi, 2.0 * np.pi))
    size = (2.0 * SIZES.rod, 2.0 * SIZES.rod, SIZES.rod_length)
    middle = _transform((0.0, 0.0, 0.5 * SIZES.rod_length))
    _shape(sim, "pendulum", "cylinder", size, frame @ middle, spindle)
    for hinge, joint, q in zip(joints, arm.joints, arm.home, strict=True):
        sim.call("setJointPosition", hinge, q)
        sim.call("setJointInterval", hinge, False, (joint.lower, joint.upper - joint.lower))
    return joints, flange, spindle


def _transform(xyz: Sequence[float] | Array, R: Array | None = None) -> Array:
    """Return the transform of a place and a rotation, shape (4, 4)."""
    T = np.eye(4)
    T[:3, 3] = xyz
    if R is not None:
        T[:3, :3] = R
    return T


def _joint(sim: Connection, alias: str, T: Array, axis: Sequence[float], parent: int) -> int:
    """Create a revolute joint about an axis of the frame T; return its handle."""
    kind, mode = sim.constants.joint_revolute, sim.constants.jointmode_kinematic
    turn = _transform((0.0, 0.0, 0.0), turned_to(np.array(axis)))
    return _add(sim, "Joint", (kind, mode, 0, (0.15, 0.02)), alias, T @ turn, parent)


def _shape(
    sim: Connection, alias: str, kind: str, size: Sequence[float], T: Array, parent: int
) -> int:
    """Create a static primitive shape at T; return its handle."""
    shape = getattr(sim.constants, f"primitiveshape_{kind}")
    handle = _add(sim, "PrimitiveShape", (shape, size, 0), alias, T, parent)
    sim.call("setObjectInt32Param", handle, sim.constants.shapeintparam_respondable, 0)
    sim.call("setObjectInt32Param", handle, sim.constants.shapeintparam_static, 1)
    return handle


def _add(
    sim: Connection, kind: str, args: Sequence[object], alias: str, T: Array, parent: int
) -> int:
    """Create an object below its parent, with which it is removed; return its handle."""
    handle = sim.call(f"create{kind}", *args)
    sim.call("setObjectParent", handle, parent, True)
    sim.call("setObjectAlias", handle, alias)
    pose = (*T[:3, 3].tolist(), *Rotation.from_matrix(T[:3, :3]).as_quat())
    sim.call("setObjectPose", handle, pose)
    return handle


def stop(sim: Connection) -> None:
    """Stop the simulation, if it runs; CoppeliaSim then restores its initial state."""
    stopped, until = sim.constants.simulation_stopped, time.monotonic() + 10.0
    if sim.call("getSimulationState") == stopped:
        return
    sim.call("stopSimulation")
    while sim.call("getSimulationState") != stopped:
        if time.monotonic() > until:
            raise OutsideError(
                f"the CoppeliaSim at {sim.address} did not stop within 10 s; stop it"
            )
        time.sleep(0.005)


def _roots(sim: Connection) -> dict[int, Parameters]:
    """Return the root objects of Equipoise, with the parameters that the user had set."""
    scene, any_type = sim.constants.handle_scene, sim.constants.handle_all
    parentless = sim.call("getObjectsInTree", scene, any_type, 2)
    texts = {root: sim.call("readCustomStringData", root, TAG) for root in parentless}
    return {root: json.loads(text) for root, text in texts.items() if text}


def _undo(sim: Connection, roots: Iterable[int], values: Parameters) -> None:
    """Remove root objects with all below them, and set parameters."""
    for root in roots:
        sim.call("removeObjects", sim.call("getObjectsInTree", root))
    for kind, parameter, value in values:
        sim.call(f"set{kind}Param", parameter, value)


def _give_back(sim: Connection, root: int, before: Parameters) -> None:
    """Stop, set the parameters as before, remove the scene, and disconnect."""
    with suppress(OutsideError, InputError), _deferred_signals():
        sim.close()  # an interrupted or unanswered request blocks its socket
        # Ctrl-C ends a run soon, also without an answer: wait for 2 s at most.
        sim = Connection(sim.host, sim.port, patience=2.0)
        try:
            if not (roots := _roots(sim)).keys() - {root}:  # no later client took it over
                stop(sim)
                _undo(sim, roots, before)
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
