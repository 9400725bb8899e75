"""The playground without its page: a twin in real time, its policies, and a training beside it.

The twin, the controller and the trials are those of an evaluation.
"""

import threading
from collections import deque
from math import degrees, exp, sqrt
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.apps.console.scenes import PolicyChoice, Scene
from equipoise.artefacts import Estimate
from equipoise.control.bound_policy import load_policy
from equipoise.control.control_step import horizon
from equipoise.control.grid import TRUNCATED, box_indices, make_grid
from equipoise.control.policy import LearningPoint, TabularPolicy, TaskPolicy, shipped_policy
from equipoise.errors import EquipoiseError
from equipoise.learning.train import TrainingObserver, train
from equipoise.model.elementary import BATCH_SIZE
from equipoise.model.random import DEPLOYMENT
from equipoise.model.worlds import World, read_world
from equipoise.outcomes import TRIAL_OUTCOMES
from equipoise.paper import PHI_LIMIT_DEG, U_MAX, X_LIMIT
from equipoise.settings import BoxSettings, resolve
from equipoise.worlds import predicted, setup_of
from equipoise.worlds.twin.world import TwinSimulation

Floats = npt.NDArray[np.float64]

BASE: Final = read_world("twin:nominal")
"""World that a scene changes."""
BRAKE: Final = 5.0
"""Deceleration of the flange after a fall, over its velocity [1/s]."""
FALL: Final = 2.0
"""Time that a fall is shown [s]."""
RECENT: Final = 5.0
"""Time over which the text describes the motion [s]."""
FADE: Final = 2.0
"""Time constant with which a used box fades [s]."""


class Frame(NamedTuple):
    """State to show."""

    q: Floats
    """True joints [rad], shape (joints,)."""
    commanded: Floats
    """Commanded joints [rad], shape (joints,)."""
    x: float
    """Displacement of the flange [m]."""
    phi: float
    """Angle from upright [rad]."""
    u: float
    """Commanded acceleration [m/s^2]."""
    bias: float
    """Estimate of the encoder's zero error [rad]."""
    box: int
    """Box of the table that holds the policy's input; -1 without a table or outside."""
    fallen: str
    """Cause of the fall; empty while it stands."""


