"""A small server that speaks the protocol of CoppeliaSim's ZeroMQ remote API, for its real client.

Requests and replies are CBOR over REQ/REP. As the add-on of CoppeliaSim it lists functions and
constants, answers `_*wait*_` until a step is done and at times `_*repeat*_`, marks line breaks in
errors, counts the levels of stepping of each client, stops while one of them holds it, and forgets
a client that has been silent for the time that its first request names. Behind it is a scene of
dummies, kinematic joints and primitive shapes, which nothing moves but its calls. As in CoppeliaSim
4.10.0 a joint is clamped into its interval, aliases need not be unique, an object is created
without a parent, all parameters are kept when a client is gone, and the text of an error begins
with the line of its Lua code. The scene of the user has an object with our alias.

Not modelled: physics, contacts, rendering, scripts, buttons (a pause is a call), the time that
CoppeliaSim itself takes, and `step` while a simulation is stopped in its first step, which
CoppeliaSim does not answer.
"""

import threading
import time
from dataclasses import dataclass, field
from typing import Any

import cbor
import numpy as np
import zmq
from scipy.spatial.transform import Rotation

STOPPED, PAUSED, RUNNING, STOPPING = 0, 8, 17, 22
CONSTANTS = {
    "simulation_stopped": STOPPED, "simulation_paused": PAUSED,
    "joint_revolute": 10, "jointmode_kinematic": 0,
    "primitiveshape_cuboid": 3, "primitiveshape_spheroid": 4, "primitiveshape_cylinder": 5,
    "shapeintparam_static": 3003, "shapeintparam_respondable": 3004, "intparam_idle_fps": 8,
    "boolparam_realtime_simulation": 25, "floatparam_simulation_time_step": 1,
    "handle_all": -2, "handle_scene": -12,
}  # fmt: skip
SHAPES = {3: "Cuboid", 4: "Sphere", 5: "Cylinder"}
PARAMETERS = {"Int32": {8: 8}, "Bool": {25: True}, "Float": {1: 0.05}}
"""Global parameters, with the values of a new scene."""


@dataclass
class Thing:
    kind: str
    alias: str
    parent: int = -1
    local: Any = field(default_factory=lambda: np.eye(4))
    q: float = 0.0
    interval: Any = None
    data: dict[str, str] = field(default_factory=dict)


@dataclass
class Client:
    timeout: float
    seen: float
    level: int = 0
    desired: int = 0
    steps_at: int | None = None


def turned(thing):
    """Return the turn of a joint, and none of another object, shape (4, 4)."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.0, 0.0, thing.q]).as_matrix()
    return T


class Scene:
    """Objects, the simulation, and the functions of `sim`, each a method `sim_NAME`."""

    def __init__(self):
        self.things: dict[int, Thing] = {}
        self.parameters = {kind: dict(values) for kind, values in PARAMETERS.items()}
        self.state, self.time, self.steps = STOPPED, 0.0, 0
        self.clients: dict[str, Client] = {}
        self.client = Client(0.0, 0.0)
        self.count = 0
        base = self.new("dummy", "equipoise")
        self.sim_setObjectParent(self.new("dummy", "child"), base)
        self.users = dict(self.things)

    # Places

    def inner(self, handle):
        """Return the frame in which the children of an object are placed, shape (4, 4).

        The children of a joint turn with it.
        """
        T = np.eye(4)
        while handle >= 0:
            thing = self.things[handle]
            T, handle = thing.local @ turned(thing) @ T, thing.parent
        return T

    def outer(self, handle):
        """Return the pose of an object in the world, shape (4, 4)."""
        return self.inner(self.things[handle].parent) @ self.things[handle].local

    def new(self, kind, alias):
        self.count += 1
        self.things[self.count] = Thing(kind, alias)
        return self.count

    def thing(self, handle, kind=None):
        if type(handle) is not int or handle not in self.things:
            raise ValueError("object does not exist.")
        thing = self.things[handle]
        if kind and thing.kind != kind:
            raise ValueError(f"object is not a {kind}.")
        return thing

    @property
    def ours(self):
        """Handles of the objects that are none of the user's, the newest one last."""
        return [handle for handle in self.things if handle not in self.users]

    def added(self, alias):
        """Return the object of an alias that is none of the user's."""
        (found,) = (self.things[one] for one in self.ours if self.things[one].alias == alias)
        return found

    @property
    def as_left(self):
        """Whether objects, parameters and simulation are as the user left them."""
        return (self.things, self.parameters, self.state) == (self.users, PARAMETERS, STOPPED)

    # Functions of `sim`

    def sim_createDummy(self, size):
        return self.new("dummy", "Dummy")

    def sim_createJoint(self, kind, mode, options, sizes):
        return self.new("joint", "Joint")

    def sim_createPrimitiveShape(self, kind, sizes, options):
        return self.new("shape", SHAPES[kind])

    def sim_setObjectAlias(self, handle, alias):
        self.thing(handle).alias = alias

    def sim_getObjectsInTree(self, base, kind=-2, options=0):
        if base == CONSTANTS["handle_scene"]:
            return [handle for handle, thing in self.things.items() if thing.parent < 0]
        self.thing(base)
        found = [base]
        for handle in found:
            found += [other for other, thing in self.things.items() if thing.parent == handle]
        return found

    def sim_removeObjects(self, handles):
        for handle in handles:
            self.thing(handle)
            del self.things[handle]

    def sim_writeCustomStringData(self, handle, tag, data):
        self.thing(handle).data[tag] = data

    def sim_readCustomStringData(self, handle, tag):
        return self.thing(handle).data.get(tag)

    def sim_setObjectPose(self, handle, pose, relative=-1):
        T = np.eye(4)
        T[:3, 3], T[:3, :3] = pose[:3], Rotation.from_quat(pose[3:]).as_matrix()
        thing = self.thing(handle)
        thing.local = np.linalg.inv(self.inner(thing.parent)) @ T

    def sim_getObjectPose(self, handle):
        self.thing(handle)
        T = self.outer(handle)
        return [*T[:3, 3].tolist(), *Rotation.from_matrix(T[:3, :3]).as_quat().tolist()]

    def sim_setObjectParent(self, handle, parent, in_place=True):
        thing, T = self.thing(handle), self.outer(handle)
        self.thing(parent)
        thing.parent = parent
        if in_place:
            thing.local = np.linalg.inv(self.inner(parent)) @ T

    def sim_setJointInterval(self, handle, cyclic, interval):
        joint = self.thing(handle, "joint")
        joint.interval = None if cyclic else interval
        self.sim_setJointPosition(handle, joint.q)

    def sim_setJointPosition(self, handle, q):
        """Set a position, clamped into the interval; a cyclic joint is wrapped."""
        joint = self.thing(handle, "joint")
        if joint.interval is None:
            joint.q = q if abs(q) <= np.pi else (q + np.pi) % (2.0 * np.pi) - np.pi
        else:
            lower, span = joint.interval
            joint.q = min(max(q, lower), lower + span)

    def sim_getJointPosition(self, handle):
        return self.thing(handle, "joint").q

    def sim_setObjectInt32Param(self, handle, parameter, value):
        self.thing(handle, "shape")

    def sim_getSimulationState(self):
        state = self.state
        if state == STOPPING:  # it stops within the next pass
            self.finish()
        return state

    def sim_getSimulationTime(self):
        return self.time

    def sim_pauseSimulation(self):
        self.state = PAUSED

    def sim_startSimulation(self):
        self.kept = {handle: (thing.q, thing.local) for handle, thing in self.things.items()}
        self.state, self.time = RUNNING, 0.0

    def sim_stopSimulation(self, wait=False):
        for client in self.clients.values():
            client.level, client.desired = 0, self.steps + 10
        if self.state in (RUNNING, PAUSED):
            self.state = STOPPING

    def finish(self):
        """Restore the initial state."""
        self.state, self.time = STOPPED, 0.0
        for handle, (q, local) in self.kept.items():
            if handle in self.things:
                self.things[handle].q, self.things[handle].local = q, local

    def sim_setStepping(self, enable):
        client, before = self.client, self.client.level
        if enable and not before:
            client.desired = self.steps
        client.level = max(before + (1 if enable else -1), 0)
        return before

    def advance(self):
        """Advance as far as the clients that hold the simulation allow."""
        for _ in range(3):
            held = any(one.level and one.desired <= self.steps for one in self.clients.values())
            if self.state == RUNNING and not held:
                self.time += self.parameters["Float"][1]
                self.steps += 1


