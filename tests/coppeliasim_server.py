"""A small server that speaks the protocol of CoppeliaSim's ZeroMQ remote API, for its real client.

Requests and replies are CBOR over REQ/REP. As the add-on of CoppeliaSim it lists functions and
constants, answers `_*wait*_` within a step and at times `_*repeat*_`, marks line breaks in errors,
counts the levels of stepping of each client, and forgets them when a simulation stops. Behind it
is a scene of dummies, joints and primitive shapes. At the start of a simulation, dynamic shapes
become a model of MuJoCo, in the way of CoppeliaSim's engine of that name: joint positions are the
references, and the drives apply the torques of the inverse dynamics for the velocity that the
controller commands, up to their limits.

As CoppeliaSim 4.10.0 it

- gives force and target velocity of a joint one sign: a new velocity turns the force, a signed
  force (the default) turns the velocity;
- accepts the number of an engine that is not installed (`newton`, `vortex`): nothing moves;
- returns the step of the engine as a whole part of the step of the simulation;
- returns named parameters as bytes, and keeps them, as all parameters, when a client is gone;
- begins the text of an error with the line of its Lua code.

Not modelled: contacts, other engines (they all are MuJoCo without rotors and friction), rendering,
scripts, buttons (a pause is a call), the time that CoppeliaSim itself takes, and `step` while a
simulation is stopped in its first step, which CoppeliaSim does not answer.

    python -m tests.coppeliasim_server --port 23000
"""

import argparse
import math
import sys
import threading
from dataclasses import dataclass, field
from typing import Any

import cbor
import mujoco
import numpy as np
import zmq
from scipy.spatial.transform import Rotation

STOPPED, PAUSED, RUNNING, STOPPING = 0, 8, 17, 22
CONSTANTS = {
    "simulation_stopped": STOPPED,
    "simulation_paused": PAUSED,
    "joint_revolute": 10,
    "jointmode_kinematic": 0,
    "jointmode_dynamic": 5,
    "jointdynctrl_free": 0,
    "jointdynctrl_velocity": 4,
    "jointdynctrl_position": 8,
    "jointintparam_dynctrlmode": 2035,
    "jointfloatparam_maxvel": 2036,
    "primitiveshape_cuboid": 3,
    "primitiveshape_spheroid": 4,
    "primitiveshape_cylinder": 5,
    "shapeintparam_static": 3003,
    "shapeintparam_respondable": 3004,
    "intparam_idle_fps": 8,
    "intparam_dynamic_engine": 9,
    "boolparam_realtime_simulation": 25,
    "floatparam_simulation_time_step": 1,
    "floatparam_physicstimestep": 12,
    "arrayparam_gravity": 2,
    "physics_bullet": 0,
    "physics_ode": 1,
    "physics_vortex": 2,
    "physics_newton": 3,
    "physics_mujoco": 4,
    "bullet_joint_pospid1": 5101,
    "ode_joint_pospid1": 5102,
    "vortex_joint_pospid1": 5103,
    "newton_joint_pospid1": 5104,
    "mujoco_joint_pospid1": 5105,
    "mujoco_joint_armature": 5106,
    "mujoco_joint_damping": 5107,
    "mujoco_joint_frictionloss": 5108,
}
NAMED = {number: name for name, number in CONSTANTS.items() if number > 100}
NAMED_ENGINES = {n: name for name, n in CONSTANTS.items() if name.startswith("physics_")}
PARAMETERS = {
    "Int32": {8: 8, 9: 0},
    "Bool": {25: True},
    "Float": {1: 0.05, 12: 0.005},
    "Array": {2: [0.0, 0.0, -9.81]},
}
"""Global parameters, with the values of a new scene."""
INSTALLED = ("physics_bullet", "physics_ode", "physics_mujoco")
"""Engines with a plug-in."""
GAIN_PERIOD = 0.005
"""Time that divides the gain of a position controller [s]."""


