"""Evaluate: how long a policy stands, with what confidence, and why it falls.

Trials start as a release leaves them and run on plants that vary around the pendulum the policy
was trained for: on the training plant (world `model`), or on the digital twin (`twin:...`), through
the controller and the actuator of the policy. Test seeds are used nowhere else, trial i is the same
for every policy, and the yardsticks run the same trials.
"""

import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.stats import binomtest

from equipoise import paper
from equipoise.artefacts import (
    Artefact,
    Count,
    Name,
    PartialFile,
    Seed,
    StrPath,
    Value,
    value_digest,
)
from equipoise.control.baselines import baselines
from equipoise.control.boxes import CAUSES, cause_named
from equipoise.control.control_step import make_controller_params
from equipoise.control.policy import Policy, PolicyKernel, TabularPolicy
from equipoise.control.trial_safety import guard_named, trial_safety
from equipoise.learning.closed_loop import LoopParams, make_loop_params, scaled
from equipoise.learning.trials import (
    Trials,
    draw_trials,
    record_trial,
    run_over_cores,
    twin_settings,
)
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import Pendulum, PendulumParameters
from equipoise.model.random import TEST
from equipoise.model.sim_configs import (
    MODEL,
    PivotFriction,
    TwinSettings,
    World,
    pivot_friction,
    read_world,
)
from equipoise.settings import LONGEST_TRIAL, MOST_TRIALS, Settings
from equipoise.views import Viewable

if TYPE_CHECKING:
    from equipoise.devices.twin.trial import Trial

CONFIDENCE = 0.95

BATCH_TRIALS = 10_000
"""Number of trials on a twin that wait for a thread at a time; it bounds their memory."""

Done = Callable[[int], None]
"""Called with the number of trials that have just finished."""


Survival = Annotated[float, Field(ge=0.0, le=LONGEST_TRIAL)]
"""Time that a trial lasted [s]."""


class Summary(NamedTuple):
    """What the trials of one policy come to; derived, never stored."""

    trials: int
    survived: int
    rate: float
    """Share of the trials that lasted."""
    interval: tuple[float, float]
    """Exact (Clopper-Pearson) 95 % interval of the probability to last."""
    median: float
    """Median survival [s]."""
    quantiles: tuple[float, float, float, float]
    """Survival at 5, 25, 75 and 95 % of the trials [s]."""
    causes: dict[str, int]
    """How many trials ended in which way."""


class TrialResults(Value):
    """The trials of one policy, in their order."""

    name: Name
    """Whose trials these are."""
    survival: Annotated[tuple[Survival, ...], Field(min_length=1, max_length=MOST_TRIALS)]
    """How long each trial lasted [s]."""
    causes: Annotated[tuple[Name, ...], Field(max_length=MOST_TRIALS)]
    """How each ended: lasted, angle, track, joint limit, guard."""
    guards: Annotated[tuple[Name, ...], Field(max_length=MOST_TRIALS)] = ()
    """Which guard ended each, empty where none did; no entries where no guard ended any."""

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        trials = len(self.survival)
        if len(self.causes) != trials or len(self.guards) not in (0, trials):
            raise ValueError(f"{trials} trials need as many causes, and guards if there are any")
        return self

    def summary(self) -> Summary:
        """Return share, interval, quantiles and causes."""
        trials, survived = len(self.survival), self.causes.count(CAUSES[0])
        interval = binomtest(survived, trials).proportion_ci(CONFIDENCE, method="exact")
        q05, q25, q50, q75, q95 = np.quantile(self.survival, [0.05, 0.25, 0.5, 0.75, 0.95])
        return Summary(
            trials=trials,
            survived=survived,
            rate=survived / trials,
            interval=(float(interval.low), float(interval.high)),
            median=float(q50),
            quantiles=(float(q05), float(q25), float(q75), float(q95)),
            causes=dict(Counter(self.causes)),
        )


