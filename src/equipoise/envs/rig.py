"""An episode on a rig: a run in a thread of its own, whose policy asks the environment for u.

The run is that of `equipoise deploy`: pre-flight, checklist, way home, self-test, release, and the
state machine with its guards. Two queues of one entry hand over observation and u, so that either
the run or the environment waits: in virtual time an episode is deterministic.
"""

from pathlib import Path
from queue import Queue
from threading import Thread
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.control.bound_policy import BoundPolicy
from equipoise.deployment.rig import LASTED, STOP, RunRequest, RunResult, run_virtually
from equipoise.errors import EquipoiseError, InputError, OutsideError
from equipoise.rigs import RigSettings, check_addresses, is_virtual
from equipoise.simulation import Setup

Array = npt.NDArray[np.float64]

NAME: Final = "environment"
"""Name of the policy in logs and messages."""


class End(NamedTuple):
    """End of an episode."""

    cause: str
    """Cause in a word or two, as in the log of a run."""
    reason: str
    """The same in a sentence."""
    failed: bool
    """Whether anything but the time limit ended the episode."""


class _Handover:
    """The policy of the run and its second operator: both speak for the environment."""

    def __init__(self) -> None:
        self.observations: Queue[Array | RunResult | BaseException] = Queue(1)
        self.actions: Queue[float] = Queue(1)
        self.closing = False

    def reset(self) -> None:
        """Do nothing: the environment begins with the first observation."""

    def act(self, observation: Array) -> float:
        """Hand over the observation, and wait for u [m/s^2]."""
        self.observations.put(observation)
        return self.actions.get()

    def notify(self, event: Any) -> None:
        """Ignore a message: the emulated operator answers."""

    def read_input(self) -> list[str]:
        """Return the word that stops the run, once the environment is closed."""
        return [STOP] if self.closing else []


class RigEpisode:
    """One episode on a rig after the other."""

    def __init__(
        self,
        setup: Setup,
        settings: RigSettings,
        robot: str,
        encoder: str | None,
        duration: float,
        log: Path | None,
    ) -> None:
        """Name a rig; nothing is connected before `begin`.

        Args:
            setup: The task; its arm is that of the rig.
            settings: Content of `rig.toml`.
            robot: Address of the robot.
            encoder: Address of the encoder; none where the robot has its own.
            duration: Length of an episode [s].
            log: File of the log; each episode replaces it.

        Raises:
            InputError: An address is none of an emulated rig.
        """
        check_addresses(robot, encoder)
        if not is_virtual(robot):
            raise InputError(
                f"the environment runs on an emulated rig only, got {robot}; give "
                "robot='twin:nominal', or run the trained policy with equipoise deploy"
            )
        self._setup, self._settings, self._robot = setup, settings, robot
        self._encoder, self._duration, self._log = encoder, duration, log
        self._thread: Thread | None = None

    def begin(self, seed: int) -> Array:
        """Run the course until the release, and return the first observation.

        Raises:
            EquipoiseError: The run ended before the release.
        """
        self.end()
        pendulum, arm, settings, actuator, h = self._setup
        self._between = handover = _Handover()
        policy = BoundPolicy(handover, NAME, NAME, None, pendulum, arm, actuator, settings, h)
        request = RunRequest(
            policy=policy,
            actuator=actuator,
            settings=self._settings,
            robot=self._robot,
            encoder=self._encoder,
            duration=self._duration,
            t1=False,
            dry_run=False,
            seed=seed,
        )

        def run() -> None:
            try:
                result = run_virtually(request, self._log, handover, replace=True)
            except BaseException as error:  # the environment raises it
                handover.observations.put(error)
            else:
                handover.observations.put(result)

        self._thread = Thread(target=run, name="equipoise rig", daemon=True)
        self._thread.start()
        first = self._next()
        if isinstance(first, End):
            raise OutsideError(f"the run ended before the release: {first.reason}")
        return first

    def step(self, u: float) -> Array | End:
        """Command u [m/s^2] for one tick; return the next observation, or how the run ended."""
        self._between.actions.put(u)
        return self._next()

    def end(self) -> End | None:
        """Stop the run, and return once the arm is at rest."""
        if self._thread is None:
            return None
        self._between.closing = True
        while not isinstance(last := self.step(0.0), End):
            pass
        return last

    def _next(self) -> Array | End:
        got = self._between.observations.get()
        if isinstance(got, np.ndarray):
            return got
        if self._thread is not None:
            self._thread.join()
        self._thread = None
        if isinstance(got, EquipoiseError):
            raise got
        if isinstance(got, BaseException):
            raise OutsideError(f"the run failed ({type(got).__name__}: {got})") from got
        return End(got.cause, got.reason, got.cause != LASTED)