class CoppeliaSimServer:
    """The server, on a thread of its own; a context manager."""

    def __init__(self):
        """Bind any port."""
        self.scene, self.requests, self.later = Scene(), 0, 0.0
        self.watch = lambda requests: None
        """Called with the number of each request before its answer."""
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.REP)
        self._socket.setsockopt(zmq.LINGER, 0)
        self.port = self._socket.bind_to_random_port("tcp://127.0.0.1")
        self._open, self._repeated = True, False
        self._thread = threading.Thread(target=self.serve, daemon=True)

    @property
    def address(self):
        return f"coppeliasim://127.0.0.1:{self.port}"

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._open = False
        self._thread.join()
        self._socket.close()
        self._context.term()

    def serve(self):
        while self._open:
            if self._socket.poll(20):
                request = cbor.loads(self._socket.recv())
                self._socket.send(cbor.dumps(self.answer(request)))

    def answer(self, request):
        self.requests += 1
        self.watch(self.requests)
        name, scene, now = request["func"], self.scene, time.monotonic() + self.later
        for uuid, client in list(scene.clients.items()):
            if now - client.seen > client.timeout:
                del scene.clients[uuid]
        new = Client(request.get("timeout", 600.0), now, desired=scene.steps)
        client = scene.client = scene.clients.setdefault(request["uuid"], new)
        client.seen = now
        if name == "_*executed*_":
            scene.advance()
            if client.steps_at == scene.steps:
                return {"func": "_*wait*_", "args": []}
            return {"ret": []}
        self._repeated = self.requests % 97 == 0 and not self._repeated
        if self._repeated:
            return {"func": "_*repeat*_", "args": []}
        scene.advance()
        if name == "sim.step":
            runs = scene.state == RUNNING
            client.steps_at = scene.steps if runs else None
            if runs and client.level:
                client.desired = scene.steps + 1
            return {"func": "_*wait*_", "args": []}
        try:
            return {"ret": self.call(name, request["args"])}
        except Exception as error:
            return {"err": f"354: in {name}: {error}_=NL=_stack traceback:_=NL=__=TB=_[C]"}

    def call(self, name, arguments):
        if name == "zmqRemoteApi.require":
            return []
        if name == "zmqRemoteApi.info":
            functions = {method[4:] for method in dir(Scene) if method.startswith("sim_")}
            functions |= {f"{way}{kind}Param" for way in ("get", "set") for kind in PARAMETERS}
            functions.add("step")
            constants = {name: {"const": number} for name, number in CONSTANTS.items()}
            return [{function: {"func": {}} for function in functions} | constants]
        short = name.removeprefix("sim.")
        values = self.scene.parameters.get(short[3:-5], {})
        if values and short.endswith("Param"):
            function = values.__setitem__ if short[:3] == "set" else values.__getitem__
        else:
            function = getattr(self.scene, f"sim_{short}")
        result = function(*arguments)
        return [] if result is None else [result]
