"""Gymnasium environments of the balancing task, `equipoise/Balance-v0`: one, and many at once.

`gymnasium.make("equipoise.envs:equipoise/Balance-v0")` imports this module, which registers it;
`gymnasium.make_vec` takes the same name.
"""

from collections.abc import Callable
from math import inf, nan
from typing import Annotated, Any, Final, Literal

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import EzPickle
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from pydantic import Field

from equipoise import paper
from equipoise.arguments import checked
from equipoise.arm.arm import Arm
from equipoise.arm.urdf import read_arm
from equipoise.arrays import Array, Records
from equipoise.control.policy import Observation
from equipoise.errors import InputError
from equipoise.files import Seed, StrPath, quoted
from equipoise.film import RigRenderer
from equipoise.learning import rewards
from equipoise.learning.choice import compile_reward
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator, read_actuator
from equipoise.model.grid import TRUNCATED
from equipoise.model.pendulum import Pendulum, read_pendulum
from equipoise.model.random import ENVIRONMENT, TEST
from equipoise.model.worlds import MODEL, World
from equipoise.outcomes import TRIAL_OUTCOMES
from equipoise.settings import Settings
from equipoise.simulation import Setup, predicted, simulate, world_class
from equipoise.simulation.lanes import Lanes, upright_ticks
from equipoise.user_code import user_code

Reward = Callable[[Observation, float, Observation, bool], float]
"""Reward of a step: `reward(state, u, next_state, failed)`; the states are predicted ones."""

