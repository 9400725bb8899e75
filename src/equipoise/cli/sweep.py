"""`equipoise sweep`: searches settings for the policy that lasts best."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Final

from equipoise.cli import options as opt
from equipoise.cli.destinations import check_output, choose_file, pictures
from equipoise.cli.output import Output, verb
from equipoise.printable import printable

if TYPE_CHECKING:
    from equipoise.studies.sweep_results import Sweep, SweepTrial

SHOWN: Final = 10
"""Number of trials in the table."""


@verb
def sweep(
    study_file: Path = opt.argument(
        "STUDY", "TOML with the parameters, their ranges and the tests."
    ),
    pendulum: Path | None = opt.value(
        "FILE", "Pendulum from equipoise identify; by default the shipped one."
    ),
    arm: str = opt.ARM,
    actuator: list[str] | None = opt.ACTUATORS,
    workers: int | None = opt.WORKERS,
    ray: str | None = opt.RAY,
    out: Path | None = opt.out("Sweep to write, figure and storage beside it.", "sweep.json"),
    force: bool = opt.FORCE,
    as_json: bool = opt.JSON,
) -> None:
    """Search settings for the policy that lasts best.

    Each trial trains one learner with other settings and tests its policy.
    Finished trials are stored in an SQLite file beside the result: after an
    interruption the same command continues. Equal studies give equal trials.
    Exit code 1: in the best trial no test lasted.
    """
    output = Output(as_json)
    output.say(f"Sweeping the settings of {study_file}")
    destination = choose_file(
        output, out, "sweep.json", study_file, pendulum, force=force, beside=pictures
    )

    from equipoise.apps.report.figures.sweep import sweep_figure
    from equipoise.apps.report.style import save
    from equipoise.studies import sweep as study
    from equipoise.studies.compilation import FUNCTIONS, compile_training, compiling
    from equipoise.studies.sweep_results import read_study

    storage = study.storage_path(destination.path)
    check_output(storage, study_file, pendulum, suffix=storage.suffix)
    study.load_optuna()
    read = read_study(study_file)
    source, machine = opt.read_pendulum(pendulum), opt.read_arm(arm)
    responses = [one for each in actuator or () if (one := opt.read_actuator(each))]
    executor = opt.executor(workers, ray)
    with output.stages() as show:
        with compiling(show, FUNCTIONS):
            compile_training(machine, read.resolved())
        found = study.sweep(
            read,
            source,
            machine,
            actuators=responses,
            storage=storage,
            executor=executor,
            show=show,
        )
    with destination.claimed() as out:
        inputs = {"pendulum": found.pendulum, "arm": found.arm}
        found.save(out, command="sweep", inputs=inputs)
        wrote = [out, *save(sweep_figure(found), out.with_suffix(""))]
    _say(output, found)
    output.wrote(*wrote, storage)
    best = found.ranking[0]
    output.next("train", pendulum, "--set", "NAME=VALUE")
    output.result(
        sweep=out,
        files=wrote,
        storage=storage,
        objective=read.objective,
        best=_result(found, best),
        trials=[_result(found, trial) for trial in found.trials],
        bad=not best.survived,
    )


def _result(found: "Sweep", trial: "SweepTrial") -> dict[str, object]:
    value = None if trial.error else found.value(trial)
    return {**trial.model_dump(mode="json"), "value": value, "interval": list(trial.interval)}


def _say(output: Output, found: "Sweep") -> None:
    study, ranking = found.study, found.ranking
    failed = [trial for trial in found.trials if trial.error]
    output.say(
        f"{len(found.trials)} trials, each tested in {study.tests} tests of {study.duration:g} s, "
        f"world {study.world}, seed {study.seed}; the best ones by {study.objective}:"
    )
    columns = ("trial", "lasted", "95 % interval", "mean", "settings<")
    output.table(columns, [_row(trial) for trial in ranking[:SHOWN]], bold=0)
    if failed:
        first = f"trial {failed[0].index}: {failed[0].error}"
        output.warn(f"{len(failed)} trials have invalid settings; {first}")


def _row(trial: "SweepTrial") -> tuple[str, ...]:
    from equipoise.worlds.formatting import percent

    low, high = trial.interval
    return (
        str(trial.index),
        f"{trial.survived} of {trial.tests}",
        f"{percent(low)} to {percent(high)}",
        f"{trial.duration:.1f} s",
        printable(", ".join(f"{name} {_text(v)}" for name, v in trial.parameters.items())),
    )


def _text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else json.dumps(value)