class Evaluation(Viewable, Artefact):
    """All trials of a policy and of the yardsticks beside it."""

    FORMAT: ClassVar[str] = "equipoise-evaluation"
    VERSION: ClassVar[int] = 3

    policy: Name
    """Digest of the policy, or the name of the function that was evaluated."""
    world: Name
    """Where the trials ran."""
    world_settings: TwinSettings | None
    """The numbers of the twin; none on the training plant."""
    arm: Name
    """Name of the arm."""
    arm_digest: Name
    """Digest of the arm."""
    actuator: Name
    """Digest of the actuator that the controller knows."""
    pendulum: Name
    """Digest of the pendulum that the trials vary."""
    friction: PivotFriction | None = None
    """Dry friction and drag of that pendulum in the twin; none on the training plant, where they
    are the pendulum's own."""
    settings: Settings
    """Resolved settings: starts, noise, number and length of the trials."""
    seed: Seed
    """Master seed; with a trial's number it decides its conditions and its noise."""
    results: TrialResults
    """Trials of the policy."""
    baselines: Annotated[tuple[TrialResults, ...], Field(max_length=16)]
    """Trials of the yardsticks, on the same conditions."""

    def __repr__(self) -> str:
        """Return one line: how many trials lasted, where and how long."""
        found = self.results.summary()
        low, high = found.interval
        return (
            f"<Evaluation of {self.results.name!r} in {self.world!r}: {found.survived} of "
            f"{found.trials} trials lasted {self.duration:g} s (95 %: {low:.3f} to {high:.3f}), "
            f"median {found.median:.3g} s>"
        )

    __str__ = __repr__

    @property
    def duration(self) -> float:
        """Length of a trial [s]."""
        return self.settings.evaluation.duration


def evaluate(
    policy: TabularPolicy,
    settings: Settings | None = None,
    *,
    world: str | World = MODEL,
    actuator: Actuator | None = None,
    seed: int = 0,
    with_yardsticks: bool = True,
    workers: int = 1,
    partial: StrPath | None = None,
    done: Done = lambda _: None,
) -> Evaluation:
    """Evaluate a trained policy, on the plant that it was trained for or on a digital twin.

    Args:
        policy: The policy.
        settings: Number, length and starts of the trials, noise of the plant, the controller; the
            policy's own settings if not given.
        world: `model`, a name that `read_world` knows, or a twin with its numbers.
        actuator: What the controller knows of the arm's response; that of the training if not
            given.
        seed: Master seed of the trials.
        with_yardsticks: Run the yardsticks on the same trials.
        workers: Number of threads; the result does not depend on it.
        partial: File that keeps the finished trials on a twin until all are done: an interrupted
            evaluation goes on where it stopped.
        done: Called with the number of trials that have just finished.

    Raises:
        SettingsError: There is no such world.
        ArmError: The twin does not know the masses of the arm.
    """
    settings = policy.settings if settings is None else settings
    bench = TrialRunner(
        policy.pendulum,
        policy.arm,
        settings,
        actuator or policy.actuator,
        policy.h,
        world,
        seed,
        workers,
        None if partial is None else Path(partial),
        done,
    )
    results = bench.run("policy", policy.kernel, policy.digest)
    return bench.evaluation(policy.digest, results, with_yardsticks)


def evaluate_function(
    policy: Policy,
    name: str,
    pendulum: Pendulum,
    arm: Arm,
    settings: Settings,
    *,
    seed: int = 0,
    with_yardsticks: bool = True,
    workers: int = 1,
    done: Done = lambda _: None,
) -> Evaluation:
    """Evaluate any object with `act(state) -> u`, on the plant of the paper's simulation.

    The policy runs in Python, so this takes a second per trial or so.

    Args:
        policy: What decides.
        name: What to call it.
        pendulum: The pendulum that the trials vary.
        arm: The arm.
        settings: Number, length and starts of the trials, noise of the plant.
        seed: Master seed of the trials.
        with_yardsticks: Run the yardsticks on the same trials.
        workers: Number of threads for the yardsticks.
        done: Called with the number of trials that have just finished.
    """
    bench = TrialRunner(
        pendulum, arm, settings, IDEAL_ACTUATOR, paper.STEP, MODEL, seed, workers, None, done
    )
    return bench.evaluation(name, bench.run_in_python(name, policy), with_yardsticks)


