"""Interface of simulated worlds and of their closed loops, a tick at a time.

A `Simulation` is a world with the inputs of its trials: pendulum, arm, settings, actuator and
seed. It draws the conditions of trials, runs them for a compiled policy, and opens `ClosedLoop`s,
which Python drives tick by tick. Both ways run the same kernels with the same random numbers, keyed
by (seed, trial, tick): a trial has the same bits either way.
"""

import functools
import pickle
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from math import inf, nan
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np

from equipoise.arguments import Workers
from equipoise.arm.arm import Arm
from equipoise.arrays import Array, fields, first_lane
from equipoise.control.control_step import ControllerParams, ControllerState
from equipoise.control.policy import KernelPolicy, Policy, PolicyKernel, TaskPolicy, tick_policy
from equipoise.control.swing_up import SwingUpPolicy, compiled_for, make_swing_up, time_limit
from equipoise.errors import InputError, SettingsError
from equipoise.executors import completed
from equipoise.model.actuator import Actuator
from equipoise.model.grid import NOT_UPRIGHT, TRUNCATED
from equipoise.model.pendulum import Pendulum, PendulumParameters
from equipoise.model.worlds import TwinSettings, World
from equipoise.settings import HANGING, Settings
from equipoise.simulation.plant import BatchState, Trial, observed
from equipoise.simulation.trials import Trials, WorldKernels, draw_trials

Done = Callable[[float], None]
"""Callback; receives the number of trials that have just finished; from Python, parts of one."""
PROGRESS: Final = 100
"""Steps between two reports of progress: some seconds in a slow world."""


class Measurement(NamedTuple):
    """Newest measurements at a tick."""

    counts: float
    """Encoder counts from hanging, growing with theta."""
    counted_at: float
    """Their time stamp, from the release [s]."""
    q: Array
    """Measured free joints [rad], shape (6,)."""
    measured_at: float
    """Their time stamp, from the release [s]."""


class ClosedLoop(ABC):
    """A closed loop in simulation; its attributes are for reading."""

    params: ControllerParams
    """Constants of the controller, the time between ticks among them."""
    controller: ControllerState
    """State of the controller, in the first lane."""
    pendulum: PendulumParameters
    """True parameters of the pendulum in this trial."""
    zero: float | None = None
    """Encoder zero offset in phi in this trial [rad]; `None` without an encoder."""
    now: float = 0.0
    """Time since the release [s]."""
    tracked: float = 0.0
    """Tracked acceleration u' over the last step [m/s^2]."""

    @property
    def balancing(self) -> bool:
        """Whether the policy balances, and the failure angle applies; not in a swing-up."""
        return bool(self.controller.balancing[0])

    @balancing.setter
    def balancing(self, value: bool) -> None:
        self.controller.balancing[0] = value

    @abstractmethod
    def reset(self, trial: Trial) -> None:
        """Release the pendulum under the conditions of a trial."""

    @abstractmethod
    def step(self, u: float) -> int:
        """Advance by one tick, and return the cause of the failure, `TRUNCATED` without one.

        Args:
            u: Acceleration of the flange along x [m/s^2].
        """

    @abstractmethod
    def state(self) -> Array:
        """Return the true x, x_dot, phi, phi_dot in SI units, shape (4,)."""

    @abstractmethod
    def joints(self) -> Array:
        """Return the true positions of all joints [rad], shape (n,)."""

    def measurement(self) -> Measurement | None:
        """Return the newest measurements, those of this tick; `None` without an encoder."""
        if not self.params.has_sensor:
            return None
        q = self.controller.measured[:, 0].copy()
        return Measurement(float(self.controller.counts[0]), self.now, q, self.now)


