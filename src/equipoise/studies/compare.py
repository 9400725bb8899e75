"""Comparison of policies: the tables of all learners, baselines, and policies of others.

Each row is a policy, each column a world. All rows run the same trials: starts, plants and noise
depend on the seed and the number of a trial alone.

Budgets are equal: every learner has the same episodes, one training, the same seed and the settings
of its recipe, and nothing is chosen for a row. The search for the best table
(`equipoise.studies.table_search`) is no learner but the bound of what a table of these boxes does;
it begins at the learned tables too, and its steps are stated beside theirs.

Every controller has the same knowledge: the actuator of the training. On a twin with another
servo that model is wrong, and the column shows how robust a policy is; with `told` a further column
gives each controller the actuator of the twin's own numbers.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from equipoise.artefacts import StrPath
from equipoise.control.bound_policy import BUILT_IN, BoundPolicy, load_policy
from equipoise.control.onnx_policy import OnnxPolicy
from equipoise.control.policy import (
    RANDOM,
    Checkpoint,
    LearningPoint,
    TabularPolicy,
    TaskPolicy,
    tick_policy,
)
from equipoise.errors import InputError
from equipoise.executors import Workers
from equipoise.learning.select import Running
from equipoise.learning.train import train
from equipoise.model.actuator import Actuator, shipped_actuator
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.pendulum import Pendulum, shipped_pendulum
from equipoise.model.random import TEST
from equipoise.model.worlds import World
from equipoise.settings import EvaluationSettings, Settings, resolve
from equipoise.studies import value_iteration
from equipoise.studies.compare_results import (
    MAX_ROWS,
    MAX_WORLDS,
    Cell,
    Column,
    Comparison,
    Kind,
    PolicyRow,
)
from equipoise.studies.progress import ProgressReporter, Show, TrainingProgress, counted
from equipoise.studies.table_search import QUICK, SearchSize, search_table
from equipoise.studies.value_iteration import solve_table
from equipoise.worlds import find_world, setup_of, simulate
from equipoise.worlds.evaluation import Done, trial_results
from equipoise.worlds.twin.servo_model import equivalent_actuator

TRAINED: Final[Mapping[str, tuple[str, ...]]] = {
    "paper": ("paper",),
    "robust": ("robust",),
    "sarsa": ("robust", "learning.learner=sarsa"),
    "watkins": ("robust", "learning.learner=watkins"),
    "double_q": ("robust", "learning.learner=double_q"),
    "fine": ("fine",),
}
"""Recipe and settings of each row that is trained."""
SOLVED: Final[dict[str, str]] = {"value-iteration": "robust"}
"""Recipe of each row that value iteration solves."""
SEARCHED: Final[dict[str, str]] = {"best-table": "robust", "best-fine": "fine"}
"""Recipe of each row that is searched."""
ROWS: Final = (*TRAINED, *SOLVED, *SEARCHED, *BUILT_IN)
"""Names of all rows, in their order."""
WORLDS: Final = ("ideal", "model", "twin:nominal", "twin:harsh")
"""Worlds by default."""
QUICK_SETTINGS: Final = (
    *("learning.episodes=1000", "selection.round_trials=64"),
    *("selection.rounds=4", "selection.duration=10"),
)
"""Overrides of the trainings of the short form."""
TRIALS: Final = 200
"""Number of trials of each policy in each world."""
QUICK_TRIALS: Final = 20
"""The same in the short form."""
DURATION: Final = 60.0
"""Length of a trial [s]."""
QUICK_DURATION: Final = 10.0
"""The same in the short form [s]."""
DECISIONS: Final = 100
"""Number of decisions between two looks at the clock."""
ROUNDS: Final = 21
"""Number of such rounds; the median counts."""


class Progress:
    """Callbacks of a comparison, for any thread."""

    def training(self, row: str, settings: Settings) -> tuple[Callable[..., None], Running]:
        """Return the callbacks `report` and `selecting` of a training."""
        return (lambda _: None), (lambda _, __: None)

    def searching(self, row: str, size: SearchSize) -> tuple[Callable[..., None], Running]:
        """Return the callbacks `report` and `selecting` of a search."""
        return (lambda _: None), (lambda _, __: None)

    def done(self, trials: int) -> None:
        """Receive the number of trials that have just finished."""


class StageProgress(Progress):
    """Progress of a comparison as stages: each training, each search, and all trials."""

    def __init__(self, show: Show, total: int) -> None:
        """Begin with the first training.

        Args:
            show: Called with the progress.
            total: Number of all trials.
        """
        self._show, self._done = show, counted("compare", total, show)

    def training(self, row: str, settings: Settings) -> tuple[Callable[..., None], Running]:
        """Return callbacks that show a training and its race."""
        of_learner = TrainingProgress(settings, self._show, of=row).of_learner()
        return of_learner["report"], of_learner["selecting"]

    def searching(self, row: str, size: SearchSize) -> tuple[Callable[..., None], Running]:
        """Return callbacks that show a search and its race."""
        trials = size.generations * size.tables * size.trials

        def report(point: LearningPoint) -> None:
            text = f"{point.duration:.1f} s a trial"
            self._show(ProgressReporter(f"search {row}", point.episodes, trials, "trials", text))

        def selecting(done: int, of: int) -> None:
            self._show(ProgressReporter(f"select {row}", done, of, "trials"))

        return report, selecting

    def done(self, trials: int) -> None:
        """Count finished trials."""
        self._done(trials)


class Compared(NamedTuple):
    """Result of a comparison."""

    comparison: Comparison
    """Cost and trials."""
    tables: Mapping[str, TabularPolicy]
    """Tables that were trained and searched, by the names of their rows."""


class _Made(NamedTuple):
    """A policy of a row, and the wall time of its training."""

    policy: TaskPolicy
    kind: Kind
    wall: float | None = None


def compare(
    given: Sequence[StrPath] = (),
    *,
    rows: Sequence[str] = ROWS,
    worlds: Sequence[str] = WORLDS,
    told: bool = False,
    pendulum: Pendulum | None = None,
    arm: Arm | None = None,
    actuator: Actuator | None = None,
    episodes: int | None = None,
    trials: int | None = None,
    duration: float | None = None,
    quick: bool = False,
    seed: int = 0,
    workers: Workers = 1,
    progress: Progress | None = None,
) -> Compared:
    """Train what is compared, and run all policies in all worlds.

    Args:
        given: Further policies, as `equipoise.load_policy` takes them.
        rows: Names of the rows to make, from `ROWS`.
        worlds: Names of the worlds.
        told: Whether each twin has a second column, with the twin's own actuator.
        pendulum: The identified pendulum (default: the one that ships).
        arm: The arm with its home posture (default: the iiwa7).
        actuator: Actuator of the training and of the controllers (default: the one that ships).
        episodes: Episodes of each learner (default: the paper's, or 1,000 in the short form).
        trials: Trials of each policy in each world (default: those of the form).
        duration: Length of a trial [s] (default: that of the form).
        quick: Whether the short form runs.
        seed: Master seed of trainings and trials.
        workers: Number of threads, or an executor; the result does not depend on it, except times.
        progress: Callbacks.

    Raises:
        InputError: A row is unknown, there is none, there are too many, or a policy is no policy.
        SettingsError: A world is unknown, or no controller balances the pendulum.
        ArmError: The masses of the arm are unknown, and a world is a twin.
    """
    shown = progress or Progress()
    task = pendulum or shipped_pendulum(), arm or iiwa(7), actuator or shipped_actuator()
    columns = _columns(worlds, told)
    few = {"trials": trials or (QUICK_TRIALS if quick else TRIALS)}
    long = {"duration": duration or (QUICK_DURATION if quick else DURATION)}
    evaluation = EvaluationSettings.model_validate(few | long)
    made = {
        name: _Made(policy, "given")
        for name, policy in load_given(given, rows, pendulum, arm, actuator).items()
    }
    own: dict[str, _Made] = {}
    for row in dict.fromkeys(rows):
        own[row] = _make(row, own, task, episodes, quick, seed, workers, shown)
    made = own | made
    comparison = Comparison(
        quick=quick,
        arm=task[1].name,
        pendulum=task[0].digest,
        actuator=task[2].digest,
        evaluation=evaluation,
        seed=seed,
        columns=columns,
        rows=tuple(
            _row(name, each, columns, evaluation, seed, workers, shown.done)
            for name, each in made.items()
        ),
    )
    tables = {
        name: each.policy for name, each in own.items() if isinstance(each.policy, TabularPolicy)
    }
    return Compared(comparison, tables)


def load_given(
    given: Sequence[StrPath],
    rows: Sequence[str],
    pendulum: Pendulum | None = None,
    arm: Arm | None = None,
    actuator: Actuator | None = None,
) -> dict[str, TaskPolicy]:
    """Return the given policies by their names in a comparison, and check the rows beside them.

    Args:
        given: Further policies, as `equipoise.load_policy` takes them.
        rows: Names of the rows to make.
        pendulum: As in `compare`.
        arm: As in `compare`.
        actuator: As in `compare`.

    Raises:
        InputError: A row is unknown, there is none, there are too many, or a policy is no policy
            or for another task.
    """
    if unknown := [row for row in rows if row not in ROWS]:
        raise InputError(f"there is no row {unknown[0]!r:.60}; choose from {', '.join(ROWS)}")
    count = len(set(rows)) + len(given)
    if not 1 <= count <= MAX_ROWS:
        raise InputError(f"{count} policies are to be compared, expected 1 to {MAX_ROWS}")
    wanted = (pendulum or shipped_pendulum()).digest, (arm or iiwa(7)).digest
    found: dict[str, TaskPolicy] = {}
    for path in given:
        policy = load_policy(path, pendulum=pendulum, arm=arm, actuator=actuator)
        if (policy.pendulum.digest, policy.arm.digest) != wanted:
            raise InputError(
                f"{path} was trained for another pendulum or arm than the rest of the comparison; "
                "give its --pendulum and --arm"
            )
        name = _free_name(str(path), found)
        if name in found:
            raise InputError(f"{path} is given twice; give each policy once")
        found[name] = policy
    return found


def trials_of(
    given: Sequence[StrPath],
    rows: Sequence[str],
    worlds: Sequence[str],
    told: bool,
    trials: int | None,
    quick: bool,
) -> int:
    """Return the number of all trials of `compare`."""
    each = trials or (QUICK_TRIALS if quick else TRIALS)
    return each * len(_columns(worlds, told)) * (len(given) + len(set(rows)))


def settings_of(row: str, *, quick: bool = False, episodes: int | None = None) -> Settings:
    """Return the settings of a row that is trained, solved or searched."""
    recipe, *changes = TRAINED.get(row) or ((SOLVED | SEARCHED)[row],)
    number = () if episodes is None else (f"learning.episodes={episodes}",)
    return resolve(recipe, overrides=(*changes, *(QUICK_SETTINGS if quick else ()), *number))


def _columns(worlds: Sequence[str], told: bool) -> tuple[Column, ...]:
    """Return the columns of worlds, each twin's second one behind it."""
    columns: list[Column] = []
    for world in dict.fromkeys(worlds):
        name, numbers = find_world(world)
        for knows in (False, True) if told and numbers is not None else (False,):
            columns.append(Column(world=name, told=knows, world_settings=numbers))
    if not 1 <= len(columns) <= MAX_WORLDS:
        raise InputError(f"{len(columns)} worlds are given, expected 1 to {MAX_WORLDS}")
    return tuple(columns)


def _free_name(name: str, taken: Mapping[str, object]) -> str:
    """Return a short name of a given policy that is no other row's."""
    short = Path(name).name if ":" not in name else name
    return name if short in taken or short in ROWS else short


def _make(
    row: str,
    before: Mapping[str, _Made],
    task: tuple[Pendulum, Arm, Actuator],
    episodes: int | None,
    quick: bool,
    seed: int,
    workers: Workers,
    progress: Progress,
) -> _Made:
    """Train, search or load the policy of a row."""
    pendulum, arm, actuator = task
    if row in BUILT_IN:
        policy = load_policy(row, pendulum=pendulum, arm=arm, actuator=actuator)
        return _Made(policy, "built in")
    settings, begin = settings_of(row, quick=quick, episodes=episodes), time.perf_counter()
    if row in SEARCHED:
        size = QUICK if quick else SearchSize()
        report, selecting = progress.searching(row, size)
        tables = [each.policy for each in before.values()]
        table = search_table(
            pendulum,
            arm,
            settings,
            actuator=actuator,
            starts=[
                each.u_of_box
                for each in tables
                if isinstance(each, TabularPolicy) and each.settings.boxes == settings.boxes
            ],
            size=size,
            seed=seed,
            workers=workers,
            report=report,
            selecting=selecting,
        )
        return _Made(table, "searched", time.perf_counter() - begin)
    report, selecting = progress.training(row, settings)
    if row in SOLVED:
        table = solve_table(
            pendulum,
            arm,
            settings,
            actuator=actuator,
            size=value_iteration.QUICK if quick else None,
            seed=seed,
            workers=workers,
            selecting=selecting,
        )
        return _Made(table, "solved", time.perf_counter() - begin)
    table = train(
        pendulum,
        arm,
        settings,
        actuator=None if settings.plant.ideal else actuator,
        seed=seed,
        workers=workers,
        report=report,
        selecting=selecting,
    )
    return _Made(table, "trained", time.perf_counter() - begin)


def _row(
    name: str,
    made: _Made,
    columns: Sequence[Column],
    evaluation: EvaluationSettings,
    seed: int,
    workers: Workers,
    done: Done,
) -> PolicyRow:
    """Measure a policy."""
    policy, table = made.policy, None
    if isinstance(policy, TabularPolicy):
        table = policy
    here = table if made.kind != "given" else None
    return PolicyRow(
        name=name,
        kind=made.kind,
        policy=policy.digest,
        recipe="" if table is None else table.recipe,
        episodes=None if here is None else here.episodes,
        steps=None if here is None else here.steps,
        selection_steps=None if here is None else _race_steps(here.checkpoints, here.h),
        train_s=made.wall,
        size=size_of(policy),
        decision_s=decision_time(policy),
        cells=tuple(_cell(name, policy, each, evaluation, seed, workers, done) for each in columns),
    )


def _race_steps(results: Sequence[Checkpoint], h: float) -> int:
    return round(sum(each.trials * each.mean_duration for each in results) / h)


def _cell(
    name: str,
    policy: TaskPolicy,
    column: Column,
    evaluation: EvaluationSettings,
    seed: int,
    workers: Workers,
    done: Done,
) -> Cell:
    """Run the trials of a policy in a world."""
    numbers, known = column.world_settings, None
    if column.told and numbers is not None and policy.actuator.kind != "ideal":
        known = equivalent_actuator(numbers)
    world = column.world if numbers is None else World(column.world, numbers)
    settings = policy.settings.model_copy(update={"evaluation": evaluation})
    setup = setup_of(policy, world, settings, known)
    simulation = simulate(world, setup, seed=seed, stream=TEST)
    trials = simulation.draw(evaluation.trials)
    simulation.run(
        policy,
        trials,
        range(evaluation.trials),
        duration=evaluation.duration,
        workers=workers,
        done=lambda rows: done(len(rows)),
    )
    return Cell(
        actuators=tuple(each.digest for each in setup.actuators),
        results=trial_results(name, trials, setup.h),
        rms_x=float(np.sqrt(trials.sum_x2.sum() / trials.steps.sum())),
    )


def size_of(policy: TaskPolicy) -> int | None:
    """Return the size of the numbers that determine a policy [bytes]; None for one in Python.

    A table of 8 actions needs 3 bits for a box, and has a byte. The edges of the boxes and the
    controller around the policy are those of every row.
    """
    if isinstance(policy, TabularPolicy):
        return len(policy.Q)
    if policy.kernel is not None:
        return 0 if policy.kernel.kind == RANDOM else 8 * len(policy.kernel.gains)
    own = policy.policy if isinstance(policy, BoundPolicy) else None
    return own.size if isinstance(own, OnnxPolicy) else None


def decision_time(policy: TaskPolicy) -> float:
    """Return the median time of a decision, called from Python as in a run [s]."""
    decide = tick_policy(policy)
    decide.reset()
    rng, times = np.random.default_rng(0), list[float]()
    for _ in range(ROUNDS):
        states = rng.uniform(-1.0, 1.0, (DECISIONS, 4)) * (0.1, 0.3, 0.05, 0.5)
        begin = time.perf_counter()
        for state in states:
            decide.act(state)
        times.append((time.perf_counter() - begin) / DECISIONS)
    return float(np.median(times))
