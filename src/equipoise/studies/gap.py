"""Study of the sim-to-real gap: the cost of each effect that the training does not model.

A policy runs with all its cures and without each. A table that was trained as the paper describes,
on a plant with an ideal arm and a known state, runs for comparison. All runs are trials on the
digital twin, with the same starts and the same random numbers:

1. Survival against the transport delay.
2. Survival against a constant error of the encoder's zero.
3. The step from the training plant to the twin, effect by effect. A *clean* twin has every effect
   switched off. Each effect is added there alone, and removed alone from the full twin.
   Effects do not add up, so that both lists are needed.
4. All named worlds: guesses about the cabinet, whose servo KUKA does not publish.

Knowledge of the controllers. The cures use the actuator that an identification on the changed twin
would find: its delay, law and lags follow those of the twin, except for the controller `not told`,
which keeps the actuator of the training. The paper's table uses an `ideal` actuator, no
prediction, and the encoder's zero without a correction. Its angular velocity comes from the same
observer.

Every difference is a result on our twin, not a measurement of the authors' robot.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from math import radians
from typing import Any, Final, NamedTuple

from equipoise.artefacts import Estimate
from equipoise.control.policy import TabularPolicy, TaskPolicy
from equipoise.errors import InputError
from equipoise.executors import ThreadExecutor, Workers, executor_of, run_in_order
from equipoise.learning.train import train
from equipoise.model.actuator import Actuator
from equipoise.model.worlds import (
    MODEL,
    PREFIX,
    WORLDS,
    TwinSettings,
    World,
    pivot_friction,
    read_world,
)
from equipoise.settings import MOST_TRIALS, EvaluationSettings, Settings, resolve
from equipoise.studies.gap_results import (
    CURED,
    NO_BIAS,
    NO_PREDICTION,
    PAPER,
    UNTUNED,
    Controller,
    Gap,
    GapPoint,
    Part,
)
from equipoise.worlds.evaluation import Done, TrialResults, evaluate
from equipoise.worlds.twin.servo_model import equivalent_actuator

_ABSENT: Final = (
    *("transport", "transport_jitter", "encoder_age", "encoder_jitter", "zero_error"),
    *("zero_offset", "coulomb", "inertia_sigma", "friction_sigma", "bracket_mass"),
    *("reply_age", "joint_noise"),
)
_SMALL: Final = {"shaped": False, "lag": 0.001, "pendulum_mass": 0.01}
CLEAN: Final[Mapping[str, Any]] = dict.fromkeys(_ABSENT, 0.0) | _SMALL | {"counts_per_rev": 2**20}
"""Settings of the clean twin: negligible delay and lag, an encoder without steps and age, no
load."""

EFFECTS: Final[Mapping[str, tuple[str, ...]]] = {
    "transport delay": ("transport",),
    "transport jitter": ("transport_jitter",),
    "servo's shaping law": ("shaped",),
    "drive lag": ("lag",),
    "encoder counts and age": ("counts_per_rev", "encoder_age", "encoder_jitter"),
    "zero error": ("zero_error", "zero_offset"),
    "dry friction": ("coulomb",),
    "wrong I and b": ("inertia_sigma", "friction_sigma"),
    "weight on the arm": ("bracket_mass", "pendulum_mass"),
    "age of measured joints": ("reply_age", "joint_noise"),
}
"""Effects that are switched, and the settings of the twin that belong to each."""

BEST_TABLE: Final = (
    *("selection.every=20", "selection.averaging=1"),
    *("selection.late=1", "selection.candidates=500"),
)
"""Overrides that select the table with the longest survival on its own plant. The paper's table
balanced in simulation before it ran on the robot; the last table of recipe `paper` rarely does."""
BEST_TABLE_QUICK: Final = (
    *BEST_TABLE,
    *("selection.round_trials=64", "selection.rounds=5", "selection.duration=20"),
)
"""Overrides for the same with fewer and shorter trials of the candidates."""


class Form(NamedTuple):
    """Scope of a study, by default the full one."""

    trials: int = 40
    """Trials of each point."""
    duration: float = 60.0
    """Length of a trial [s]."""
    delays: tuple[float, ...] = (0.0, 0.005, 0.010, 0.020, 0.030)
    """Transport delays [s]."""
    zeros: tuple[float, ...] = tuple(map(radians, (0.0, 0.25, 0.5, 0.75, 1.0)))
    """Constant errors of the encoder's zero [rad]."""
    by_effect: tuple[Controller, ...] = (PAPER, CURED)
    """Controllers that run effect by effect."""
    worlds: tuple[str, ...] = tuple(WORLDS)
    """Other named worlds."""


