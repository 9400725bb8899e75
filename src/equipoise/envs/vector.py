"""Native vector environments: many episodes in one call of compiled code, over the cores."""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from equipoise import paper
from equipoise.control.controller import Observation
from equipoise.control.grid import TRUNCATED
from equipoise.envs.balance import (
    NOT_RESET,
    WINDOW,
    Array,
    BalanceDiscreteEnv,
    BalanceEnv,
)
from equipoise.errors import InputError
from equipoise.executors import available_cores
from equipoise.learning.rewards import paper as paper_reward
from equipoise.model.random import ENVIRONMENT
from equipoise.model.worlds import MODEL, World
from equipoise.outcomes import TRIAL_OUTCOMES
from equipoise.worlds import Trials
from equipoise.worlds.fleet import new_fleet
from equipoise.worlds.trials import IntArray

Flags = npt.NDArray[np.bool_]

RESET_MASK = "reset_mask"
"""Option of `reset`: which environments are reset, shape (num_envs,)."""


class BalanceVectorEnv(gym.vector.VectorEnv[Array, Array, Array]):
    """Balance `num_envs` pendulums at once: `gymnasium.make_vec("equipoise/Balance-v0", ...)`.

    ## Description

    Each environment is a `BalanceEnv`, with its worlds, observations, actions, rewards and ends of
    an episode; an array has one row for each. In the worlds `ideal` and `model` one compiled call
    advances all of them.

    ## Starting State

    `reset(seed=s)` gives environment i episode i of seed s, with the bits of a single environment
    in that episode. Every later reset takes the next episode that has not been used, in the order
    of the environments.

    ## Episode End

    `autoreset_mode` is one of Gymnasium's: `NextStep` (the default) resets an environment in the
    step after the end of its episode, without regard to its action; `SameStep` in the same step,
    with the last observation in `info["final_obs"]` and its info in `info["final_info"]`;
    `Disabled` leaves it to `reset(options={"reset_mask": mask})`.

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
    SINGLE: ClassVar[type[BalanceEnv]] = BalanceEnv
    """Class of a single environment."""

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
        try:
            self._mode = AutoresetMode(autoreset_mode)
        except ValueError:
            modes = ", ".join(mode.value for mode in AutoresetMode)
            raise InputError(
                f"autoreset_mode is {autoreset_mode!r}; expected one of {modes}"
            ) from None
        self.metadata = {**self.metadata, "autoreset_mode": self._mode}
        single = self.SINGLE(world, **arguments)
        self._simulation, self._observe = single._simulation, single._observe
        self._reward, self._arm, self._h = single._reward, single.task.arm, single.task.h
        self._max_steps = round(single._duration / self._h)
        self.num_envs = num_envs
        self.single_observation_space = single.observation_space
        self.single_action_space = single.action_space
        self.observation_space = batch_space(single.observation_space, num_envs)
        self.action_space = batch_space(single.action_space, num_envs)
        self._fleet = new_fleet(self._simulation, num_envs, workers or available_cores())
        self._values, self._all = self._fleet.values, np.ones(num_envs, np.bool_)
        self._ended = np.zeros(num_envs, np.bool_)
        self._seed, self._episode, self._used, self._window = -1, 0, 0, self._simulation.draw(0)

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
        """Release the pendulums, and return the first observations and their info.

        Args:
            seed: Master seed of these episodes and of those that follow.
            options: `{"reset_mask": mask}` resets some of the environments.

        Raises:
            InputError: `seed` is a list, or `options` is something else.
        """
        if isinstance(seed, list):
            raise InputError("seed is a list; expected one number, for all environments")
        options = options or {}
        if unknown := set(options) - {RESET_MASK}:
            raise InputError(f"options has {sorted(unknown)}; expected {RESET_MASK!r}")
        super().reset(seed=seed)
        mask = np.asarray(options.get(RESET_MASK, self._all))
        if mask.dtype != np.bool_ or mask.shape != (self.num_envs,):
            raise InputError(
                f"{RESET_MASK} has the type {mask.dtype} and the shape {mask.shape}; expected bool "
                f"and ({self.num_envs},)"
            )
        if self._seed < 0 and not mask.all():
            raise InputError("the first reset is one of all environments; leave out reset_mask")
        if seed is not None or self._seed < 0:
            self._seed = seed if seed is not None else int(self.np_random.integers(2**31))
            simulation = self._simulation
            simulation.seed, simulation.stream = self._seed, ENVIRONMENT
            self._episode, self._used, self._window = 0, 0, simulation.draw(0)
        self._release(np.flatnonzero(mask))
        self._ended[mask] = False
        return self._observations(), self._info()

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
        if self._mode is AutoresetMode.DISABLED and over.any():
            raise InputError(
                f"{over.sum()} episodes have ended; call reset(options={{{RESET_MASK!r}: ended}})"
            )
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
            final = {"final_obs": self._observations(), "_final_obs": ended}
            final |= {"final_info": info, "_final_info": ended}
            self._release(np.flatnonzero(ended))
            info, self._ended = self._info() | final, np.zeros_like(ended)
        else:
            self._ended = ended
        return self._observations(), rewards, terminated, truncated, info

    def close_extras(self, **_: Any) -> None:
        """End the threads."""
        self._fleet.close()

    def _accelerations(self, actions: Any) -> Array:
        """Return u of each environment [m/s^2], shape (num_envs,)."""
        try:
            u = np.asarray(actions, np.float64).reshape(self.num_envs)
        except (TypeError, ValueError):
            u = np.full(1, np.nan)
        if not np.isfinite(u).all():
            raise InputError(
                f"the actions are {actions!r:.60}; expected finite accelerations [m/s^2], shape "
                f"{self.action_space.shape}"
            )
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

    def _observations(self) -> Array:
        values, observe = self._values, self._observe
        if observe == "predicted":
            return values.predicted.copy()
        if observe == "estimated":
            return values.estimated.copy()
        q = [self._arm.with_held(row) for row in values.measured[:, :-1]]
        return np.hstack((values.encoder, q, values.measured[:, -1:]))

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


class BalanceDiscreteVectorEnv(BalanceVectorEnv):
    """Balance `num_envs` pendulums with the paper's eight accelerations: `Discrete(8)` each.

    Everything but the action space is that of `BalanceVectorEnv`.
    """

    SINGLE: ClassVar[type[BalanceEnv]] = BalanceDiscreteEnv

    def _accelerations(self, actions: Any) -> Array:
        indices = np.asarray(actions)
        if not self.action_space.contains(indices):
            raise InputError(
                f"the actions are {actions!r:.60}; expected whole numbers from 0 to "
                f"{len(paper.ACTIONS) - 1}, shape {self.action_space.shape}"
            )
        return np.array(paper.ACTIONS)[indices]