@dataclass
class Thing:
    """An object of the scene."""

    kind: str
    alias: str = ""
    parent: int = -1
    local: Any = field(default_factory=lambda: np.eye(4))
    q: float = 0.0
    dynamic: bool = False
    target: float = 0.0
    target_velocity: float = 0.0
    force: float = 2.5
    numbers: dict[str, float] = field(default_factory=dict)
    mass: float = 1.0
    inertia: Any = None
    com: Any = None
    dof: int = -1


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
        self.named: dict[str, bytes] = {}
        self.state, self.time, self.steps = STOPPED, 0.0, 0
        self.levels: dict[str, int] = {}
        self.client = ""
        self.count = 0
        self.model = None
        self.before: dict[int, Any] = {}

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
        assert len(sizes) == 2
        return self.new(kind="joint", dynamic=mode == CONSTANTS["jointmode_dynamic"])

    def sim_createPrimitiveShape(self, kind, sizes, options):
        assert kind in (3, 4, 5)
        assert all(size > 0.0 for size in sizes)
        static = {"shapeintparam_static": 0}
        return self.new(kind="shape", numbers=static)

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
        self.thing(handle, "joint").numbers |= {"cyclic": cyclic, "from": interval[0]}
        self.thing(handle).numbers["range"] = interval[1]

    def sim_setJointPosition(self, handle, q):
        thing = self.thing(handle, "joint")
        assert self.state == STOPPED or not thing.dynamic, "dynamic joint in a simulation"
        thing.q = q

    def sim_getJointPosition(self, handle):
        return self.thing(handle, "joint").q

    def sim_setJointTargetPosition(self, handle, q):
        self.thing(handle, "joint").target = q

    def sim_setJointTargetVelocity(self, handle, velocity):
        thing = self.thing(handle, "joint")
        thing.target_velocity = velocity
        if thing.force * velocity < 0.0:
            thing.force = -thing.force

    def sim_setJointTargetForce(self, handle, force, signed=True):
        thing = self.thing(handle, "joint")
        if not signed:
            force = math.copysign(max(force, 0.0), thing.target_velocity)
        thing.force = force
        if force * thing.target_velocity < 0.0:
            thing.target_velocity = -thing.target_velocity

    def sim_setObjectInt32Param(self, handle, parameter, value):
        assert type(value) is int
        self.thing(handle).numbers[NAMED[parameter]] = value

    def sim_setObjectFloatParam(self, handle, parameter, value):
        self.thing(handle).numbers[NAMED[parameter]] = value

    def sim_setEngineFloatParam(self, parameter, handle, value):
        self.thing(handle, "joint").numbers[NAMED[parameter]] = value

    def sim_setShapeMass(self, handle, mass):
        assert mass > 0.0
        self.thing(handle, "shape").mass = mass

    def sim_setShapeInertia(self, handle, inertia, com):
        thing = self.thing(handle, "shape")
        thing.inertia, thing.com = np.reshape(inertia, (3, 3)), np.reshape(com, (3, 4))

    def sim_getObjectVelocity(self, handle):
        """Return finite differences over the last step of the simulation."""
        self.thing(handle)
        dt, now = self.parameters["Float"][1], self.outer(handle)
        then = self.before.get(handle, now)
        turn = Rotation.from_matrix(now[:3, :3] @ then[:3, :3].T).as_rotvec()
        return (now[:3, 3] - then[:3, 3]) / dt, turn / dt

    def sim_getSimulationState(self):
        state = self.state
        if state == STOPPING:  # it stops within the next pass
            self.finish()
        return state

    def sim_getSimulationTime(self):
        return self.time

    def sim_setNamedStringParam(self, name, value):
        self.named[name] = value.encode()

    def sim_getNamedStringParam(self, name):
        return self.named.get(name)

    def sim_pauseSimulation(self):
        assert self.state == RUNNING
        self.state = PAUSED

    def sim_startSimulation(self):
        assert self.state == STOPPED
        self.kept = {handle: (thing.q, thing.local) for handle, thing in self.things.items()}
        self.state, self.time, self.before = RUNNING, 0.0, {}
        self.build()

    def sim_stopSimulation(self, wait=False):
        self.levels.clear()
        if self.state in (RUNNING, PAUSED):
            self.state = STOPPING

    def finish(self):
        """Restore the initial state."""
        self.state, self.model, self.time = STOPPED, None, 0.0
        for handle, (q, local) in self.kept.items():
            if handle in self.things:
                self.things[handle].q, self.things[handle].local = q, local

    def sim_setStepping(self, enable):
        before = self.levels.get(self.client, 0)
        self.levels[self.client] = max(before + (1 if enable else -1), 0)
        return before

    def access(self, kind):
        values = self.parameters[kind]

        def get(parameter):
            value = values[parameter]
            if (kind, parameter) == ("Float", CONSTANTS["floatparam_physicstimestep"]):
                whole = values[CONSTANTS["floatparam_simulation_time_step"]]
                return whole / max(1, int(whole / value + 0.5))
            return value

        def put(parameter, value):
            assert parameter in values
            values[parameter] = value

        return get, put

    # The engine

    def build(self):
        """Make a MuJoCo model of the dynamic shapes, each between joints."""
        shapes = {
            handle: thing
            for handle, thing in self.things.items()
            if thing.kind == "shape" and not thing.numbers.get("shapeintparam_static", 1)
        }
        engine = self.parameters["Int32"][CONSTANTS["intparam_dynamic_engine"]]
        if not shapes or NAMED_ENGINES[engine] not in INSTALLED:
            return
        spec, bodies = mujoco.MjSpec(), {}
        spec.compiler.degree = False
        spec.option.timestep = self.parameters["Float"][12]
        spec.option.gravity = self.parameters["Array"][2]
        rich = engine == CONSTANTS["physics_mujoco"]
        for handle, thing in shapes.items():  # parents have smaller handles
            hinge = self.things[thing.parent]
            above = hinge.parent
            if hinge.kind != "joint" or not hinge.dynamic:
                raise ValueError("a dynamic shape falls: it has no dynamic joint above it")
            outside, T = self.inner(above), self.outer(handle)
            own = np.linalg.inv(outside) @ T if above in bodies else T
            quat = np.roll(Rotation.from_matrix(own[:3, :3]).as_quat(), 1)
            body = bodies.get(above, spec.worldbody).add_body(
                name=f"b{handle}", pos=own[:3, 3], quat=quat
            )
            axis = np.linalg.inv(T) @ self.outer(thing.parent)
            numbers = hinge.numbers
            low = numbers["from"]
            joint = body.add_joint(
                name=f"j{thing.parent}",
                type=mujoco.mjtJoint.mjJNT_HINGE,
                pos=axis[:3, 3],
                axis=axis[:3, 2],
                ref=hinge.q,
                range=[low, low + numbers["range"]],
                limited=not numbers["cyclic"],
            )
            if rich:
                joint.armature = numbers.get("mujoco_joint_armature", 0.02)
                joint.damping[0] = numbers.get("mujoco_joint_damping", 0.0)
                joint.frictionloss = numbers.get("mujoco_joint_frictionloss", 0.0)
            body.explicitinertial = True
            body.mass, body.ipos = thing.mass, thing.com[:, 3]
            R = thing.com[:, :3]
            I = R @ thing.inertia @ R.T
            body.fullinertia = [I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]]
            bodies[handle] = body
        self.model = spec.compile()
        self.data, self.copy = mujoco.MjData(self.model), mujoco.MjData(self.model)
        self.driven = []
        for handle, thing in self.things.items():
            if thing.kind == "joint" and thing.dynamic:
                thing.dof = int(self.model.joint(f"j{handle}").dofadr[0])
                self.data.qpos[thing.dof] = thing.q
                self.driven.append(thing)

    def drive(self):
        """Set the torques of the drives for the velocities that their controllers command."""
        data, copy, dt = self.data, self.copy, self.model.opt.timestep
        copy.qpos[:], copy.qvel[:], copy.qacc[:] = data.qpos, data.qvel, 0.0
        for thing in self.driven:
            mode, n = thing.numbers.get("jointintparam_dynctrlmode"), thing.dof
            velocity = thing.target_velocity
            if mode == CONSTANTS["jointdynctrl_position"]:
                P = next(v for name, v in thing.numbers.items() if name.endswith("_pospid1"))
                velocity = P * (thing.target - data.qpos[n]) / GAIN_PERIOD
            fastest = thing.numbers["jointfloatparam_maxvel"]
            velocity = min(max(velocity, -fastest), fastest)
            copy.qacc[n] = (velocity - data.qvel[n]) / dt
        mujoco.mj_inverse(self.model, copy)
        for thing in self.driven:
            torque = copy.qfrc_inverse[thing.dof]
            most = abs(thing.force)
            data.qfrc_applied[thing.dof] = min(max(torque, -most), most)

    def advance(self):
        """Advance by one step of the simulation."""
        dt = self.parameters["Float"][1]
        self.before = {handle: self.outer(handle) for handle in self.watched()}
        if self.model is not None:
            for _ in range(max(1, round(dt / self.model.opt.timestep))):
                self.drive()
                mujoco.mj_step(self.model, self.data)
            for thing in self.driven:
                thing.q = float(self.data.qpos[thing.dof])
        self.time += dt
        self.steps += 1

    def watched(self):
        """Return the handles of the objects whose velocities are known."""
        watched = ("flange", "pendulum")
        return [handle for handle, thing in self.things.items() if thing.alias in watched]


