"""Sweep: search over settings for the policy that lasts best.

A study file names settings with their ranges. Each trial of a sweep resolves its settings, trains
one learner, and evaluates its policy on the plant of the study. A trial is a pure function of
study, seed and index.

Optuna proposes the parameters. Trials are proposed in batches: a batch follows from the results of
the batches before it, taken in the order of their indices, and each trial has a seed of its own.
Equal seeds therefore give equal trials for any number of workers, and after any interruption. Only
finished trials are stored, each in one transaction of an SQLite file in Optuna's schema.
"""

import json
import sqlite3
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice, product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from pydantic import ValidationError

from equipoise.artefacts import StrPath, first_fault, quoted, value_digest
from equipoise.errors import ArtefactError, InputError, MissingExtraError
from equipoise.executors import Executor, ThreadExecutor
from equipoise.learning.train import train
from equipoise.model.actuator import Actuator
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import Pendulum
from equipoise.studies.progress import ProgressReporter, Show
from equipoise.studies.reproduction import software
from equipoise.studies.sweep_results import Sweep, SweepStudy, SweepTrial, objective
from equipoise.worlds.evaluation import evaluate

if TYPE_CHECKING:
    import optuna

STUDY_NAME: Final = "equipoise-sweep"
"""Name of the study in the storage."""


@dataclass(frozen=True)
class SweepTask:
    """Inputs of one trial, which determine its result."""

    study: SweepStudy
    pendulum: Pendulum
    arm: Arm
    actuators: tuple[Actuator, ...]
    index: int
    parameters: dict[str, Any]


def run_trial(task: SweepTask) -> SweepTrial:
    """Train one learner with the settings of a trial, and test its policy.

    The tests vary the plant as the study's own settings say, so that all trials are tested alike
    even where they train on different variations. The trial's index is that of the learner.

    Args:
        task: Inputs of the trial.
    """
    study, index, parameters = task.study, task.index, task.parameters
    try:
        settings, common = study.resolved(parameters), study.resolved()
        policy = train(
            task.pendulum,
            task.arm,
            settings,
            actuator=task.actuators or None,
            seed=study.seed,
            learner=index,
        )
        length = {"trials": study.tests, "duration": study.duration}
        tested = settings.model_copy(
            update={
                "plant": common.plant,
                "evaluation": common.evaluation.model_copy(update=length),
            }
        )
        results = evaluate(
            policy, tested, world=study.world, seed=study.seed, with_baselines=False
        ).results
    except InputError as error:
        return SweepTrial(index=index, parameters=parameters, error=str(error)[:4096])
    return SweepTrial(
        index=index,
        parameters=parameters,
        tests=study.tests,
        survived=results.summary().survived,
        duration=float(np.mean(results.survival)),
    )


def sweep(
    study: SweepStudy,
    pendulum: Pendulum,
    arm: Arm,
    *,
    actuators: Sequence[Actuator] = (),
    storage: StrPath,
    executor: Executor | None = None,
    show: Show = lambda _: None,
) -> Sweep:
    """Run the trials of a study, and continue an interrupted sweep.

    Args:
        study: The study.
        pendulum: The identified pendulum.
        arm: The arm with its home posture.
        actuators: Actuators of the trainings; by default as in `equipoise.learning.train.train`.
        storage: SQLite file of the finished trials; an existing one is continued. A study with
            another number of trials continues it, too.
        executor: Runner of the trials; by default one thread. Results do not depend on it.
        show: Callback for progress.

    Raises:
        ArtefactError: `storage` holds another sweep, or is damaged.
        InputError: No trial has valid settings.
        MissingExtraError: Optuna is not installed.
    """
    inputs: dict[str, Any] = {
        "pendulum": pendulum.digest,
        "arm": arm.digest,
        "actuators": tuple(each.digest for each in actuators),
    }
    deciding = value_digest(study, exclude={"trials": True}) + json.dumps(
        [inputs, software(), load_optuna().__version__]
    )
    executor, total = executor or ThreadExecutor(1), study.count
    with Storage(Path(storage), study, deciding) as stored:
        finished = {trial.index: trial for trial in stored.read() if trial.index < total}
        size = study.batch if study.sampler == "tpe" else total
        for first in range(0, total, size):
            batch = range(first, min(first + size, total))
            todo = [i for i in batch if i not in finished]
            show(_progress(study, finished, total))
            if not todo:
                continue
            proposed = _propose(study, batch, [finished[i] for i in range(first)])
            tasks = [
                SweepTask(study, pendulum, arm, tuple(actuators), i, proposed[i - first])
                for i in todo
            ]
            for _, trial in executor.completed(run_trial, tasks):
                stored.add(trial)
                finished[trial.index] = trial
                show(_progress(study, finished, total))
    found = Sweep(study=study, trials=tuple(finished[i] for i in range(total)), **inputs)
    if not found.ranking:
        raise InputError(
            f"none of {total} trials has valid settings; the first one: {found.trials[0].error}"
        )
    return found


