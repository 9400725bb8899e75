"""Trials of an evaluation in real time, one after another, for the console.

They run in a process of their own, with the random numbers of the evaluation: trial i on the screen
is trial i of the result.
"""

import multiprocessing
import os
import pickle
import signal
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from multiprocessing.process import BaseProcess
from typing import Final, NamedTuple

from equipoise.apps.console.publisher import Publisher, publishing
from equipoise.apps.console.server import stay_aside
from equipoise.control.grid import TRUNCATED
from equipoise.control.policy import TaskPolicy
from equipoise.errors import EquipoiseError
from equipoise.logs.shared import RunInfo
from equipoise.model.actuator import Actuator
from equipoise.model.arms.arm import Arm
from equipoise.model.elementary import BATCH_SIZE
from equipoise.model.random import TEST
from equipoise.outcomes import TRIAL_OUTCOMES, Phase
from equipoise.rig.run import STOP
from equipoise.settings import Settings
from equipoise.user_code import guest_code
from equipoise.worlds import ClosedLoop, run_trial, setup_of, simulate

PAUSE: Final = 1.5
"""Time between the end of a trial and the next one [s]."""
CATCH_UP: Final = 0.1
"""Delay behind real time above which a trial goes on later instead of faster [s]."""


class ShownTrials(NamedTuple):
    """Trials to show: the arguments of their evaluation."""

    policy: TaskPolicy
    settings: Settings
    world: str
    actuator: Actuator | None
    seed: int


class _EndError(Exception):
    """STOP in a browser, or the end of the evaluation's process."""


class _Pacer:
    """Observer of trials that keeps them in real time and publishes them."""

    def __init__(self, publisher: Publisher, arm: Arm, owner: int) -> None:
        self._publisher, self._arm, self._owner = publisher, arm, owner
        self._begin = 0.0

    def before(self, loop: ClosedLoop, tick: int, u: float) -> None:
        """Wait for the time of a tick, and publish the state there."""
        at, now = tick * loop.params.h, time.monotonic()
        if tick == 0 or now - self._begin - at > CATCH_UP:
            self._begin = now - at
        self.wait(self._begin + at - now)
        commanded = self._arm.with_held(loop.controller.q[::BATCH_SIZE])
        phi = float(loop.state()[2])
        self._publisher.show(at, loop.joints(), phi, commanded=commanded, u=u)

    def after(self, loop: ClosedLoop, tick: int) -> None:
        """Do nothing: each tick shows the state at its begin."""

    def wait(self, duration: float) -> None:
        """Wait [s].

        Raises:
            _EndError: STOP was pressed, or the evaluation's process has ended.
        """
        until = time.monotonic() + duration
        while True:
            if STOP in self._publisher.words() or os.getppid() != self._owner:
                raise _EndError
            left = until - time.monotonic()
            if left <= 0.0:
                return
            time.sleep(min(left, 0.05))


@contextmanager
def trials_process(shown: ShownTrials) -> Generator[BaseProcess]:
    """Show trials in a process of its own; it ends with the context, or by STOP in a browser.

    Yields:
        The process.

    Raises:
        InputError: The policy cannot be sent to the process.
    """
    with guest_code(f"sending {shown.policy.name} to another process", "leave --console out"):
        data = pickle.dumps(shown)
    context = multiprocessing.get_context("spawn")
    process = context.Process(target=_show_pickled, args=(data, os.getpid()), daemon=True)
    process.start()
    try:
        yield process
    finally:
        process.kill()
        process.join()


def _show_pickled(data: bytes, owner: int) -> None:
    """Run pickled trials until their end; the evaluation itself reports errors of the policy."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(_EndError, EquipoiseError):
        _show_trials(pickle.loads(data), owner)


def _show_trials(shown: ShownTrials, owner: int) -> None:
    """Run the trials in real time, one after another."""
    stay_aside()
    setup = setup_of(shown.policy, shown.world, shown.settings, shown.actuator)
    simulation = simulate(shown.world, setup, seed=shown.seed, stream=TEST)
    loop, span = simulation.loop(), shown.settings.evaluation.duration
    count = shown.settings.evaluation.trials
    info = RunInfo(
        title=f"{shown.policy.name} in {shown.world}"[:1024],
        pid=owner,
        arm=setup.arm,
        phases=(Phase.BALANCING,),
        duration=span,
    )
    with publishing(info) as publisher:
        pacer = _Pacer(publisher, setup.arm, owner)
        for number in range(count):
            trial = simulation.draw(1, number).trial(0)
            publisher.say(0.0, f"Trial {number} of {count}.")
            steps, cause, _ = run_trial(loop, shown.policy, trial, span, pacer)
            lasted = steps * loop.params.h
            how = "lasted" if cause == TRUNCATED else f"ended by {TRIAL_OUTCOMES[cause]} after"
            publisher.say(lasted, f"Trial {number} {how} {lasted:.2f} s.")
            pacer.wait(PAUSE)
