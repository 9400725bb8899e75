"""The playground without its page: scenes, and a twin that balances in real time.

The twin, the controller and the trials are those of an evaluation.
"""

from collections import deque
from math import degrees, exp, radians, sqrt
from typing import Final, Literal, NamedTuple

import numpy as np

from equipoise.artefacts import Estimate
from equipoise.control.bound_policy import load_policy
from equipoise.control.control_step import horizon
from equipoise.control.grid import TRUNCATED, box_indices, make_grid
from equipoise.control.policy import TabularPolicy, TaskPolicy, shipped_policy
from equipoise.model.random import DEPLOYMENT
from equipoise.model.worlds import World, read_world
from equipoise.outcomes import TRIAL_OUTCOMES
from equipoise.paper import PHI_LIMIT_DEG, U_MAX, X_LIMIT
from equipoise.settings import BoxSettings
from equipoise.worlds import predicted, setup_of
from equipoise.worlds.twin.world import TwinSimulation

FALL: Final = 2.0
"""Time that a fall is shown [s]."""
RECENT: Final = 5.0
"""Time over which the text describes the motion [s]."""


class Scene(NamedTuple):
    """A scene; the defaults are the shipped policy on the nominal twin."""

    about: str = ""
    """What to look at, in a few sentences."""
    policy: Literal["shipped table", "LQR", "yours"] = "shipped table"
    """Policy that balances; `yours` is that of the user."""
    predict: bool = True
    """Whether the policy sees the state at which its command takes effect."""
    delay: float = 0.010
    """Transport delay of the robot's commands, to which the servo's response adds [s]."""
    zero: float = 0.0
    """Error of the encoder's zero [rad]."""
    friction: float = 0.1
    """Dry friction of the pendulum over its inertia [1/s^2]."""
    lean: float = radians(3.0)
    """Angle from upright at the start [rad]."""


SCENES: Final = {
    "balance": Scene("Push the pendulum: how much can it take?"),
    "why-it-falls": Scene(
        "The same rig, but the policy sees the present, not the moment at which its command "
        "arrives. Lower the transport delay: from where on does it stand? Then switch the "
        "prediction on.",
        predict=False,
        delay=0.030,
    ),
    "zero-error": Scene(
        "The encoder's zero is 1.5 degrees off. Watch the flange: it drives to one side until the "
        "controller has found the error.",
        zero=radians(1.5),
    ),
    "friction": Scene(
        "A sticky pivot. The pendulum rests beside upright, and the policy hunts around it.",
        friction=1.0,
    ),
    "lqr": Scene("Compare with the shipped table: which one is at rest?", policy="LQR"),
}
"""Scenes by name."""
POLICIES: Final = {
    "shipped table": "The shipped table: eight accelerations, so that it is never quite at rest.",
    "LQR": "A linear regulator: it answers small angles with small accelerations.",
    "yours": "Your policy.",
}
"""Sentence on each policy."""