FULL: Final = Form()
SHORT: Final = Form(
    8, 20.0, (0.0, 0.010, 0.030), tuple(map(radians, (0.0, 0.5, 1.0))), (PAPER,), worlds=()
)


def gap(
    policy: TaskPolicy,
    *,
    world: str | World = "twin:nominal",
    paper_policy: TabularPolicy | None = None,
    actuator: Actuator | None = None,
    trials: int | None = None,
    duration: float | None = None,
    quick: bool = False,
    seed: int = 0,
    workers: Workers = 1,
    done: Done = lambda _: None,
) -> Gap:
    """Measure the gap between training plant and twin.

    Args:
        policy: A policy that was trained with an actuator.
        world: The twin.
        paper_policy: A table trained as the paper describes, for the same pendulum and arm
            (default: trained here, from `seed`).
        actuator: Identified actuator of this twin (default: that of the policy's training).
        trials: Trials of each point (default: those of the form).
        duration: Length of a trial [s] (default: that of the form).
        quick: Whether the short form runs.
        seed: Master seed of the trials.
        workers: Number of threads, or an executor; the result does not depend on it.
        done: Called with the number of trials that have just finished, `trials_of` them in all.

    Raises:
        InputError: The policy has no cures, the tables are of two tasks, or the number of trials is
            out of range.
        SettingsError: The world is unknown.
        ArmError: The masses of the twin's arm are unknown.
    """
    twin, form = read_twin(world), _form(quick, trials, duration)
    actuator = actuator or policy.actuator
    if actuator.kind == "ideal":
        raise InputError(
            "the policy has an ideal actuator, and no cures to leave out; train one "
            "with equipoise train, or give its --actuator"
        )
    if paper_policy is None:
        paper_policy = train_paper(policy, quick=quick, seed=seed, workers=workers)
    for name in ("pendulum", "arm"):
        if getattr(policy, name).digest != getattr(paper_policy, name).digest:
            raise InputError(f"policy and paper policy differ in the {name}; train both for one")
    if paper_policy.actuator.kind != "ideal":
        raise InputError(
            "the paper policy was trained with an actuator; give one trained with "
            "equipoise train --recipe paper"
        )
    evaluation = policy.settings.evaluation.model_copy(
        update={"trials": form.trials, "duration": form.duration}
    )
    plan = tuple(_plan(twin.settings, form))
    equivalent = equivalent_actuator(twin.settings)

    def run(case: _Case) -> TrialResults:
        table = paper_policy if case.controller == PAPER else policy
        known = case.known and expected_actuator(actuator, equivalent, case.known)
        return evaluate(
            table,
            _settings(table.settings, case.controller, evaluation),
            world=MODEL if case.world is None else World(twin.name, case.world),
            actuator=known,
            seed=seed,
            workers=pieces,
            with_baselines=False,
            done=done,
        ).results

    # Each thread runs one condition, since there are more conditions than cores; on a cluster,
    # pieces of all conditions run side by side. A policy in Python may have a state, and runs one
    # trial at a time.
    cases, pieces = tuple(dict.fromkeys(case for _, case in plan)), executor_of(1)
    threads = executor_of(1 if policy.kernel is None else workers)
    if threads.is_remote:
        threads, pieces = ThreadExecutor(len(cases)), threads
    found = dict(zip(cases, run_in_order(threads, run, cases), strict=True))
    return Gap(
        quick=quick,
        policy=policy.digest,
        paper_policy=paper_policy.digest,
        paper_settings=paper_policy.settings,
        arm=policy.arm.name,
        pendulum=policy.pendulum.digest,
        actuator=actuator.digest,
        delay=actuator.delay.value,
        world=twin.name,
        world_settings=twin.settings,
        friction=pivot_friction(policy.pendulum, twin.settings),
        clean_settings=twin.settings.model_copy(update=CLEAN),
        settings=policy.settings.model_copy(update={"evaluation": evaluation}),
        seed=seed,
        points=tuple(point(results=found[case]) for point, case in plan),
    )


def trials_of(
    world: str | World = "twin:nominal", *, quick: bool = False, trials: int | None = None
) -> int:
    """Return the number of all trials of `gap`."""
    form = _form(quick, trials, None)
    return form.trials * len({case for _, case in _plan(read_twin(world).settings, form)})


def train_paper(policy: TaskPolicy, *, quick: bool = False, **options: Any) -> TabularPolicy:
    """Train a table as the paper describes, for the pendulum and the arm of a policy.

    Args:
        policy: The policy with pendulum and arm.
        quick: Whether fewer trials select the table.
        options: Further arguments of `train`: seed, workers, checkpoints, progress.
    """
    return train(policy.pendulum, policy.arm, paper_settings(quick=quick), **options)


def paper_settings(*, quick: bool = False) -> Settings:
    """Return the settings of `train_paper`."""
    return resolve("paper", overrides=BEST_TABLE_QUICK if quick else BEST_TABLE)


