"""Gymnasium environment of the balancing task, `equipoise/Balance-v0`.

`gymnasium.make("equipoise.envs:equipoise/Balance-v0")` imports this module, which registers it.
"""

from collections.abc import Callable
from math import inf, isfinite, nan
from typing import Any, Final

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import EzPickle
from pydantic import ValidationError

from equipoise import paper
from equipoise.arguments import checked
from equipoise.arm.arm import Arm
from equipoise.arm.urdf import read_arm
from equipoise.arrays import Array
from equipoise.control.controller import Observation
from equipoise.errors import InputError
from equipoise.files import Count, Seed, StrPath, Value, first_fault, quoted
from equipoise.film import RigRenderer
from equipoise.learning import rewards
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator, read_actuator
from equipoise.model.grid import TRUNCATED
from equipoise.model.pendulum import Pendulum, read_pendulum
from equipoise.model.random import ENVIRONMENT, TEST
from equipoise.model.worlds import MODEL, World
from equipoise.outcomes import TRIAL_OUTCOMES
from equipoise.settings import Settings
from equipoise.simulation import Setup, Trial, predicted, simulate, world_class
from equipoise.user_code import user_code

Reward = Callable[[Observation, float, Observation, bool], float]
"""Reward of a step: `reward(state, u, next_state, failed)`; the states are predicted ones."""

UPRIGHT_TIME: Final = 1.0
"""Time within the failure angle after which a pendulum that was swung up may fail [s]."""
ID: Final = "equipoise/Balance-v0"
"""Name of the environment for `gymnasium.make`."""


class _Options(Value):
    """Options of `BalanceEnv.reset`."""

    trial: Count
    seed: Seed | None = None


