"""Episodes on a rig: a run in a separate thread, whose policy receives u from the environment.

The run is that of `equipoise deploy`: pre-flight, checklist, way home, self-test, release, and the
state machine with its safety rules. Two queues exchange observation and u, so that either the run
or the environment waits: in virtual time an episode is deterministic. On a robot the loop runs in a
separate process, and a pipe extends the two queues to it.
"""

import multiprocessing
import select
import sys
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from queue import Queue
from threading import Thread
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.control.bound_policy import BoundPolicy
from equipoise.control.ticks import OperatorMessage
from equipoise.deployment.processes import run_in_processes
from equipoise.deployment.rig import (
    LASTED,
    STOP,
    RunRequest,
    check_request,
    run_virtually,
)
from equipoise.devices.operator import Operator
from equipoise.errors import EquipoiseError, InputError, OutsideError
from equipoise.logs.conditions import RunEnd
from equipoise.printable import printable
from equipoise.rigs import RigSettings, check_addresses, is_virtual
from equipoise.simulation import Setup

Array = npt.NDArray[np.float64]

NAME: Final = "environment"
"""Name of the policy in logs and messages."""


class End(NamedTuple):
    """End of an episode."""

    cause: str
    """Cause, as in the log of a run."""
    reason: str
    """Message with the cause."""
    failed: bool
    """Whether anything but the time limit ended the episode."""


class TerminalLines:
    """Operator at the terminal of a program: messages are printed, answers typed as lines."""

    def notify(self, event: OperatorMessage) -> None:
        """Print a message."""
        sys.stdout.write(printable(event.text.replace("\t", "  ").replace("\a", "")) + "\n")
        sys.stdout.flush()

    def read_input(self) -> list[str]:
        """Return the lines typed since the last call; a stop after the end of the input."""
        lines: list[str] = []
        while select.select([sys.stdin], [], [], 0.0)[0]:
            if not (line := sys.stdin.readline()):
                return [*lines, STOP]
            lines.append(line.strip())
        return lines


class _Handover:
    """Policy of a run and its second operator, both on behalf of the environment."""

    def __init__(self, operator: Operator | None) -> None:
        self.observations: Queue[Array | RunEnd | BaseException] = Queue(2)
        self.actions: Queue[float] = Queue(1)
        self.closing = False
        self._operator = operator

    def reset(self) -> None:
        """Do nothing: the episode starts with the first observation."""

    def act(self, observation: Array) -> float:
        """Hand over the observation, and wait for u [m/s^2]."""
        self.observations.put(observation)
        return self.actions.get()

    def serve(self, pipe: Connection) -> None:
        """Answer a `_RemotePolicy` until its process has ended."""
        with suppress(EOFError, OSError):
            while True:
                released, observation = pipe.recv()
                pipe.send(self.act(observation) if released else 0.0)

    def notify(self, event: OperatorMessage) -> None:
        """Send a message to the operator."""
        if self._operator is not None:
            self._operator.notify(event)

    def read_input(self) -> list[str]:
        """Return the operator's lines, and a stop once the environment is closed."""
        lines = [] if self._operator is None else self._operator.read_input()
        return [*lines, STOP] if self.closing else lines

    def live(self, phase: str, phi: float) -> None:
        """Show nothing: the program has the observations."""


class _RemotePolicy:
    """Policy in the loop's process that asks the environment's process for u."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe, self._resets = pipe, 0

    def reset(self) -> None:
        """Count the resets: the first is that of the warm-up, the second that of the release."""
        self._resets += 1

    def act(self, observation: Array) -> float:
        """Return the environment's u [m/s^2]; 0 in the warm-up."""
        self._pipe.send((self._resets > 1, observation))
        return float(self._pipe.recv())


class RigEpisode:
    """Successive episodes on a rig."""

    def __init__(
        self,
        setup: Setup,
        settings: RigSettings,
        robot: str,
        encoder: str | None,
        duration: float,
        log: Path | None,
        operator: Operator | None,
    ) -> None:
        """Set up the rig; `begin` connects it.

        Args:
            setup: The task; its arm is that of the rig.
            settings: Content of `rig.toml`.
            robot: Address of the robot.
            encoder: Address of the encoder; None where the robot has its own.
            duration: Length of an episode [s].
            log: Log of the first episode; the next are FILE-2, FILE-3 and so on.
            operator: Operator besides the emulated one; on a robot by default `TerminalLines`.

        Raises:
            InputError: An address is invalid, or a robot has no log.
        """
        check_addresses(robot, encoder)
        if not is_virtual(robot) and log is None:
            raise InputError("a run on a robot is logged; give log='run.mcap'")
        self._operator = operator if operator or is_virtual(robot) else TerminalLines()
        self._episodes = 0
        self._setup, self._settings, self._robot = setup, settings, robot
        self._encoder, self._duration, self._log = encoder, duration, log
        self._thread: Thread | None = None

    def begin(self, seed: int) -> Array:
        """Run until the release, and return the first observation.

        Raises:
            EquipoiseError: The run ended before the release.
        """
        self.end()
        pendulum, arm, settings, actuators, h = self._setup
        self._between = handover = _Handover(self._operator)
        virtual, out = is_virtual(self._robot), self._log
        self._episodes += 1
        if out is not None and self._episodes > 1:
            out = out.with_stem(f"{out.stem}-{self._episodes}")
        if out is not None and out.exists():
            raise InputError(f"{out} exists; move it, or give another log=")
        ours, theirs = multiprocessing.Pipe()
        chosen = handover if virtual else _RemotePolicy(theirs)
        request = RunRequest(
            policy=BoundPolicy(chosen, NAME, NAME, None, pendulum, arm, actuators, settings, h),
            actuator=self._setup.actuator,
            settings=self._settings,
            robot=self._robot,
            encoder=self._encoder,
            duration=self._duration,
            t1=False,
            dry_run=False,
            seed=seed,
        )
        check_request(request)

        def run() -> None:
            result: RunEnd | BaseException
            try:
                if virtual or out is None:
                    result = run_virtually(request, out, handover)
                else:
                    Thread(target=handover.serve, args=(ours,), daemon=True).start()
                    result = run_in_processes(request, out, handover)
            except BaseException as error:  # the environment raises it
                result = error
            theirs.close()
            handover.observations.put(result)

        self._thread = Thread(target=run, name="equipoise rig", daemon=True)
        self._thread.start()
        first = self._next()
        if isinstance(first, End):
            raise OutsideError(f"the run ended before the release: {first.reason}")
        return first

    def step(self, u: float) -> Array | End:
        """Command u [m/s^2] for one tick; return the next observation, or the end of the run."""
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
        return End(got.cause or "fault", got.reason, got.cause != LASTED)