def read_twin(world: str | World) -> World:
    """Return a twin.

    Raises:
        InputError: The world is not a twin.
        SettingsError: The world is unknown.
    """
    if isinstance(world, World):
        return world
    if world == MODEL:
        raise InputError("the gap lies between model and a twin; give twin:nominal or another twin")
    return read_world(world)


def expected_actuator(actuator: Actuator, before: Actuator, after: Actuator) -> Actuator:
    """Return the actuator that an identification would find on a changed twin.

    Args:
        actuator: Identified actuator of the original twin.
        before: Equivalent actuator of the original twin.
        after: Equivalent actuator of the changed twin.
    """

    def moved(estimate: Estimate, by: float = 0.0, times: float = 1.0) -> Estimate:
        ends = {name: times * getattr(estimate, name) + by for name in ("low", "value", "high")}
        return estimate.model_copy(update=ends).not_negative()

    more = after.lags[0].value - before.lags[0].value
    return actuator.model_copy(
        update={
            "kind": actuator.kind if after.kind == before.kind else after.kind,
            "delay": moved(actuator.delay, after.delay.value - before.delay.value),
            "lags": tuple(moved(lag, more) for lag in actuator.lags),
            "cycle": moved(actuator.cycle, times=after.cycle.value / before.cycle.value),
        }
    )


class _Case(NamedTuple):
    """Key of the trials of a point; points with the same key share their trials."""

    controller: Controller
    """The controller; `cured` where only its actuator differs."""
    world: TwinSettings | None
    """Settings of the twin; None for the training plant."""
    known: Actuator | None
    """Equivalent actuator of the twin that the controller's actuator assumes; None for the actuator
    of the training."""


def _plan(world: TwinSettings, form: Form) -> Iterator[tuple[Callable[..., GapPoint], _Case]]:
    """Yield all points without their results, each with the key of its trials."""
    clean = world.model_copy(update=CLEAN)

    def entry(
        part: Part, controller: Controller, twin: TwinSettings | None, **of_point: Any
    ) -> tuple[Callable[..., GapPoint], _Case]:
        point = partial(GapPoint, part=part, controller=controller, **of_point)
        if controller == UNTUNED:
            return point, _Case(CURED, twin, equivalent_actuator(world))
        if twin is None or controller == PAPER:
            return point, _Case(controller, twin, None)
        return point, _Case(controller, twin, equivalent_actuator(twin))

    for controller in form.by_effect:
        yield entry("plant", controller, None)
        yield entry("clean", controller, clean)
        yield entry("world", controller, world)
        for name, numbers in EFFECTS.items():
            on = {number: getattr(world, number) for number in numbers}
            off = {number: CLEAN[number] for number in numbers}
            yield entry("alone", controller, clean.model_copy(update=on), name=name)
            yield entry("without", controller, world.model_copy(update=off), name=name)
    curves: Sequence[tuple[Part, str, Any, Sequence[Controller], Sequence[float]]] = (
        ("delay", "transport", {}, (CURED, UNTUNED, NO_PREDICTION, NO_BIAS, PAPER), form.delays),
        ("zero", "zero_offset", {"zero_error": 0.0}, (CURED, NO_BIAS, PAPER), form.zeros),
    )
    for part, number, rest, controllers, places in curves:
        twins: list[tuple[Controller, TwinSettings]] = [(each, world) for each in controllers]
        twins.append((PAPER, clean))
        for controller, base in twins:
            for at in places:
                twin = base.model_copy(update={number: at, **rest})
                yield entry(part, controller, twin, at=at, on_clean=base is clean)
    for name in form.worlds:
        for controller in (CURED, UNTUNED):
            yield entry("named", controller, read_world(PREFIX + name).settings, name=name)


def _form(quick: bool, trials: int | None, duration: float | None) -> Form:
    given = {"trials": trials, "duration": duration}
    form = (SHORT if quick else FULL)._replace(**{k: v for k, v in given.items() if v is not None})
    if not 2 <= form.trials <= MOST_TRIALS:
        raise InputError(
            f"{form.trials} trials at each point: expected 2 or more, since one has no spread, and "
            f"at most {MOST_TRIALS:,}"
        )
    return form


def _settings(
    settings: Settings, controller: Controller, evaluation: EvaluationSettings
) -> Settings:
    """Return the settings of a controller with its own cures."""
    cures = {"predict": NO_PREDICTION, "estimate_bias": NO_BIAS}
    left_out = {name: False for name, without in cures.items() if controller in (without, PAPER)}
    changes = {"controller": settings.controller.model_copy(update=left_out)}
    return settings.model_copy(update={**changes, "evaluation": evaluation})
