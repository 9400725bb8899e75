"""Gymnasium environment of the balancing task, `equipoise/Balance-v0`.

`import equipoise.envs` registers it.
"""

from collections.abc import Callable
from math import inf, isfinite
from typing import Any, Final

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from equipoise import paper
from equipoise.control.controller import Observation
from equipoise.control.grid import TRUNCATED
from equipoise.errors import InputError
from equipoise.film import RigRenderer
from equipoise.learning import rewards
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator, shipped_actuator
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.elementary import Array
from equipoise.model.pendulum import Pendulum, shipped_pendulum
from equipoise.model.random import ENVIRONMENT, TEST
from equipoise.model.worlds import MODEL, World
from equipoise.outcomes import TRIAL_OUTCOMES
from equipoise.settings import Settings
from equipoise.worlds import Setup, Trial, predicted, simulate, world_class

Reward = Callable[[Observation, float, Observation, bool], float]
"""Reward of a step: `reward(state, u, next_state, failed)`; the states are predicted ones."""

ID: Final = "equipoise/Balance-v0"
"""Name of the environment for `gymnasium.make`."""


class BalanceEnv(gym.Env[Array, Any]):
    r"""Balance an inverted pendulum on the flange of a robot arm.

    ## Description

    The task of Safeea and Neto, *A Q-learning approach to the continuous control problem of robot
    inverted pendulum balancing*: a pendulum stands on the flange of an arm, which accelerates along
    a track of 0.44 m. A step is one control tick of 0.01 s. Every world runs the kernels of
    `equipoise.evaluate`; an episode has the bits of the trial with the same conditions.

    ## Action Space

    `Box(-2, 2, (1,), float64)`: acceleration u of the flange along x [m/s^2].
    `discrete=True` makes it the paper's `Discrete(8)`: -2, -1.5, -1, -0.5, 0.5, 1, 1.5, 2 m/s^2.

    ## Observation Space

    `Box(-inf, inf, (4,), float64)`: x [m], x_dot [m/s], phi from upright [rad], phi_dot [rad/s].

    It is the state at which the action takes effect, predicted past delay and lag.
    In the world `ideal` the observation is the state itself.

    ## Rewards

    -1 for a failure, 0 for any other step. `reward=` takes any function
    `reward(state, u, next_state, failed) -> float` of predicted observations.

    ## Starting State

    As after a release by hand: the arm at rest at home, phi of 1.5 to 2.5 degrees and phi_dot of 8
    to 18 deg/s to the same side. Inertia, friction, delay, lags and the encoder's zero vary.
    `reset(seed=s)` begins with episode 0 of seed s, each further `reset()` is the next episode.
    `reset(options={"trial": i, "seed": s})` replays trial i of `evaluate(..., seed=s)`.

    ## Episode End

    1. Termination: abs(phi) reaches 11 degrees, abs(x) reaches 0.22 m, a command exceeds a limit of
       a joint, or in a world with guards a rule of the rig stops the run.
    2. Truncation: the episode is `duration` seconds long.

    `info` has `time` since the release [s], `outcome` (empty before the end), and
    the true `state`.

    ## Arguments

    | argument | default | meaning |
    | --- | --- | --- |
    | `world` | `"model"` | `ideal`, `model`, `twin:NAME`, `twin:FILE`, `MODULE:CLASS`, ... |
    | `discrete` | `False` | whether actions are indices of the paper's accelerations |
    | `duration` | 60.0 | length of an episode [s] |
    | `reward` | the paper's | see above |
    | `pendulum`, `arm`, `actuator`, `settings` | those that ship | the task |
    | `render_mode` | `None` | `rgb_array`; `gymnasium.wrappers.HumanRendering` opens a window |

    ## Version History

    * v0: Initial version.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 100}  # noqa: RUF012  (the type of Gymnasium)

    def __init__(
        self,
        world: str | World = MODEL,
        *,
        discrete: bool = False,
        duration: float = 60.0,
        reward: Reward = rewards.paper,
        pendulum: Pendulum | None = None,
        arm: Arm | None = None,
        actuator: Actuator | None = None,
        settings: Settings | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Set up the task; the arguments are in the description of the class.

        Raises:
            InputError: An argument cannot be used.
            SettingsError: The world does not exist.
            ArmError: The twin does not know the masses of the arm.
        """
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(f"render_mode is {render_mode!r}; expected 'rgb_array' or None")
        self.task = Setup(
            pendulum or shipped_pendulum(),
            arm or iiwa(7),
            settings or Settings(),
            (IDEAL_ACTUATOR if world_class(world).ideal_arm else actuator or shipped_actuator(),),
            paper.STEP,
        )
        self.reward = reward
        self.max_steps = round(duration / self.task.h)
        """Number of steps after which an episode is truncated."""
        self._discrete = discrete
        self.render_mode = render_mode
        self._renderer: RigRenderer | None = None
        self.observation_space = spaces.Box(-inf, inf, (4,), np.float64)
        self.action_space: gym.Space[Any] = spaces.Box(-paper.U_MAX, paper.U_MAX, (1,), np.float64)
        if discrete:
            self.action_space = spaces.Discrete(len(paper.ACTIONS))
        self._seed, self._number, self._steps, self._u = -1, 0, 0, 0.0
        self._state: Observation | None = None
        self.simulation = simulate(world, self.task, seed=0, stream=ENVIRONMENT)
        self._loop = self.simulation.loop()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Release the pendulum, and return the first observation and its info.

        Args:
            seed: Master seed of this episode and of those that follow.
            options: `{"trial": i, "seed": s}` replays trial i of `evaluate(..., seed=s)`.
        """
        super().reset(seed=seed)
        if seed is not None or self._seed < 0:
            self._seed = seed if seed is not None else int(self.np_random.integers(2**31))
            self._number = -1
        self._number += 1
        self._loop.reset(self._trial(options or {}))
        self._steps, self._u, self._state = 0, 0.0, Observation(*predicted(self._loop).tolist())
        return predicted(self._loop), self._info("")

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Advance by one tick with the acceleration u [m/s^2].

        Raises:
            InputError: The action is not a finite number, or the environment was not reset.
        """
        if self._state is None:
            raise InputError("the environment has not been reset; call env.reset() first")
        discrete = self._discrete
        u = float(paper.ACTIONS[int(action)] if discrete else np.asarray(action, np.float64).item())
        if not isfinite(u):
            raise InputError(f"the action is {action!r}; expected an acceleration [m/s^2]")
        cause = self._loop.step(u)
        self._steps, self._u = self._steps + 1, u
        before, self._state = self._state, Observation(*predicted(self._loop).tolist())
        failed = cause != TRUNCATED
        truncated = not failed and self._steps >= self.max_steps
        reward = float(self.reward(before, u, self._state, failed))
        info = self._info(TRIAL_OUTCOMES[cause] if failed or truncated else "")
        return predicted(self._loop), reward, failed, truncated, info

    def render(self) -> npt.NDArray[np.uint8] | None:  # pyright: ignore[reportIncompatibleMethodOverride]  # Gymnasium's type is wider
        """Return a picture of the rig, shape (480, 640, 3); None without a render mode.

        Raises:
            OutsideError: OpenGL is not available.
        """
        if self.render_mode is None:
            gym.logger.warn("render() draws nothing without render_mode='rgb_array'")
            return None
        if self._renderer is None:
            self._renderer = RigRenderer(self.task.arm, 640, 480)
        return self._renderer.draw(self._loop.joints(), float(self._loop.state()[2]), self._u)

    def close(self) -> None:
        """Free the OpenGL context."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _trial(self, options: dict[str, Any]) -> Trial:
        """Return the conditions of the next episode."""
        if unknown := set(options) - {"trial", "seed"}:
            raise InputError(f"options has {sorted(unknown)}; expected 'trial' and 'seed'")
        simulation, number = self.simulation, self._number
        simulation.seed, simulation.stream = self._seed, ENVIRONMENT
        if "trial" in options:
            number = int(options["trial"])
            simulation.seed, simulation.stream = int(options.get("seed", self._seed)), TEST
        return simulation.draw(1, first=number).trial(0)

    def _info(self, outcome: str) -> dict[str, Any]:
        loop = self._loop
        return {"time": loop.now, "outcome": outcome, "state": loop.state()}


def register() -> None:
    """Register the environment with Gymnasium, unless it is registered already."""
    if ID not in gym.registry:
        gym.register(ID, entry_point="equipoise.envs:BalanceEnv")


register()