class CompiledLoop(ClosedLoop):
    """Closed loop in the first lane of a world of compiled trials."""

    KERNELS: ClassVar[WorldKernels]
    """Functions of the world."""

    def __init__(self, simulation: "Simulation", params: ControllerParams, world: Any) -> None:
        """Begin with a world, whose `states` hold a `BatchState`."""
        self.simulation, self.params, self._world = simulation, params, world
        self._batch = fields(world.states, BatchState)
        self.controller = self._batch.controller
        self._seed, self._tick, self._number = np.zeros((3, 1), np.int64)

    @abstractmethod
    def prepare(self, trial: Trial) -> Any:
        """Return the world with the pendulum of a trial, before its release."""

    def reset(self, trial: Trial) -> None:
        """Release the pendulum under the conditions of a trial."""
        self._seed[0], self._tick[0], self._number[0] = self.simulation.seed, 0, trial.number
        self._world = self.prepare(trial)
        self.KERNELS.place_alone(self._world, trial, 0)
        self.now, self.tracked = 0.0, 0.0

    def step(self, u: float) -> int:
        """Advance by one tick with u [m/s^2], and return the cause of the failure."""
        self.controller.u[0] = u
        self.KERNELS.advance_alone(self._world, self._seed, self._tick, self._number, 1)
        self._tick += 1
        self.now, self.tracked = float(self._batch.time[0]), float(self._batch.u_tracked[0])
        return int(self._batch.cause[0])

    def state(self) -> Array:
        """Return the true x, x_dot, phi, phi_dot in SI units, shape (4,)."""
        return np.array(observed(self._batch.state, 0))


class Setup(NamedTuple):
    """Pendulum, arm and controller of trials."""

    pendulum: Pendulum
    """The pendulum, which trials vary."""
    arm: Arm
    """The arm with its home posture."""
    settings: Settings
    """Ranges of the trials' conditions, noise of the plant, the controller."""
    actuator: Actuator
    """The controller's model of the arm's response."""
    h: float
    """Time between ticks [s]."""