class Training(TrainingObserver):
    """Training of a table in a thread."""

    def __init__(self, recipe: str, seed: int) -> None:
        """Begin a training for the shipped pendulum with a recipe and a master seed."""
        self.points: list[LearningPoint] = []
        self.policy: TabularPolicy | None = None
        self.error = ""
        self.settings = resolve(recipe)
        self._thread = threading.Thread(target=self._run, args=(seed,), daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether the training goes on."""
        return self._thread.is_alive()

    def report(self, learner: int, point: LearningPoint) -> None:
        """Add a point of the learning curve."""
        self.points.append(point)

    def _run(self, seed: int) -> None:
        shipped = shipped_policy()
        try:
            self.policy = train(
                shipped.pendulum, shipped.arm, self.settings, seed=seed, observer=self
            )
        except EquipoiseError as error:
            self.error = str(error)

    def sentence(self) -> str:
        """Return how far the training is, or its result."""
        total, done = self.settings.learning.episodes, 0
        if self.points:
            done = self.points[-1].episodes
        if self.running:
            phase = "now the best of its tables is selected" if done >= total else "learning"
            return f"{done:,} of {total:,} episodes: {phase}."
        if self.policy is None:
            return f"The training failed: {self.error}"
        return f"Trained in {self.policy.episodes:,} episodes."


class Playground:
    """A twin that balances tick by tick, under a scene that may change at any time."""

    def __init__(self, scene: Scene, yours: TaskPolicy | None = None) -> None:
        """Set a scene up.

        Args:
            scene: The scene.
            yours: The policy of `yours`.
        """
        self.policies: dict[PolicyChoice, TaskPolicy] = {
            "robust": shipped_policy(),
            "lqr": load_policy("lqr"),
        }
        """Policies that are ready, by name."""
        if yours is not None:
            self.policies["yours"] = yours
        self._number = 0
        self.set(scene)

    def set(self, scene: Scene) -> None:
        """Set another scene up, and begin again.

        Raises:
            KeyError: The policy of the scene is not ready.
        """
        policy = self.policies[scene.policy]
        rig = {"transport": scene.delay, "coulomb": scene.friction, "zero_offset": scene.zero}
        exact = {"zero_error": 0.0, "inertia_sigma": 0.0, "friction_sigma": 0.0}
        world = BASE.settings.model_copy(update=rig | exact)
        known = shipped_policy().actuator  # identified on the nominal twin, then moved along
        moved = max(known.delay.value + scene.delay - BASE.settings.transport, 0.0)
        actuator = known.model_copy(update={"delay": Estimate.around(moved, 0.0, "given")})
        controller = policy.settings.controller.model_copy(update={"predict": scene.predict})
        settings = policy.settings.model_copy(update={"controller": controller})
        twin = World("playground", world)
        setup = setup_of(policy, twin, settings, actuator)
        self.scene, self.policy, self.arm = scene, policy, policy.arm
        self.w2, self.h = policy.pendulum.parameters().w2, policy.h
        self.latency = horizon(policy.arm, actuator, controller.margin)
        """Time from a measurement to the effect of the command that answers it [s]."""
        self._simulation = TwinSimulation(twin, setup, seed=0, stream=DEPLOYMENT)
        self._loop = self._simulation.loop()
        self._boxes = make_grid(BoxSettings(), policy.pendulum.parameters().k)
        self.u_of_box = None
        if isinstance(policy, TabularPolicy) and policy.settings.boxes == BoxSettings():
            self.u_of_box = policy.u_of_box.reshape(-1)
        """Command of each box [m/s^2], shape (270,); None without a table of the usual boxes."""
        self.used = np.zeros(BoxSettings().count)
        """Recent use of each box, 0 to 1, shape (270,)."""
        self.begin()

    def begin(self) -> None:
        """Release the pendulum again."""
        trial = self._simulation.draw(1, self._number).trial(0)
        self._number += 1
        self._loop.reset(trial._replace(start=(0.0, 0.0, self.scene.lean, 0.0)))
        self.policy.reset()
        self._tick, self._fell, self._cause = 0, 0, ""
        self._recent: deque[tuple[float, float]] = deque(maxlen=round(RECENT / self.h))
        self.pushed = 0.0
        """Last push [rad/s]."""

    def push(self, rate: float) -> None:
        """Push the pendulum, which changes its rate [rad/s]."""
        self._loop.push(rate)
        self.pushed = rate

    def advance(self) -> Frame:
        """Advance by one tick; a fall is shown for `FALL`, then the pendulum is released again."""
        if self._cause and (self._tick - self._fell) * self.h > FALL:
            self.begin()
        loop, seen = self._loop, predicted(self._loop)
        if self._cause:
            u = float(np.clip(-BRAKE * loop.state()[1], -U_MAX, U_MAX))
        else:
            u = float(self.policy.act(seen))
        cause = loop.step(u)
        self._tick += 1
        if cause != TRUNCATED and not self._cause:
            self._cause, self._fell = TRIAL_OUTCOMES[cause], self._tick
        x, _, phi, _ = loop.state().tolist()
        box = -1
        self.used *= exp(-self.h / FADE)
        if not self._cause:
            self._recent.append((x, phi))
            inside = abs(degrees(seen[2])) < PHI_LIMIT_DEG and abs(seen[0]) < X_LIMIT
            if self.u_of_box is not None and inside:
                box = int(box_indices(seen[None, :], self._boxes)[0])
                self.used[box] = 1.0
        commanded = self.arm.with_held(loop.controller.q[::BATCH_SIZE])
        bias = float(loop.controller.estimate[2 * BATCH_SIZE])
        return Frame(loop.joints(), commanded, x, phi, u, bias, box, self._cause)

    @property
    def stood(self) -> float:
        """Time since the release, up to a fall [s]."""
        return (self._fell if self._cause else self._tick) * self.h

    def sentences(self, frame: Frame) -> list[str]:
        """Return what one sees now, and why."""
        scene, found = self.scene, list[str]()
        if frame.fallen:
            found.append(f"It fell after {self.stood:.1f} s ({frame.fallen}).")
        elif len(self._recent) > 1:
            x, phi = np.abs(np.array(self._recent)).max(axis=0)
            found.append(
                f"It has stood for {self.stood:.0f} s, in the last {RECENT:g} s within "
                f"±{degrees(phi):.1f}° and ±{1e3 * x:.0f} mm."
            )
        growth = 100.0 * (exp(sqrt(self.w2) * self.latency) - 1.0)
        meanwhile = "The controller predicts the state at that time, and the policy acts on that."
        if not scene.predict:
            meanwhile = (
                f"Meanwhile a lean grows by {growth:.0f} %: the policy acts on an angle that is "
                "out of date."
            )
        found.append(
            f"A command takes {1e3 * self.latency:.0f} ms to act, {1e3 * scene.delay:.0f} ms of "
            f"them in transport. {meanwhile}"
        )
        if scene.zero:
            found.append(
                f"The encoder's zero is {degrees(scene.zero):+.1f}° off; the controller's estimate "
                f"is {degrees(frame.bias):+.1f}°."
            )
        rest = degrees(scene.friction / self.w2)
        if rest > 0.1:
            found.append(f"Dry friction can hold the pendulum {rest:.1f}° beside upright.")
        return found
