"""Native vector environments: many episodes in one call of compiled code, over the cores."""

from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from equipoise import paper
from equipoise.control.controller import Observation
from equipoise.control.grid import TRUNCATED
from equipoise.envs.balance import (
    NOT_RESET,
    WINDOW,
    Array,
    BalanceEnv,
)
from equipoise.errors import InputError
from equipoise.executors import available_cores
from equipoise.learning.rewards import paper as paper_reward
from equipoise.model.random import ENVIRONMENT
from equipoise.model.worlds import MODEL, World
from equipoise.outcomes import TRIAL_OUTCOMES
from equipoise.worlds import Trials
from equipoise.worlds.fleet import Fleet
from equipoise.worlds.ideal import PlantSimulation
from equipoise.worlds.trials import IntArray

Flags = npt.NDArray[np.bool_]


class BalanceVectorEnv(gym.vector.VectorEnv[Array, Array, Array]):
    """Balance `num_envs` pendulums at once: `gymnasium.make_vec("equipoise/Balance-v0", ...)`.

    ## Description

    Each environment is a `BalanceEnv` in the world `ideal` or `model`, with its observations,
    actions, rewards and ends of an episode; an array has one row for each. One compiled call
    advances all of them. For another world take `vectorization_mode="async"`.

    ## Starting State

    `reset(seed=s)` gives environment i episode i of seed s, with the bits of a single environment
    in that episode. Every later reset takes the next episode that has not been used, in the order
    of the environments.

    ## Episode End

    `autoreset_mode` is one of Gymnasium's: `NextStep` (the default) resets an environment in the
    step after the end of its episode, without regard to its action; `SameStep` in the same step,
    with the last observation in `info["final_obs"]` and its info in `info["final_info"]`.

    `info` has `time` and `state` of each environment, and, where an episode ends, `outcome`; the
    key with a leading underscore marks the rows that have a value.

    ## Arguments

    | argument | default | meaning |
    | --- | --- | --- |
    | `num_envs` | 1 | number of environments |
    | `autoreset_mode` | `NextStep` | see above |
    | `workers` | one per core | largest number of threads; results do not depend on it |
    | others | | those of `BalanceEnv`, but for `render_mode` |

    A `reward` other than the default runs in Python, once for each environment and step.

    ## Version History

    * v0: Initial version.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  (the type of Gymnasium)
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        world: str | World = MODEL,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        workers: int | None = None,
        **arguments: Any,
    ) -> None:
        """Set up the environments; the arguments are in the description of the class.

        Raises:
            InputError: An argument cannot be used.
            SettingsError: The world does not exist.
            ArmError: The twin does not know the masses of the arm.
        """
        if num_envs < 1:
            raise InputError(f"num_envs is {num_envs}; expected 1 or more")
        if arguments.get("render_mode") is not None:
            raise InputError("a vector environment draws no pictures; leave render_mode out")
        mode = autoreset_mode.value if isinstance(autoreset_mode, AutoresetMode) else autoreset_mode
        if mode not in ("NextStep", "SameStep"):
            raise InputError(f"autoreset_mode is {mode!r}; expected 'NextStep' or 'SameStep'")
        self._mode = AutoresetMode(mode)
        self.metadata = {**self.metadata, "autoreset_mode": self._mode}
        single = BalanceEnv(world, **arguments)
        simulation = single.simulation
        if not isinstance(simulation, PlantSimulation):
            raise InputError(
                f"the world {world} has no native vector environment; choose ideal or model, or "
                "gymnasium.make_vec(..., vectorization_mode='async')"
            )
        self._simulation, self._reward = simulation, single.reward
        self._max_steps, self._h = single.max_steps, single.task.h
        self._discrete = isinstance(single.action_space, spaces.Discrete)
        self.num_envs = num_envs
        self.single_observation_space = single.observation_space
        self.single_action_space = single.action_space
        self.observation_space = batch_space(single.observation_space, num_envs)
        self.action_space = batch_space(single.action_space, num_envs)
        self._fleet = Fleet(simulation, num_envs, workers or available_cores())
        self._values = self._fleet.values
        self._observed = getattr(self._values, single.observe)
        self._ended, self._all = np.zeros(num_envs, np.bool_), np.ones(num_envs, np.bool_)
        self._seed, self._episode, self._used, self._window = -1, 0, 0, simulation.draw(0)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Release the pendulums, and return the first observations and their info.

        Args:
            seed: Master seed of these episodes and of those that follow.
            options: None.

        Raises:
            InputError: `seed` is a list, or there are options.
        """
        if isinstance(seed, list) or options:
            raise InputError("expected one seed for all environments, and no options")
        super().reset(seed=seed)
        if seed is not None or self._seed < 0:
            self._seed = seed if seed is not None else int(self.np_random.integers(2**31))
            self._simulation.seed, self._simulation.stream = self._seed, ENVIRONMENT
            self._episode, self._used, self._window = 0, 0, self._simulation.draw(0)
        self._release(np.arange(self.num_envs))
        self._ended[:] = False
        return self._observed.copy(), self._info()

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Advance all environments by one tick.

        Args:
            actions: One action for each environment, as in `action_space`.

        Raises:
            InputError: The actions have another shape or are not finite, or a reset is missing.
        """
        if self._seed < 0:
            raise InputError(NOT_RESET)
        values, over = self._values, self._ended
        u = self._accelerations(actions)
        before = None if self._reward is paper_reward else values.predicted.copy()
        self._fleet.step(u)
        terminated = values.cause != TRUNCATED
        truncated = values.tick >= self._max_steps
        truncated &= ~terminated
        if before is None:
            rewards = np.where(terminated, -1.0, 0.0)
        else:
            rewards = self._rewards(before, u, terminated)
        if self._mode is AutoresetMode.NEXT_STEP and over.any():
            self._release(np.flatnonzero(over))
            rewards[over], terminated[over], truncated[over] = 0.0, False, False
        ended = terminated | truncated
        info = self._info(ended if ended.any() else None)
        if self._mode is AutoresetMode.SAME_STEP and ended.any():
            final = {"final_obs": self._observed.copy(), "_final_obs": ended}
            final |= {"final_info": info, "_final_info": ended}
            self._release(np.flatnonzero(ended))
            info, self._ended = self._info() | final, np.zeros_like(ended)
        else:
            self._ended = ended
        return self._observed.copy(), rewards, terminated, truncated, info

    def close_extras(self, **_: Any) -> None:
        """End the threads."""
        self._fleet.close()

    def _accelerations(self, actions: Any) -> Array:
        """Return u of each environment [m/s^2], shape (num_envs,)."""
        if self._discrete and self.action_space.contains(np.asarray(actions)):
            return np.array(paper.ACTIONS)[np.asarray(actions)]
        try:
            u = np.asarray(actions, np.float64).reshape(self.num_envs)
        except (TypeError, ValueError):
            u = np.full(1, np.nan)
        if self._discrete or not np.isfinite(u).all():
            raise InputError(f"the actions are {actions!r:.60}; expected {self.action_space}")
        return u

    def _rewards(self, before: Array, u: Array, failed: Array) -> Array:
        after, reward = self._values.predicted, self._reward
        steps = zip(before.tolist(), u.tolist(), after.tolist(), failed.tolist(), strict=True)
        return np.array([reward(Observation(*s), a, Observation(*n), f) for s, a, n, f in steps])

    def _release(self, loops: IntArray) -> None:
        """Begin the next episodes in some environments."""
        count = len(loops)
        if self._used + count > len(self._window.number):
            self._window = self._simulation.draw(max(WINDOW, count), first=self._episode)
            self._used = 0
        rows = slice(self._used, self._used + count)
        self._fleet.reset(loops, Trials._make(column[rows] for column in self._window))
        self._used, self._episode = rows.stop, self._episode + count

    def _info(self, ended: Flags | None = None) -> dict[str, Any]:
        values = self._values
        info: dict[str, Any] = {
            "time": values.tick * self._h,
            "_time": self._all,
            "state": values.state.copy(),
            "_state": self._all,
        }
        if ended is not None:
            info["outcome"], info["_outcome"] = np.full(self.num_envs, "", object), ended
            codes = values.cause[ended].tolist()
            info["outcome"][ended] = [TRIAL_OUTCOMES[code] for code in codes]
        return info