class Simulation(ABC):
    """A simulated world with the inputs of its trials.

    The entry point group `equipoise.worlds` maps the scheme of a world's name to its class.
    """

    ideal_arm: ClassVar[bool] = False
    """Whether the arm has no delay, and the state of arm and pendulum is known exactly."""
    BATCH: ClassVar[int] = 1
    """Number of trials that advance together."""
    PIECE: ClassVar[int] = 0
    """Maximum number of compiled trials that a thread takes at a time, a multiple of `BATCH`; 0 for
    a world whose trials run from Python. The loop of others is a `CompiledLoop`."""

    def __init__(self, world: str | World, setup: Setup, *, seed: int, stream: int) -> None:
        """Set up a world; a subclass may raise `SettingsError` for a name.

        Args:
            world: Name of the world, or a twin with its numbers.
            setup: Pendulum, arm and controller.
            seed: Master seed of the trials.
            stream: Purpose of the trials: each has random numbers of its own.
        """
        self.world, self.setup, self.seed, self.stream = world, setup, seed, stream
        self.name = world.name if isinstance(world, World) else world
        """Name of the world in results."""
        self.twin: TwinSettings | None = None
        """Numbers of the digital twin; None without one."""
        linearised = setup.settings.plant.linearised
        self.pendulum = setup.pendulum.parameters(linearised=linearised)
        """Nominal parameters, which the trials vary."""
        self.max_speed = setup.settings.plant.max_speed or inf
        """Limit of the flange's speed [m/s]; inf without a limit."""
        self._idle: list[Any] = []

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the inputs; a process sets up the simulation once, for all tasks."""
        inputs = type(self), self.world, self.setup, self.seed, self.stream
        return _set_up, (pickle.dumps(inputs),)

    @abstractmethod
    def loop(self) -> ClosedLoop:
        """Return a closed loop for `reset`."""

    def draw(self, count: int, first: int = 0) -> Trials:
        """Draw the conditions of `count` trials from number `first` on."""
        return draw_trials(count, self.setup.settings, self.seed, self.stream, first)

    def run_piece(self, policy: PolicyKernel, duration: float, trials: Trials) -> Trials:
        """Run trials of a compiled policy in this thread, and return them with their results."""
        try:
            loop: Any = self._idle.pop()  # of a thread that has finished
        except IndexError:
            loop = self.loop()
        for part in trials.parts(self.PIECE):
            world = loop.prepare(part.trial(0))
            if self._swings_up(policy):
                world = world._replace(swing_up=compiled_for(world.swing_up, policy))
            loop.KERNELS.run_trials(world, policy, part, round(duration / self.setup.h))
        self._idle.append(loop)
        return trials

    def run(
        self,
        policy: TaskPolicy | KernelPolicy,
        trials: Trials,
        *,
        duration: float,
        workers: Workers = 1,
        done: Done = lambda _: None,
    ) -> None:
        """Run trials: compiled if policy and world are, otherwise from Python, one by one.

        Args:
            policy: The policy.
            trials: Conditions, from `draw`; receives the results.
            duration: Length of a trial [s].
            workers: Number of threads for compiled trials, or an executor for them; the results do
                not depend on it.
            done: Called with the number of trials that have just finished.

        Raises:
            InputError: No swing-up can be, or end with the policy; or an executor is given for
                trials that run from Python.
        """
        self._swings_up(policy.kernel)
        kernel, count = policy.kernel, len(trials.number)
        if kernel is None or not self.PIECE:
            if not isinstance(workers, int):
                raise InputError(
                    "only compiled trials run on a cluster; policies and worlds in Python run "
                    "here, one trial after the other; leave out --workers"
                )
            loop = self.loop()
            acting = self.acting(policy, loop)
            for row in range(count):
                end = run_trial(loop, acting, trials.trial(row), duration, done=done)
                trials.steps[row], trials.cause[row], trials.sum_x2[row] = end[:3]
                trials.upright[row], trials.end[row] = end.upright, loop.state()
            return
        if isinstance(workers, int):
            fraction = -(-count // (self.BATCH * workers)) * self.BATCH
            size = min(self.PIECE, max(fraction, 1))
        else:  # at most 1000 tasks: each costs some milliseconds and a step of the progress
            size = max(self.PIECE, -(-count // (self.BATCH * 1000)) * self.BATCH)
        parts = trials.parts(size)
        for i, ended in completed(partial(self.run_piece, kernel, duration), parts, workers):
            for column, result in zip(parts[i], ended, strict=True):
                column[:] = result
            done(len(ended.number))

    def acting(self, policy: TaskPolicy | KernelPolicy, loop: ClosedLoop) -> Policy:
        """Return a policy for `run_trial`, after a swing-up where trials begin hanging.

        Args:
            policy: The policy.
            loop: The closed loop in which it acts.

        Raises:
            InputError: A swing-up cannot end with this policy.
            SettingsError: The pendulum is linearised.
        """
        if self._swings_up(policy.kernel) and policy.kernel is not None:
            return SwingUpPolicy(policy.kernel, make_swing_up(loop.params, self.max_speed))
        return tick_policy(policy)

    def _swings_up(self, policy: PolicyKernel | None) -> bool:
        """Return whether trials begin hanging; refuse a swing-up that cannot be, or cannot end."""
        hanging = self.setup.settings.evaluation.start == HANGING
        if hanging and policy is None:
            raise InputError(
                "no swing-up can end with a policy in Python: it simulates the policy in each "
                "tick, expected a table, lqr or lqr-snapped; take one of those, or start by hand"
            )
        if hanging and self.setup.settings.plant.linearised:
            raise SettingsError(
                "plant.linearised is true, and a linearised pendulum does not hang; start by hand"
            )
        return hanging


@functools.lru_cache(maxsize=8)
def _set_up(inputs: bytes) -> Simulation:
    """Set up a pickled simulation."""
    kind, world, setup, seed, stream = pickle.loads(inputs)
    return kind(world, setup, seed=seed, stream=stream)


def predicted(loop: ClosedLoop) -> Array:
    """Return x, x_dot, phi, phi_dot at which u takes effect: the observation, shape (4,)."""
    return first_lane(loop.controller.observation)


class TrialEnd(NamedTuple):
    """End of a trial."""

    steps: int
    """Number of steps of the policy."""
    cause: int
    """Cause of the end."""
    sum_x2: float
    """Sum of x^2 over these steps [m^2]."""
    upright: int
    """Number of steps of the swing-up before."""


def run_trial(
    loop: ClosedLoop,
    policy: Policy,
    trial: Trial,
    duration: float,
    record: "TrialRecorder | None" = None,
    done: Done = lambda _: None,
) -> TrialEnd:
    """Run one trial of a policy from Python.

    Args:
        loop: The closed loop.
        policy: The policy, one of `Simulation.acting`.
        trial: Conditions.
        duration: Length of the trial [s], a swing-up not included.
        record: Recorder of each tick; an exception from it ends the trial.
        done: Called with the fraction of the trial that has passed since its last call.
    """
    steps, cause, sum_x2, upright = 0, TRUNCATED, 0.0, 0
    h = loop.params.h
    max_steps, swing_steps = round(duration / h), round(time_limit(loop.params.pendulum) / h)
    loop.reset(trial)
    policy.reset()
    while steps < max_steps and cause == TRUNCATED:
        u = float(policy.act(predicted(loop)))
        if isinstance(policy, SwingUpPolicy):
            loop.balancing = policy.balancing
        if record is not None:
            record.before(loop, u)
        cause = loop.step(u)
        if record is not None:
            record.after(loop)
        if not loop.balancing:
            upright += 1
            if cause == TRUNCATED and upright >= swing_steps:
                cause = NOT_UPRIGHT
            continue
        steps += 1
        sum_x2 += float(loop.state()[0]) ** 2
        if steps % PROGRESS == 0:
            done(PROGRESS * h / duration)
    done(1.0 - (steps - steps % PROGRESS) * h / duration)
    return TrialEnd(steps, cause, sum_x2, upright)


class TrialRecord(NamedTuple):
    """One recorded trial, a row for each tick."""

    observation: Array
    """x, x_dot, phi, phi_dot as the policy observed them, shape (n, 4)."""
    u: Array
    """Commanded acceleration [m/s^2], shape (n,)."""
    estimate: Array
    """`StateEstimate` at the tick, shape (n, 5)."""
    state: Array
    """True x, x_dot, phi, phi_dot at the tick, shape (n, 4)."""
    joints: Array
    """True positions of all joints at the tick [rad], shape (n, joints)."""
    encoder: Array
    """Encoder counts and their time stamp [s], NaN without an encoder, shape (n, 2)."""
    measured: Array
    """Measured free joints [rad] and their time stamp [s], NaN without, shape (n, 7)."""
    setpoints: Array
    """Free joints sent at the tick and h / 2 later [rad], shape (n, 12)."""
    q: Array
    """Commanded free joints at the end of the tick [rad], shape (n, 6)."""
    dq: Array
    """Their velocities [rad/s], shape (n, 6)."""
    tracked: Array
    """Tracked acceleration u' over the tick [m/s^2], shape (n,)."""


