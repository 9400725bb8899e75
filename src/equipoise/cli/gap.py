"""`equipoise gap`: what the twin does to a policy, what cures it, and effect by effect why."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from equipoise.cli.destinations import choose_file
from equipoise.cli.options import (
    IN_AND_OUT,
    Force,
    Json,
    PolicyFile,
    Seed,
    Workers,
    available_workers,
    read_actuator,
    read_policy,
)
from equipoise.cli.output import Output, verb
from equipoise.errors import InputError

if TYPE_CHECKING:
    from rich.table import Table

    from equipoise.studies.gap_results import Controller, Gap, GapPoint


@verb
def gap(
    policy: PolicyFile = None,
    paper_policy: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Trained as the paper describes; by default one is trained here.",
        ),
    ] = None,
    world: Annotated[
        str, typer.Option(metavar="WORLD", help="twin:nominal, twin:harsh, or twin:FILE.")
    ] = "twin:nominal",
    actuator: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            help="What was identified of this world's arm; by default that of the policy.",
        ),
    ] = None,
    trials: Annotated[
        int | None,
        typer.Option(min=2, metavar="N", help="Trials of each point; 40, or 8 with --quick."),
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Length of a trial; 60, or 20 with --quick."),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="The short form: fewer points and trials.")
    ] = False,
    seed: Seed = 0,
    workers: Workers = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="The study that is written, its figure beside it.",
            rich_help_panel=IN_AND_OUT,
            show_default="gap.json",
        ),
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Take the gap between training plant and twin apart, effect by effect.

    A policy with its cures, without prediction and without bias estimate runs
    beside a table that was trained as the paper describes. It takes some
    minutes on two cores, with --quick half a minute.
    """
    output = Output(as_json)
    output.say(f"Measuring the gap of {policy or 'the policy that ships'} to {world}")
    destination = choose_file(
        output,
        out,
        "gap.json",
        policy,
        paper_policy,
        force=force,
        beside=lambda path: (*_figure(path), *(() if paper_policy else (_paper_policy(path),))),
    )
    if duration is not None and not 0.01 <= duration <= 3600.0:
        raise InputError(f"--duration is {duration:g} s; give a number from 0.01 to 3600")

    from equipoise.report.figures.gap import gap_figure
    from equipoise.report.style import save
    from equipoise.studies import gap as study
    from equipoise.studies.compilation import (
        FUNCTIONS,
        TWIN_FUNCTIONS,
        compile_training,
        compile_trials,
        compiling,
    )
    from equipoise.studies.progress import TrainingProgress, counted

    table = read_policy(policy)
    known = read_actuator(actuator)
    total = study.trials_of(world, quick=quick, trials=trials)
    with output.stages() as show:
        with compiling(show, FUNCTIONS + TWIN_FUNCTIONS):
            compile_training(table.arm, study.paper_settings(quick=quick))
            compile_trials(table, world)
        if paper_policy is None:
            progress = TrainingProgress(study.paper_settings(quick=quick), 1, show, "paper")
            other = study.train_paper(
                table,
                quick=quick,
                seed=seed,
                workers=available_workers(workers),
                report=lambda point: progress.report(0, point),
                selecting=lambda done, of: progress.selecting(0, done, of),
            )
        else:
            other = read_policy(paper_policy)
        found = study.gap(
            table,
            world=world,
            paper_policy=other,
            actuator=known,
            trials=trials,
            duration=duration,
            quick=quick,
            seed=seed,
            workers=available_workers(workers),
            done=counted("gap", total, show),
        )
    inputs = {"policy": found.policy, "paper policy": found.paper_policy}
    with destination.claimed() as out:
        found.save(out, command="gap", inputs=inputs)
        wrote = [out, *save(gap_figure(found), out.with_suffix(""))]
        if paper_policy is None:
            wrote.append(_paper_policy(out))
            other.save(wrote[-1], command="gap", inputs={"pendulum": table.pendulum.digest})
    _say(output, found)
    output.wrote(*wrote)
    output.next("evaluate", *((policy,) if policy else ()), "--world", world, "--claim", "0.99")
    output.result(_result(found, wrote))


