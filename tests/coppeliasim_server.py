"""A small server that speaks the protocol of CoppeliaSim's ZeroMQ remote API, for its real client.

Requests and replies are CBOR over REQ/REP. As the add-on of CoppeliaSim it lists functions and
constants, answers `_*wait*_` within a step and at times `_*repeat*_`, marks line breaks in errors,
counts the levels of stepping of each client, and forgets them when a simulation stops. Behind it
is a scene of dummies, kinematic joints and primitive shapes, which nothing moves but its calls. As
in CoppeliaSim 4.10.0 all parameters are kept when a client is gone, and the text of an error begins
with the line of its Lua code.

Not modelled: physics, contacts, rendering, scripts, buttons (a pause is a call), the time that
CoppeliaSim itself takes, and `step` while a simulation is stopped in its first step, which
CoppeliaSim does not answer.
"""

import threading
from dataclasses import dataclass, field
from typing import Any

import cbor
import numpy as np
import zmq
from scipy.spatial.transform import Rotation

STOPPED, PAUSED, RUNNING, STOPPING = 0, 8, 17, 22
CONSTANTS = {
    "simulation_stopped": STOPPED,
    "simulation_paused": PAUSED,
    "joint_revolute": 10,
    "jointmode_kinematic": 0,
    "primitiveshape_cuboid": 3,
    "primitiveshape_spheroid": 4,
    "primitiveshape_cylinder": 5,
    "shapeintparam_static": 3003,
    "shapeintparam_respondable": 3004,
    "intparam_idle_fps": 8,
    "boolparam_realtime_simulation": 25,
    "floatparam_simulation_time_step": 1,
}
PARAMETERS = {"Int32": {8: 8}, "Bool": {25: True}, "Float": {1: 0.05}}
"""Global parameters, with the values of a new scene."""


@dataclass
class Thing:
    """An object of the scene."""

    kind: str
    alias: str = ""
    parent: int = -1
    local: Any = field(default_factory=lambda: np.eye(4))
    q: float = 0.0


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
        self.levels: dict[str, int] = {}
        self.client = ""
        self.count = 0

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

    def new(self, **values):
        self.count += 1
        self.things[self.count] = Thing(**values)
        return self.count

    def thing(self, handle, kind=None):
        if type(handle) is not int or handle not in self.things:
            raise ValueError("object does not exist.")
        thing = self.things[handle]
        if kind and thing.kind != kind:
            raise ValueError(f"object is not a {kind}.")
        return thing

    # Functions of `sim`

    def sim_createDummy(self, size):
        return self.new(kind="dummy")

    def sim_createJoint(self, kind, mode, options, sizes):
        assert kind == CONSTANTS["joint_revolute"]
        assert mode == CONSTANTS["jointmode_kinematic"]
        assert len(sizes) == 2
        return self.new(kind="joint")

    def sim_createPrimitiveShape(self, kind, sizes, options):
        assert kind in (3, 4, 5)
        assert all(size > 0.0 for size in sizes)
        return self.new(kind="shape")

    def sim_setObjectAlias(self, handle, alias):
        self.thing(handle).alias = alias

    def sim_getObject(self, path, options):
        for handle, thing in self.things.items():
            if thing.parent < 0 and f"/{thing.alias}" == path:
                return handle
        if options.get("noError"):
            return -1
        raise ValueError(f"object does not exist. (path '{path}')")

    def sim_getObjectsInTree(self, base):
        self.thing(base)
        found = [base]
        for handle in found:
            found += [other for other, thing in self.things.items() if thing.parent == handle]
        return found

    def sim_removeObjects(self, handles):
        for handle in handles:
            self.thing(handle)
            del self.things[handle]

    def sim_setObjectPose(self, handle, pose, relative=-1):
        assert relative == -1
        assert len(pose) == 7
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
        self.thing(handle, "joint")

    def sim_setJointPosition(self, handle, q):
        self.thing(handle, "joint").q = q

    def sim_getJointPosition(self, handle):
        return self.thing(handle, "joint").q

    def sim_setObjectInt32Param(self, handle, parameter, value):
        assert type(value) is int
        self.thing(handle, "shape")

    def sim_getSimulationState(self):
        state = self.state
        if state == STOPPING:  # it stops within the next pass
            self.finish()
        return state

    def sim_getSimulationTime(self):
        return self.time

    def sim_pauseSimulation(self):
        assert self.state == RUNNING
        self.state = PAUSED

    def sim_startSimulation(self):
        assert self.state == STOPPED
        self.kept = {handle: (thing.q, thing.local) for handle, thing in self.things.items()}
        self.state, self.time = RUNNING, 0.0

    def sim_stopSimulation(self, wait=False):
        self.levels.clear()
        if self.state in (RUNNING, PAUSED):
            self.state = STOPPING

    def finish(self):
        """Restore the initial state."""
        self.state, self.time = STOPPED, 0.0
        for handle, (q, local) in self.kept.items():
            if handle in self.things:
                self.things[handle].q, self.things[handle].local = q, local

    def sim_setStepping(self, enable):
        before = self.levels.get(self.client, 0)
        self.levels[self.client] = max(before + (1 if enable else -1), 0)
        return before

    def advance(self):
        """Advance by one step of the simulation."""
        self.time += self.parameters["Float"][1]
        self.steps += 1


class CoppeliaSimServer:
    """The server, on a thread of its own; a context manager."""

    def __init__(self):
        """Bind any port."""
        self.scene, self.requests, self.errors = Scene(), 0, []
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.REP)
        self._socket.setsockopt(zmq.LINGER, 0)
        self.port = self._socket.bind_to_random_port("tcp://127.0.0.1")
        self._open, self._stepping, self._repeated = True, set(), False
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
        """Return the reply to a request."""
        self.requests += 1
        name, scene = request["func"], self.scene
        client = scene.client = request["uuid"]
        if name == "_*executed*_":
            if client in self._stepping:
                self._stepping.discard(client)
                if scene.state == RUNNING:
                    scene.advance()
            return {"ret": []}
        self._repeated = self.requests % 97 == 0 and not self._repeated
        if self._repeated:
            return {"func": "_*repeat*_", "args": []}
        if scene.state == RUNNING and not any(scene.levels.values()):
            for _ in range(3):  # no client holds the simulation
                scene.advance()
        if name == "sim.step":
            self._stepping.add(client)
            return {"func": "_*wait*_", "args": []}
        try:
            return {"ret": self.call(name, request["args"])}
        except Exception as error:
            self.errors.append(f"{name}: {error!r}")
            return {"err": f"354: in {name}: {error}_=NL=_stack traceback:_=NL=__=TB=_[C]"}

    def call(self, name, arguments):
        if name == "zmqRemoteApi.require":
            return []
        if name == "zmqRemoteApi.info":
            functions = {method[4:] for method in dir(Scene) if method.startswith("sim_")}
            functions |= {f"{way}{kind}Param" for way in ("get", "set") for kind in PARAMETERS}
            functions.add("step")
            return [
                {function: {"func": {}} for function in functions}
                | {constant: {"const": number} for constant, number in CONSTANTS.items()}
            ]
        short = name.removeprefix("sim.")
        values = self.scene.parameters.get(short[3:-5], {})
        if values and short.endswith("Param"):
            function = values.__setitem__ if short[:3] == "set" else values.__getitem__
        else:
            function = getattr(self.scene, f"sim_{short}")
        result = function(*arguments)
        return [] if result is None else [result]