class TrialRecorder:
    """Recorder of a `TrialRecord`."""

    def __init__(self) -> None:
        """Start without ticks."""
        self._before: tuple[Any, ...] = ()
        self._rows: list[tuple[Any, ...]] = []

    def before(self, loop: ClosedLoop, u: float) -> None:
        """Record the state and the measurements at a tick, and the u that the policy commands."""
        state, measured = loop.state(), loop.measurement()
        x, x_dot, *pendulum = state
        estimate = np.array((*pendulum, 0.0, x_dot, x))
        encoder, joints = (nan, nan), np.full(7, nan)
        if measured is not None:
            estimate = first_lane(loop.controller.estimate)
            encoder = measured.counts, measured.counted_at
            joints = np.append(measured.q, measured.measured_at)
        self._before = predicted(loop), u, estimate, state, loop.joints(), encoder, joints

    def after(self, loop: ClosedLoop) -> None:
        """Record the commands and the tracked acceleration of a tick."""
        c = loop.controller
        commands = (rows[..., 0].ravel() for rows in (c.setpoints, c.q, c.dq))
        self._rows.append((*self._before, *commands, loop.tracked))

    @property
    def rows(self) -> TrialRecord:
        """Record up to the latest tick; at least one tick has passed."""
        return TrialRecord(*map(np.array, zip(*self._rows, strict=True)))