def _figure(out: Path) -> tuple[Path, ...]:
    return out.with_suffix(".svg"), out.with_suffix(".png")


def _paper_policy(out: Path) -> Path:
    return out.with_name(f"{out.stem}-paper-policy.json")


def _say(output: Output, found: "Gap") -> None:
    from equipoise.studies.gap_results import LABELS, words

    wrong = abs(found.delay - found.world_settings.transport)
    if wrong > found.settings.controller.margin:
        output.warn(
            f"the cures go by a delay of {1e3 * found.delay:.1f} ms, and {found.world} has "
            f"{1e3 * found.world_settings.transport:.1f} ms; identify that twin and give its "
            "--actuator"
        )
    output.say(
        f"{found.trials} trials of {found.duration:g} s at each point, on the {found.arm}, world "
        f"{found.world}, seed {found.seed}"
    )
    if found.friction is not None:
        output.say(f"pendulum: {found.friction.words(found.world)}")
    output.say("\nMean survival [s], in brackets the share of the falls on the track limit [%]")
    output.say(_curves(found, "delay"))
    output.say(_curves(found, "zero"))
    for controller in found.apart:
        output.say(f"Effect by effect, {LABELS[controller]}")
        output.say(_effects(found, controller))
    output.points(words(found))


def _curves(found: "Gap", part: Literal["delay", "zero"]) -> "Table":
    from rich.box import SIMPLE
    from rich.table import Table

    from equipoise.studies.gap_results import at_words

    curves = {key: found.curve(part, *key) for key in found.curves}
    table = Table(box=SIMPLE, pad_edge=False)
    table.add_column({"delay": "transport delay", "zero": "wrong zero"}[part], no_wrap=True)
    for point in next(iter(curves.values())):
        table.add_column(at_words(part, point.at), justify="right", no_wrap=True)
    for (controller, on_clean), curve in curves.items():
        if curve:
            name = f"{controller}, clean twin" if on_clean else controller
            table.add_row(name, *(_cell(found, point) for point in curve))
    return table


def _cell(found: "Gap", point: "GapPoint") -> str:
    from equipoise.studies.gap_results import mean, track_share

    share = track_share(point.results)
    ends = "" if share is None else f" ({100.0 * share:.0f})"
    return f"{mean(point.results, found.duration).mean:.1f}{ends}"


def _effects(found: "Gap", controller: "Controller") -> "Table":
    from rich.box import SIMPLE
    from rich.table import Table

    from equipoise.studies.gap_results import difference, mean, spelled

    plant, clean, world = (found.point(p, controller) for p in ("plant", "clean", "world"))
    table = Table(box=SIMPLE, pad_edge=False)
    table.add_column("", no_wrap=True)
    table.add_column("on alone, clean twin", justify="right", no_wrap=True)
    table.add_column("away alone, twin", justify="right", no_wrap=True)
    own = mean(plant.results, found.duration).mean
    table.add_row(
        f"none ({own:.1f} s on its own plant)",
        *(spelled(mean(p.results, found.duration)) for p in (clean, world)),
        end_section=True,
    )
    for name in found.names("alone"):
        alone, without = (found.point(part, controller, name) for part in ("alone", "without"))
        table.add_row(
            name,
            spelled(difference(alone.results, clean.results)),
            spelled(difference(without.results, world.results)),
        )
    return table


def _result(found: "Gap", wrote: list[Path]) -> dict[str, object]:
    from equipoise.studies.gap_results import mean, track_share, words

    return {
        "gap": str(wrote[0]),
        "files": [str(path) for path in wrote],
        "quick": found.quick,
        "trials": found.trials,
        "duration": found.duration,
        "world": found.world,
        "seed": found.seed,
        "points": [
            {
                "part": point.part,
                "controller": point.controller,
                "on_clean": point.on_clean,
                "name": point.name,
                "at": point.at,
                "mean_s": mean(point.results, found.duration).mean,
                "interval_s": list(mean(point.results, found.duration)[1:]),
                "causes": point.results.summary().causes,
                "track_share": track_share(point.results),
            }
            for point in found.points
        ],
        "words": list(words(found)),
    }