def _progress(study: SweepStudy, finished: dict[int, SweepTrial], total: int) -> ProgressReporter:
    values = [objective(study, trial) for trial in finished.values() if not trial.error]
    text = f"best {study.objective} {max(values):.4g}" if values else ""
    return ProgressReporter("sweep", len(finished), total, "trials", text=text)


def _propose(
    study: SweepStudy, batch: Sequence[int], before: Sequence[SweepTrial]
) -> list[dict[str, Any]]:
    """Return the parameters of the trials of a batch, from the results of all trials before it."""
    ranges = study.ranges
    if study.sampler == "grid":
        grid = product(*(found.grid() or () for found in ranges.values()))
        points = islice(grid, batch[0], batch[-1] + 1)
        return [dict(zip(ranges, point, strict=True)) for point in points]
    optuna = load_optuna()
    distributions = {name: found.distribution() for name, found in ranges.items()}
    samplers = {"tpe": optuna.samplers.TPESampler, "random": optuna.samplers.RandomSampler}
    memory = optuna.create_study(direction="maximize")
    if study.sampler == "tpe":
        for trial in before:
            memory.add_trial(_frozen(study, trial))
    proposed: list[dict[str, Any]] = []
    for index in batch:
        # A seed for each trial: a resumed batch draws the same numbers.
        seed = int(np.random.SeedSequence([study.seed, index]).generate_state(1)[0])
        memory.sampler = samplers[study.sampler](seed=seed)
        drawn = memory.ask(distributions).params
        proposed.append({name: found.value(drawn[name]) for name, found in ranges.items()})
    return proposed


def _frozen(study: SweepStudy, trial: SweepTrial) -> "optuna.trial.FrozenTrial":
    """Return a finished trial in Optuna's form; settings that cannot be trained have failed."""
    optuna = load_optuna()
    drawn = {
        name: list(found.choices).index(trial.parameters[name])
        if found.choices is not None
        else trial.parameters[name]
        for name, found in study.ranges.items()
    }
    state = optuna.trial.TrialState.FAIL if trial.error else optuna.trial.TrialState.COMPLETE
    return optuna.trial.create_trial(
        state=state,
        value=None if trial.error else objective(study, trial),
        params=drawn,
        distributions={name: found.distribution() for name, found in study.ranges.items()},
        user_attrs={"equipoise": trial.model_dump(mode="json")},
    )


def load_optuna() -> Any:
    """Return the module Optuna.

    Raises:
        MissingExtraError: Optuna is not installed.
    """
    try:
        import optuna
    except ImportError:
        raise MissingExtraError("optuna", "sweep") from None
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


class Storage:
    """Finished trials of a sweep in an SQLite file of Optuna."""

    def __init__(self, path: Path, study: SweepStudy, deciding: str) -> None:
        optuna = load_optuna()
        self._path, self._study = path, study
        path.parent.mkdir(parents=True, exist_ok=True)
        with _readable(self._path):
            # The path is no part of the address, in which Optuna expands braces and more.
            opened = {"creator": lambda: sqlite3.connect(path)}
            self._storage = optuna.storages.RDBStorage("sqlite:///storage", engine_kwargs=opened)
            self._stored = optuna.create_study(
                study_name=STUDY_NAME,
                storage=self._storage,
                direction="maximize",
                load_if_exists=True,
            )
            known = self._stored.user_attrs.get("equipoise")
            if known is None and not self._stored.get_trials(deepcopy=False):
                self._stored.set_user_attr("equipoise", known := deciding)
        if known != deciding:
            self._storage.engine.dispose()
            raise ArtefactError(
                f"{path} holds a sweep with another study, pendulum, arm, actuator or version of "
                "Equipoise or Optuna; continue with those, give another --out, or delete it to "
                "begin anew"
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._storage.remove_session()
        self._storage.engine.dispose()

    def read(self) -> Iterator[SweepTrial]:
        """Yield the finished trials.

        Raises:
            ArtefactError: The file holds a damaged trial.
        """
        with _readable(self._path):
            stored = self._stored.get_trials(deepcopy=False)
        for each in stored:
            try:
                yield SweepTrial.model_validate_json(json.dumps(each.user_attrs.get("equipoise")))
            except ValidationError as error:
                raise ArtefactError(
                    f"{self._path} holds a damaged trial {each.number}: {first_fault(error).what}; "
                    "delete the file to begin anew"
                ) from None

    def add(self, trial: SweepTrial) -> None:
        """Store a finished trial in one transaction."""
        with _readable(self._path):
            self._stored.add_trial(_frozen(self._study, trial))


@contextmanager
def _readable(path: Path) -> Generator[None]:
    """Turn an error of the database into an `ArtefactError`."""
    from optuna.exceptions import StorageInternalError
    from sqlalchemy.exc import SQLAlchemyError

    try:
        yield
    except (SQLAlchemyError, StorageInternalError) as error:
        cause = getattr(error, "orig", None) or error.__cause__ or error
        raise ArtefactError(
            f"{path} is not the storage of a sweep, or cannot be written ({quoted(str(cause))}); "
            "delete it to begin anew, or give another --out"
        ) from None


def storage_path(out: Path) -> Path:
    """Return the path of the finished trials of a sweep, beside its result."""
    return out.with_suffix(".sqlite3")