def twin_trials(
    settings: Settings,
    world: TwinSettings,
    pendulum: Pendulum,
    seed: int,
    stream: int,
    numbers: Iterable[int],
) -> "Iterator[Trial]":
    """Yield the conditions of the trials on a twin: starts and pendulums.

    Args:
        settings: Number and starts of the trials.
        world: How far the pendulum of a trial differs from the nominal one, and its frictions.
        pendulum: The nominal one.
        seed: Master seed.
        stream: Purpose of the trials.
        numbers: Numbers of the trials, counted from zero.
    """
    from equipoise.devices.twin.trial import Trial

    there = twin_settings(settings, world)
    drawn = draw_trials(settings.evaluation.trials, there, seed, stream, spread=1.0)
    nominal = pendulum.parameters(linearised=settings.plant.linearised)
    friction = pivot_friction(pendulum, world)
    for i in numbers:
        yield Trial(
            number=i,
            pendulum=friction.on(
                PendulumParameters(
                    *scaled(nominal, drawn.inertia_factor[i], drawn.friction_factor[i])
                )
            ),
            phi=float(drawn.start[i, 2]),
            phi_dot=float(drawn.start[i, 3]),
        )


class TrialRunner:
    """The trials of one evaluation, on which any number of policies run."""

    def __init__(
        self,
        pendulum: Pendulum,
        arm: Arm,
        settings: Settings,
        actuator: Actuator,
        h: float,
        world: str | World,
        seed: int,
        workers: int,
        partial: Path | None,
        done: Done,
    ) -> None:
        self._pendulum, self._arm, self._settings = pendulum, arm, settings
        self._actuator, self._h, self._seed = actuator, h, seed
        self._workers, self._partial, self._done = workers, partial, done
        self._parameters = pendulum.parameters(linearised=settings.plant.linearised)
        self._twin = None
        if isinstance(world, World):
            self._twin = world
        elif world != MODEL:
            self._twin = read_world(world)

    def run(self, name: str, kernel: PolicyKernel, digest: str = "") -> TrialResults:
        """Run all trials of a policy for compiled loops."""
        if self._twin is not None:
            return self._run_on_twin(self._twin.settings, name, kernel, digest)
        trials = self._trials()
        run_over_cores(
            self._plant(),
            kernel,
            self._parameters,
            trials,
            duration=self._settings.evaluation.duration,
            seed=self._seed,
            stream=TEST,
            workers=self._workers,
            done=self._done,
        )
        return self._results(name, trials)

    def run_in_python(self, name: str, policy: Policy) -> TrialResults:
        """Run all trials of a policy written in Python."""
        trials, plant = self._trials(), self._plant()
        longest = round(self._settings.evaluation.duration / self._h)
        for i in range(len(trials.steps)):
            trials.cause[i], rows = record_trial(
                plant, policy, self._parameters, trials, i, longest, self._seed, TEST
            )
            trials.steps[i] = len(rows.u)
            self._done(1)
        return self._results(name, trials)

    def evaluation(self, policy: str, results: TrialResults, with_yardsticks: bool) -> Evaluation:
        """Return the evaluation, the yardsticks run if asked for."""
        beside = baselines(self._parameters, self._h) if with_yardsticks else {}
        evaluation = Evaluation(
            policy=policy,
            world=MODEL if self._twin is None else self._twin.name,
            world_settings=None if self._twin is None else self._twin.settings,
            arm=self._arm.name,
            arm_digest=self._arm.digest,
            actuator=self._actuator.digest,
            pendulum=self._pendulum.digest,
            friction=self._friction(),
            settings=self._settings,
            seed=self._seed,
            results=results,
            baselines=tuple(self.run(name, kernel) for name, kernel in beside.items()),
        )
        if self._partial is not None:
            self._partial.unlink(missing_ok=True)
        return evaluation

    def _run_on_twin(
        self, settings: TwinSettings, name: str, kernel: PolicyKernel, digest: str
    ) -> TrialResults:
        from equipoise.devices.twin.trial import Trial, TrialResult, run_over_cores

        e, results = self._settings.evaluation, self._trials()
        kept = _Kept(self._partial, self._key(settings, name, digest))
        todo = kept.restore(results)
        self._done(e.trials - len(todo))

        def one_done(trial: Trial, outcome: TrialResult) -> None:
            i = trial.number
            results.steps[i], results.cause[i] = outcome.steps, outcome.cause
            kept.add(i, outcome.steps, outcome.cause)
            self._done(1)

        controller = make_controller_params(
            self._arm,
            self._settings,
            self._actuator,
            self._parameters,
            h=self._h,
            counts_per_rev=settings.counts_per_rev,
        )
        guard = trial_safety(
            self._arm, settings, self._actuator, kernel, self._h, self._settings.plant.max_speed
        )
        conditions = twin_trials(self._settings, settings, self._pendulum, self._seed, TEST, todo)
        with kept:
            while batch := list(islice(conditions, BATCH_TRIALS)):
                run_over_cores(
                    self._arm,
                    settings,
                    controller,
                    kernel,
                    batch,
                    duration=e.duration,
                    seed=self._seed,
                    workers=self._workers,
                    guard=guard,
                    done=one_done,
                )
        return self._results(name, results)

    def _key(self, settings: TwinSettings, name: str, digest: str) -> str:
        """Return the digest of all that decides about a trial but its number."""
        of_any_number = self._settings.evaluation.model_copy(update={"trials": 1})
        told = _Deciding(
            name=name,
            policy=digest,
            world=settings,
            arm=self._arm,
            actuator=self._actuator.digest,
            pendulum=self._pendulum.digest,
            settings=self._settings.model_copy(update={"evaluation": of_any_number}),
            seed=self._seed,
        )
        return value_digest(told)

    def _friction(self) -> PivotFriction | None:
        return None if self._twin is None else pivot_friction(self._pendulum, self._twin.settings)

    def _plant(self) -> LoopParams:
        return make_loop_params(
            self._arm, self._settings, self._h, self._parameters, self._actuator
        )

    def _trials(self) -> Trials:
        count = self._settings.evaluation.trials
        return draw_trials(count, self._settings, self._seed, TEST, spread=1.0)

    def _results(self, name: str, trials: Trials) -> TrialResults:
        codes = trials.cause.tolist()
        guards = tuple(map(guard_named, codes))
        return TrialResults(
            name=name,
            survival=tuple(round(steps * self._h, 6) for steps in trials.steps.tolist()),
            causes=tuple(map(cause_named, codes)),
            guards=guards if any(guards) else (),
        )


