"""A controller of other authors that checks commands, `franka-sim`, with a pendulum, in lockstep.

`franka-sim` needs NumPy 1 and MuJoCo 3, so this module is imported only in the process of the rig,
which finds those first. Server and checks are those of `franka-sim`, with all that it can enforce;
the joint servo also holds the integral of the velocities, as in `franky`. The arm is the model of
`franky-sim`, since its own is a download from GitHub.
"""

import threading
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from xml.etree import ElementTree

import franky_sim
import mujoco
import numpy as np
from franka_sim import mujoco_franka_sim
from franka_sim.control_modes import ControlMode
from franka_sim.franka_sim_server import FrankaSimServer
from franka_sim.server import state_stream

from equipoise.rig.simulated_rig import Bench
from equipoise.simulation.twin.physics import rod_inertia
from equipoise_franka import franky

ASSETS = Path(franky_sim.__file__).parent / "assets"
franky.LINK = "fr3_link7"
mujoco_franka_sim.ARM_VELOCITY_KV = np.array(franky.DAMPING)
# Cycles follow virtual time, not the milliseconds of this machine.
state_stream.time = SimpleNamespace(
    time=time.time, perf_counter=time.perf_counter, sleep=lambda _: None
)


class Mechanics(mujoco_franka_sim.MujocoFrankaSim):
    """The simulated arm: it moves when the server's loop asks for a state, once per cycle."""

    phi, _drag = 7, 0.0

    def __init__(self, arm, pendulum, settings, q):
        mujoco_franka_sim.ARM_INITIAL_Q = np.array(arm.with_held(q))
        with TemporaryDirectory() as folder:
            scene = Path(folder, "fr3.xml")
            _scene(arm, pendulum, settings).write(scene)
            super().__init__(model_path=scene)
            self.initialize_simulation()
        inertia = rod_inertia(pendulum.w2, settings.pendulum_mass)
        self.model.dof_damping[self.phi] = pendulum.c * inertia
        self.model.dof_frictionloss[self.phi] = pendulum.coulomb * inertia
        self._drag = pendulum.drag * inertia
        self.model.body_gravcomp[-2:] = 0.0  # the last bodies are bracket and pendulum
        self.data.qpos[self.phi], self.data.qvel[:] = np.pi, 0.0
        mujoco.mj_forward(self.model, self.data)
        self._due, self._sent = threading.Semaphore(0), threading.Semaphore(0)
        self._cycles = self._moves = False

    def get_robot_state(self):
        """Return the state; in the server's loop, wait for the next cycle before."""
        if threading.current_thread() is self.server.thread:
            if self._cycles:
                self._sent.release()
            self._cycles = False
            while not self._due.acquire(timeout=0.1):
                if not self.server.connection_running:
                    return super().get_robot_state()
            self._cycles = True
            self.server._drain_gate()  # the commands that have arrived
            if self._moves:
                self.step()
        return super().get_robot_state()

    def cycle(self, moves=True):
        """Run a cycle: process the commands, move the arm, and send the state."""
        if self.server.transmitting_state:
            self._moves = moves
            self._due.release()
            while not self._sent.acquire(timeout=0.1) and self.server.transmitting_state:
                pass
        elif moves:
            self.step()

    def arm_control_torque(self):
        torque = super().arm_control_torque()
        if self.control_mode == ControlMode.VELOCITY:
            desired = np.array(self.server.robot_state.state["q_d"])
            torque += mujoco_franka_sim.ARM_POSITION_KP * (desired - self.data.qpos[: self.phi])
        return torque

    def _apply_control(self):
        super()._apply_control()
        rate = self.data.qvel[self.phi]
        self.data.qfrc_applied[self.phi] = -self._drag * abs(rate) * rate


class Server(FrankaSimServer):
    """The controller, with all checks enforced."""

    _DRAIN_GATE_TIMEOUT = 10.0
    _mode = 0

    def __init__(self, mechanics, hosts):
        checks = {"enforce_comm_constraints": True, "enforce_motion_limits": True}
        super().__init__(physics_sim=mechanics, enable_gripper=False, **checks)
        mechanics.server = self
        for self.host in hosts:
            try:
                self._bind_listener()
                break
            except OSError:
                continue
        self.hostname = self.host
        self.thread = threading.Thread(target=self.run_server, daemon=True)
        self.thread.start()

    def reply(self):
        """Reply to a client that waits for its first state, or for the begin of a motion."""
        mode = self.robot_state.state["motion_generator_mode"]
        if self.transmitting_state and (self.states_sent == 0 or mode != self._mode):
            self._mode = mode
            self.physics_sim.cycle(moves=False)


class FrankaSimRig(Bench):
    """The rig, with what `Lockstep` uses of one."""

    def __init__(self, bodies, hosts=franky.OTHER_HOSTS):
        arm, pendulum, settings, q, _, _ = bodies
        self.robot = Mechanics(arm, pendulum, settings, q)
        self.controller = Server(self.robot, hosts)
        model, data = self.robot.model, self.robot.data
        flange, rod = (model.body(name).id for name in (franky.LINK, "pendulum"))
        step, phi = self.robot.cycle, self.robot.phi
        super().__init__(bodies, data, step, flange=flange, rod=rod, phi=phi)

    @property
    def q(self):
        return np.array(self.robot.data.qpos[: self.robot.phi])


def _scene(arm, pendulum, settings):
    """Return the arm without a hand, with bracket and pendulum."""
    tree = ElementTree.parse(ASSETS / "fr3.xml")
    root = tree.getroot()
    root.find("compiler").set("meshdir", str(ASSETS / "meshes"))
    for name in ("actuator", "tendon", "equality", "keyframe"):
        root.remove(root.find(name))
    link = next(body for body in root.iter("body") if body.get("name") == franky.LINK)
    link.remove(link.find("body"))
    franky._add_pendulum(root, arm, pendulum, settings)
    return tree