class Playground:
    """A twin that balances tick by tick, under a scene that may change at any time.

    `advance` updates joints `q` [rad], shape (joints,), angle `phi` from upright [rad], commanded
    acceleration `u` [m/s^2], and `box`, that of the table with the policy's input, -1 for none.
    """

    def __init__(self, scene: Scene, yours: TaskPolicy | None = None) -> None:
        """Set a scene up.

        Args:
            scene: The scene.
            yours: The policy of `yours`.
        """
        self.policies = {"shipped table": shipped_policy(), "LQR": load_policy("lqr")}
        """Policies by name."""
        if yours is not None:
            self.policies["yours"] = yours
        self._number = 0
        self.set(scene)

    def set(self, scene: Scene) -> None:
        """Set another scene up, and begin again."""
        policy, base = self.policies[scene.policy], read_world("twin:nominal").settings
        rig = {"transport": scene.delay, "coulomb": scene.friction, "zero_offset": scene.zero}
        exact = {"zero_error": 0.0, "inertia_sigma": 0.0, "friction_sigma": 0.0}
        known = shipped_policy().actuator  # identified on the nominal twin, then moved along
        moved = max(known.delay.value + scene.delay - base.transport, 0.0)
        actuator = known.model_copy(update={"delay": Estimate.around(moved, 0.0, "given")})
        controller = policy.settings.controller.model_copy(update={"predict": scene.predict})
        settings = policy.settings.model_copy(update={"controller": controller})
        twin = World("playground", base.model_copy(update=rig | exact))
        setup = setup_of(policy, twin, settings, actuator)
        self.scene, self.policy, self.arm = scene, policy, policy.arm
        parameters, self.h = policy.pendulum.parameters(), policy.h
        self.latency = horizon(policy.arm, actuator, 0.0)
        """Time from a command to its effect [s]: transport, then the response of the servo."""
        self.growth = exp(sqrt(parameters.w2) * self.latency)
        """Factor by which a lean grows within the latency [-]."""
        self._simulation = TwinSimulation(twin, setup, seed=0, stream=DEPLOYMENT)
        self._loop = self._simulation.loop()
        self._boxes = make_grid(BoxSettings(), parameters.k)
        self.u_of_box = None
        if isinstance(policy, TabularPolicy) and policy.settings.boxes == BoxSettings():
            self.u_of_box = policy.u_of_box.reshape(-1)
        """Command of each box [m/s^2], shape (270,); None without a table of the usual boxes."""
        self.box, self.used = -1, np.zeros(BoxSettings().count)
        """Recent use of each box, 0 to 1, shape (270,)."""
        self.begin()

    def begin(self) -> None:
        """Release the pendulum again."""
        trial = self._simulation.draw(1, self._number).trial(0)
        self._number += 1
        self._loop.reset(trial._replace(start=(0.0, 0.0, self.scene.lean, 0.0)))
        self.policy.reset()
        self._tick, self._fell, self.fallen = 0, 0, ""
        self._recent: deque[tuple[float, float]] = deque(maxlen=round(RECENT / self.h))

    def push(self, rate: float) -> None:
        """Push the pendulum, which changes its rate [rad/s]."""
        self._loop.push(rate)

    def advance(self) -> None:
        """Advance by one tick; a fall is shown for `FALL`, then the pendulum is released again."""
        if self.fallen and (self._tick - self._fell) * self.h > FALL:
            self.begin()
        loop, seen = self._loop, predicted(self._loop)
        if self.fallen:
            # The flange brakes with 5 times its velocity a second.
            self.u = float(np.clip(-5.0 * loop.state()[1], -U_MAX, U_MAX))
        else:
            self.u = float(self.policy.act(seen))
        cause = loop.step(self.u)
        self._tick += 1
        if cause != TRUNCATED and not self.fallen:
            self.fallen, self._fell = TRIAL_OUTCOMES[cause], self._tick
        x, _, self.phi, _ = loop.state().tolist()
        self.q, self.box = loop.joints(), -1
        self.used *= exp(-self.h / 2.0)  # a used box fades within some seconds
        if not self.fallen:
            self._recent.append((x, self.phi))
            inside = abs(degrees(seen[2])) < PHI_LIMIT_DEG and abs(seen[0]) < X_LIMIT
            if self.u_of_box is not None and inside:
                self.box = int(box_indices(seen[None, :], self._boxes)[0])
                self.used[self.box] = 1.0

    def sentences(self) -> tuple[str, str, str, str]:
        """Return the policy, the scene, the motion so far, and the effect of the latency."""
        stood = (self._fell if self.fallen else self._tick) * self.h
        motion = f"It has stood for {stood:.0f} s."
        if self.fallen:
            motion = f"It fell after {stood:.1f} s ({self.fallen})."
        elif len(self._recent) > 1:
            x, phi = np.abs(np.array(self._recent)).max(axis=0)
            motion += f" In the last {RECENT:g} s: ±{degrees(phi):.1f}°, ±{1e3 * x:.0f} mm."
        transport, latency = 1e3 * self.scene.delay, 1e3 * self.latency
        effect = (
            f"A command acts after {latency:.0f} ms: {transport:.0f} ms transport + "
            f"{latency - transport:.0f} ms servo. "
            f"Meanwhile a lean grows by {100.0 * (self.growth - 1.0):.0f} %."
        )
        return POLICIES[self.scene.policy], self.scene.about, motion, effect