class CoppeliaSimServer:
    """The server, on a thread of its own; a context manager."""

    def __init__(self, port=0, busy_every=97):
        """Bind a port; 0 takes any. Each `busy_every`th request has to be repeated."""
        self.scene, self.busy_every, self.requests, self.errors = Scene(), busy_every, 0, []
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.REP)
        self._socket.setsockopt(zmq.LINGER, 0)
        if port:
            self._socket.bind(f"tcp://127.0.0.1:{port}")
        else:
            port = self._socket.bind_to_random_port("tcp://127.0.0.1")
        self.port, self._open, self._stepping, self._repeated = port, True, set(), False
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
        self._repeated = self.requests % self.busy_every == 0 and not self._repeated
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
        check_plain(arguments)
        short = name.removeprefix("sim.")
        if short.endswith("Param") and short[3:-5] in PARAMETERS:
            function = self.scene.access(short[3:-5])[short.startswith("set")]
        else:
            function = getattr(self.scene, f"sim_{short}", None)
        if function is None:
            raise ValueError(f"No such function: {name}")
        result = function(*arguments)
        if result is None:
            return []
        several = isinstance(result, tuple)
        return [as_list(value) for value in (result if several else (result,))]


def as_list(value):
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def check_plain(value):
    """Reject what CoppeliaSim's Lua would not take."""
    if isinstance(value, list):
        for entry in value:
            check_plain(entry)
    elif isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"a number is {value}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--port", type=int, default=23000)
    with CoppeliaSimServer(parser.parse_args().port) as server:
        sys.stdout.write(f"{server.address}\n")
        sys.stdout.flush()
        server._thread.join()


if __name__ == "__main__":
    main()