NEXT_STEP: Final = AutoresetMode.NEXT_STEP
"""Reset of a lane in the step after the end of its episode, as of Gymnasium's own environments."""
Replayed = dict[Literal["trial", "seed"], Seed]
"""Number of a trial of `evaluate`, and its seed."""
Flags = npt.NDArray[np.bool_]
"""Truth values."""
MAX_STEPS: Final = 6000
"""Number of steps of an episode, unless `max_episode_steps` is given."""
ACTIONS: Final = np.array(paper.ACTIONS)
"""Accelerations of the discrete actions [m/s^2]."""
OUTCOMES: Final = np.array(["", *TRIAL_OUTCOMES[1:]], object)
"""`outcome` of a step by the code that kernels return."""


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
        render_mode: Literal["rgb_array"] | None = None,
    ) -> None:
        """Set up the task; the arguments are in the description of the class.

        Raises:
            InputError: An argument cannot be used.
            SettingsError: The world does not exist.
            ArmError: The twin does not know the masses of the arm.
        """
        EzPickle.__init__(**locals())
        response = read_actuator(actuator)
        self.task = Setup(
            read_pendulum(pendulum),
            read_arm(arm),
            settings or Settings(),
            IDEAL_ACTUATOR if world_class(world).ideal_arm else response,
            paper.STEP,
        )
        self.reward = reward
        self.render_mode = render_mode
        self._renderer: RigRenderer | None = None
        self.observation_space = spaces.Box(-inf, inf, (4,), np.float64)
        self.action_space: gym.Space[Any] = spaces.Box(-paper.U_MAX, paper.U_MAX, (1,), np.float64)
        if discrete:
            self.action_space = spaces.Discrete(len(paper.ACTIONS))
        self._seed, self._number, self._u, self._upright = -1, 0, 0.0, 0
        self._state: Observation | None = None
        self.simulation = simulate(world, self.task, seed=0, stream=ENVIRONMENT)
        self._loop = self.simulation.loop()

    @checked
    def reset(  # pyright: ignore[reportIncompatibleMethodOverride]  # Gymnasium's type is wider
        self, *, seed: Seed | None = None, options: Replayed | None = None
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
        simulation, number = self.simulation, self._number
        simulation.seed, simulation.stream = self._seed, ENVIRONMENT
        if options:
            if "trial" not in options:
                raise InputError("the options have no trial; give its number, and a seed if wanted")
            simulation.seed, simulation.stream = options.get("seed", self._seed), TEST
            number = options["trial"]
        self._loop.reset(simulation.draw(1, first=number).trial(0))
        self._upright = 0
        observation = predicted(self._loop)
        self._u, self._state = 0.0, Observation(*observation.tolist())
        return observation, self._info("")

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Advance by one tick with the acceleration u [m/s^2], at most that of the paper.

        Raises:
            InputError: The action is of another shape or not finite, no episode is running, or the
                reward raised an error or is no number.
        """
        if self._state is None:
            raise InputError("no episode is running: it has failed or not begun; call env.reset()")
        u = min(max(float(accelerations(action, self.action_space)), -paper.U_MAX), paper.U_MAX)
        cause, self._u = self._loop.step(u), u
        if not self._loop.balancing:
            phi, h = float(self._loop.state()[2]), self._loop.params.h
            self._upright, self._loop.balancing = upright_ticks(self._upright, phi, h)
        failed, observation = cause != TRUNCATED, predicted(self._loop)
        after = Observation(*observation.tolist())
        with user_code("the reward"):
            reward = float(self.reward(self._state, u, after, failed))
        self._state = None if failed else after
        return observation, reward, failed, False, self._info(OUTCOMES[cause])

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

    def _info(self, outcome: str) -> dict[str, Any]:
        loop = self._loop
        return {"time": loop.now, "outcome": outcome, "state": loop.state()}


class BalanceVectorEnv(gym.vector.VectorEnv[Array, Array, npt.NDArray[Any]]):
    """Balance many pendulums at once: `gymnasium.make_vec(...)` with the name of `BalanceEnv`.

    ## Description

    Each lane is a `BalanceEnv` with its observations, actions, rewards and ends of an episode; an
    array has one row for each. After `reset(seed=s)`, lane i has the bits of a `BalanceEnv` after
    `reset(seed=s + i)`, in later episodes, too, whatever the number of lanes and of cores.

    Kernels advance the lanes on all cores, sixteen at a time in the worlds `ideal` and `model`. For
    a world whose trials run from Python give `vectorization_mode="sync"` or `"async"`.

    ## Episode End

    `autoreset_mode` is one of Gymnasium's. With `AutoresetMode.NEXT_STEP` a lane begins its next
    episode in the step after the end, without regard to its action. With `SAME_STEP` it does so in
    the same step, with the last observation in `info["final_obs"]` and its info in
    `info["final_info"]`.

    ## Arguments

    | argument | default | meaning |
    | --- | --- | --- |
    | `num_envs` | 1 | number of lanes |
    | `max_episode_steps` | 6000 | number of steps after which an episode is truncated |
    | `autoreset_mode` | `NEXT_STEP` | see above |
    | others | | those of `BalanceEnv`; lanes draw no pictures |

    The reward is compiled with Numba, as for the training of a table.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": NEXT_STEP}  # noqa: RUF012  (the type of Gymnasium)

    @checked
    def __init__(
        self,
        num_envs: Annotated[int, Field(ge=1)] = 1,
        world: str | World = MODEL,
        *,
        max_episode_steps: Annotated[int, Field(ge=1)] = MAX_STEPS,
        autoreset_mode: Literal[AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP] = NEXT_STEP,
        render_mode: None = None,
        **arguments: Any,
    ) -> None:
        """Set up the lanes; the arguments are in the description of the class.

        Raises:
            InputError: An argument cannot be used, or the reward cannot be compiled.
            SettingsError: The world does not exist.
            ArmError: The twin does not know the masses of the arm.
        """
        env = BalanceEnv(world, **arguments)
        self.num_envs = num_envs
        self.single_observation_space = env.observation_space
        self.single_action_space = env.action_space
        self.observation_space = batch_space(env.observation_space, num_envs)
        self.action_space = batch_space(env.action_space, num_envs)
        self.metadata = {**self.metadata, "autoreset_mode": autoreset_mode}
        reward, own = compile_reward(env.reward), env.reward in rewards.REWARDS.values()
        self._lanes = Lanes(env.simulation, num_envs, reward, own)
        self._max_steps = max_episode_steps
        self._all, self._over = np.ones(num_envs, np.bool_), None

    @checked
    def reset(
        self, *, seed: Seed | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Release the pendulums, and return the first observations and their info.

        Args:
            seed: Master seed of lane 0; lane i has `seed` + i.
            options: None.

        Raises:
            InputError: There are options.
        """
        if options:
            raise InputError("lanes take no options; replay a trial with gymnasium.make(...)")
        super().reset(seed=seed)
        if seed is None and self._over is None:
            seed = int(self.np_random.integers(2**31))
        rows = np.arange(self.num_envs)
        self._over = rows[:0]
        values = self._lanes.release(rows, seed)
        return values["observation"], self._info(values, self._all)

    def step(self, actions: Array) -> tuple[Array, Array, Flags, Flags, dict[str, Any]]:
        """Advance all lanes by one tick.

        Args:
            actions: An action for each lane, as in `action_space`.

        Raises:
            InputError: The actions have another shape or are not finite, no episodes are running,
                or the reward raised an error.
        """
        if self._over is None:
            raise InputError("no episodes are running; call envs.reset()")
        u = accelerations(actions, self.action_space)
        with user_code("the reward"):
            values = self._lanes.step(u, self._over)
        failed, late = values["cause"] != TRUNCATED, values["tick"] >= self._max_steps
        ended, shown, info = failed | late, values, {}
        self._over = np.flatnonzero(ended)
        if self._over.size and self.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP:
            last = np.full(self.num_envs, None, object)
            for i in self._over:
                last[i] = values["observation"][i]
            info = {"final_obs": last, "final_info": self._info(values, ended)}
            info |= {"_final_obs": ended, "_final_info": ended}
            shown, self._over = self._lanes.release(self._over), self._over[:0]
        info |= self._info(shown, self._all)
        return shown["observation"], values["reward"], failed, late, info

    def close_extras(self, **_: Any) -> None:
        """End the threads."""
        self._lanes.pool.shutdown()

    def _info(self, values: Records, rows: Flags) -> dict[str, Any]:
        """Return the info of some rows, in the form of Gymnasium."""
        info = {"time": values["time"], "state": values["state"]}
        info["outcome"] = OUTCOMES.take(values["cause"])
        return info | {f"_{name}": rows for name in info}


def accelerations(actions: Any, space: gym.Space[Any]) -> Array:
    """Return the acceleration of an action, or of one for each lane [m/s^2].

    Raises:
        InputError: They have another shape than those of the space, or are not finite.
    """
    shape = space.shape
    try:
        if space.dtype is not None and space.dtype.kind == "i":
            u = ACTIONS[np.asarray(actions)] if space.contains(actions) else np.array(nan)
        else:
            u = np.asarray(actions, np.float64).reshape(shape[:-1] if shape else ())
    except (TypeError, ValueError):
        u = np.array(nan)
    if not np.isfinite(u).all():
        raise InputError(f"the action is {quoted(actions)}; expected one of {space}")
    return u


gym.register(
    "equipoise/Balance-v0",
    entry_point="equipoise.envs:BalanceEnv",
    vector_entry_point="equipoise.envs:BalanceVectorEnv",
    max_episode_steps=MAX_STEPS,
)