class _Deciding(Value):
    """What decides about a trial but its number."""

    name: str
    policy: str
    world: TwinSettings
    arm: Arm
    actuator: str
    pendulum: str
    settings: Settings
    seed: int


class PartialEvaluation(Artefact):
    """The finished trials of evaluations that were interrupted."""

    FORMAT: ClassVar[str] = "equipoise-partial-evaluation"
    VERSION: ClassVar[int] = 1

    finished: dict[Name, tuple[tuple[Count, Count, Count], ...]]
    """Number, steps and code of the cause of each finished trial, by the digest of what decided
    about it."""


class _Kept(PartialFile):
    """Finished trials in a file, which is written now and then as a whole."""

    def __init__(self, path: Path | None, key: str) -> None:
        super().__init__(path, "evaluate", self._partial)
        self._key = key
        self._others: dict[str, tuple[tuple[int, int, int], ...]] = {}
        self._finished: list[tuple[int, int, int]] = []
        self._changing = threading.Lock()
        if path is not None and path.exists():
            self._others = dict(PartialEvaluation.load(path).finished)
            self._finished = list(self._others.pop(key, ()))

    def restore(self, trials: Trials) -> list[int]:
        """Fill in what is known of the trials, and return the numbers of the others."""
        count = len(trials.steps)
        self._finished = [row for row in self._finished if row[0] < count]
        for i, steps, cause in self._finished:
            trials.steps[i], trials.cause[i] = steps, cause
        known = {row[0] for row in self._finished}
        return [i for i in range(count) if i not in known]

    def add(self, i: int, steps: int, cause: int) -> None:
        """Keep a finished trial."""
        with self._changing:
            self._finished.append((i, steps, cause))
        self.update()

    def _partial(self) -> PartialEvaluation:
        with self._changing:
            finished = self._others | {self._key: tuple(self._finished)}
        return PartialEvaluation(finished=finished)