class BalanceEnv(gym.Env[Array, Any], EzPickle):
    r"""Balance an inverted pendulum on the flange of a robot arm.

    ## Description

    The task of Safeea and Neto, *A Q-learning approach to the continuous control problem of robot
    inverted pendulum balancing*: a pendulum stands on the flange of an arm, which accelerates along
    a track of 0.44 m. A step is one control tick of 0.01 s. Every world runs the kernels of
    `equipoise.evaluate`; an episode has the bits of the trial with the same conditions.

    ## Action Space

    `Box(-2, 2, (1,), float64)`: acceleration u of the flange along x [m/s^2]; others are clipped.
    `discrete=True` makes it the paper's `Discrete(8)`: -2, -1.5, -1, -0.5, 0.5, 1, 1.5, 2 m/s^2.

    ## Observation Space

    `Box(-inf, inf, (4,), float64)`: x [m], x_dot [m/s], phi from upright [rad], phi_dot [rad/s].

    It is the state at which the action takes effect, predicted past delay and lag.
    In the world `ideal` it is the state itself. In `ideal` and `model` the pose error of CLIK has
    noise (`plant.position_error_sigma`, `plant.orientation_error_sigma`).

    ## Rewards

    -1 for a failure, 0 for any other step. `reward=` takes any function
    `reward(state, u, next_state, failed) -> float` of predicted observations.

    ## Starting State

    As after a release by hand: the arm at rest at home, phi of 1.5 to 2.5 degrees and phi_dot of 8
    to 18 deg/s to the same side. Inertia, friction, delay, lags and the encoder's zero vary.
    `reset(seed=s)` begins with episode 0 of seed s, each further `reset()` is the next episode.
    `reset(options={"trial": i, "seed": s})` replays trial i of `evaluate(..., seed=s)`.

    With `evaluation.start = "hanging"` in `settings` the pendulum hangs, and swings by so much; the
    agent swings it up. `equipoise.control.swing_up.SwingUpPolicy` is a policy that can.

    ## Episode End

    1. Termination: abs(phi) reaches 11 degrees, abs(x) reaches 0.22 m, a command exceeds a limit of
       a joint, or in a world with guards a rule of the rig stops the run. After a hanging start
       the limit of phi applies once the pendulum has stayed within it for 1 s.
    2. Truncation: `gymnasium.make` limits an episode to 6000 steps, 60 s, or to its
       `max_episode_steps`.

    `info` has `time` since the release [s], `outcome` (empty without a failure), and
    the true `state`.

    ## Arguments

    | argument | default | meaning |
    | --- | --- | --- |
    | `world` | `"model"` | `ideal`, `model`, `twin:NAME`, `twin:FILE`, `MODULE:CLASS`, ... |
    | `discrete` | `False` | whether actions are indices of the paper's accelerations |
    | `reward` | `failure` | see above |
    | `pendulum`, `arm`, `actuator`, `settings` | those that ship | the task; values, names, files |
    | `render_mode` | `None` | `rgb_array`; `gymnasium.wrappers.HumanRendering` opens a window |

    A copy or a pickle is a new environment with the same arguments, before its first `reset`.

    ## Version History

    * v0: Initial version.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 100}  # noqa: RUF012  (the type of Gymnasium)

    @checked
    def __init__(
        self,
        world: str | World = MODEL,
        *,
        discrete: bool = False,
        reward: Reward = rewards.failure,
        pendulum: Pendulum | StrPath | None = None,
        arm: Arm | StrPath | None = None,
        actuator: Actuator | StrPath | None = None,
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
        EzPickle.__init__(
            self,
            world,
            discrete=discrete,
            reward=reward,
            pendulum=pendulum,
            arm=arm,
            actuator=actuator,
            settings=settings,
            render_mode=render_mode,
        )
        response = read_actuator(actuator)
        self.task = Setup(
            read_pendulum(pendulum),
            read_arm(arm),
            settings or Settings(),
            IDEAL_ACTUATOR if world_class(world).ideal_arm else response,
            paper.STEP,
        )
        self.reward = reward
        self._discrete = discrete
        self.render_mode = render_mode
        self._renderer: RigRenderer | None = None
        self.observation_space = spaces.Box(-inf, inf, (4,), np.float64)
        self.action_space: gym.Space[Any] = spaces.Box(-paper.U_MAX, paper.U_MAX, (1,), np.float64)
        if discrete:
            self.action_space = spaces.Discrete(len(paper.ACTIONS))
        self._seed, self._number, self._u, self._within = -1, 0, 0.0, 0
        self._state: Observation | None = None
        self.simulation = simulate(world, self.task, seed=0, stream=ENVIRONMENT)
        self._loop = self.simulation.loop()

    @checked
    def reset(
        self, *, seed: Seed | None = None, options: dict[str, Any] | None = None
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
        self._within = 0
        self._u, self._state = 0.0, Observation(*predicted(self._loop).tolist())
        return predicted(self._loop), self._info("")

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Advance by one tick with the acceleration u [m/s^2], at most that of the paper.

        Raises:
            InputError: The action is of another shape or not finite, no episode is running, or the
                reward raised an error or is no number.
        """
        if self._state is None:
            raise InputError("no episode is running: it has failed or not begun; call env.reset()")
        try:
            if self._discrete:
                u = paper.ACTIONS[int(action)] if self.action_space.contains(action) else nan
            else:
                u = float(np.float64(action).item())
        except (TypeError, ValueError):
            u = nan
        if not isfinite(u):
            raise InputError(f"the action is {quoted(action)}; expected one of {self.action_space}")
        u = min(max(u, -paper.U_MAX), paper.U_MAX)
        cause, self._u = self._loop.step(u), u
        if not self._loop.balancing:
            within = abs(float(self._loop.state()[2])) < paper.PHI_LIMIT
            self._within = self._within + 1 if within else 0
            self._loop.balancing = self._within * self._loop.params.h >= UPRIGHT_TIME
        failed, after = cause != TRUNCATED, Observation(*predicted(self._loop).tolist())
        with user_code("the reward"):
            reward = float(self.reward(self._state, u, after, failed))
        self._state = None if failed else after
        info = self._info(TRIAL_OUTCOMES[cause] if failed else "")
        return predicted(self._loop), reward, failed, False, info

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
        simulation, number = self.simulation, self._number
        simulation.seed, simulation.stream = self._seed, ENVIRONMENT
        if options:
            try:
                asked = _Options.model_validate(options)
            except ValidationError as error:
                raise InputError(f"options: {first_fault(error)}") from None
            number, simulation.stream = asked.trial, TEST
            simulation.seed = self._seed if asked.seed is None else asked.seed
        return simulation.draw(1, first=number).trial(0)

    def _info(self, outcome: str) -> dict[str, Any]:
        loop = self._loop
        return {"time": loop.now, "outcome": outcome, "state": loop.state()}


def register() -> None:
    """Register the environment with Gymnasium, unless it is registered already."""
    if ID not in gym.registry:
        gym.register(ID, entry_point="equipoise.envs:BalanceEnv", max_episode_steps=6000)


register()
