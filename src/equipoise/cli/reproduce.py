"""`equipoise reproduce`: the whole paper, from a free swing to a report."""

import shlex
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equipoise.cli.destinations import check_folder
from equipoise.cli.options import (
    IN_AND_OUT,
    RECORDING,
    ArmName,
    Base,
    Columns,
    CountsPerRev,
    End,
    FromUpright,
    Held,
    Json,
    Seed,
    Set,
    SettingsFile,
    Start,
    Tip,
    Workers,
    read_arm,
)
from equipoise.cli.output import FIRST_WORDS, Output, stoppable, verb
from equipoise.errors import InputError

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

NOT_BALANCED = 1


@verb
def reproduce(
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer episodes and trials: under a minute.")
    ] = False,
    recipe: Annotated[
        str,
        typer.Option(metavar="NAME", help="robust, or paper: the barest reading of its text."),
    ] = "robust",
    arm: ArmName = "iiwa7",
    seed: Seed = 0,
    workers: Workers = None,
    swing: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV",
            help="Begin with it, as identify reads it, instead of a simulated one.",
            rich_help_panel=RECORDING,
        ),
    ] = None,
    start: Start = None,
    end: End = None,
    counts_per_rev: CountsPerRev = None,
    from_upright: FromUpright = False,
    columns: Columns = None,
    held: Held = None,
    base: Base = None,
    tip: Tip = None,
    out: Annotated[
        Path,
        typer.Option(metavar="DIR", help="Folder for all files.", rich_help_panel=IN_AND_OUT),
    ] = Path("equipoise-report"),
    settings_file: SettingsFile = None,
    settings: Set = None,
    as_json: Json = False,
) -> None:
    """Reproduce the paper, from a free swing to a report.

    Identification, training, evaluation, a run on the digital twin and a short
    study of the gap: leaves every file in a folder, with a report in HTML that
    needs nothing else.
    """
    output = Output(as_json)
    begin = time.perf_counter()
    output.say(f"Reproducing the paper {f'from {swing} ' if swing else ''}into {out}")
    check_folder(out)

    from equipoise.settings import resolve

    resolved = resolve(recipe, settings_file, settings or ())
    machine = read_arm(arm, held, base, tip)
    recording = None
    if swing is None and any((start, end, counts_per_rev, from_upright, columns)):
        raise InputError(
            "--start, --end, --counts-per-rev, --from-upright and --columns belong to a recorded "
            "swing; give it with --swing"
        )
    if swing is not None:
        from equipoise.trajectory import read_swing

        recording = read_swing(
            swing,
            counts_per_rev=counts_per_rev,
            from_upright=from_upright,
            start=start,
            end=end,
            columns=columns,
        )
    from equipoise.report.page import build
    from equipoise.studies.reproduction import Progress
    from equipoise.studies.reproduction import reproduce as study

    with _shown(output) as stages, stoppable() as check:

        def report(progress: Progress) -> None:
            check()
            stages.show(progress.stage, progress.share, progress.text)

        found = study(
            out,
            swing=recording,
            arm=machine,
            settings=resolved,
            recipe=recipe,
            seed=seed,
            quick=quick,
            workers=workers,
            report=report,
        )
        page = build(out, lambda name, share: report(Progress("report", share, name)))
    output.points(found.verdict)
    output.wrote(page)
    output.next(*shlex.split(found.next_command)[1:])
    summary, run = found.results.evaluation.results.summary(), found.results.run
    output.result(
        {
            "out": str(out),
            "report": str(page),
            "verdict": list(found.verdict),
            "trials": summary.trials,
            "duration": found.results.evaluation.duration,
            "survived": summary.survived,
            "rate": summary.rate,
            "interval": list(summary.interval),
            "median_s": summary.median,
            "causes": summary.causes,
            "world": run.conditions.world,
            "lasted_s": run.lasted,
            "cause": run.conditions.cause,
            "wall_s": time.perf_counter() - begin,
        }
    )
    if summary.median < found.results.evaluation.duration:
        raise typer.Exit(NOT_BALANCED)


class _Stages:
    """Shows the stage that is under way as a bar, and each that is done as a line."""

    def __init__(self, output: Output, bar: "Bar") -> None:
        self._output, self._bar = output, bar
        self._task = bar.add_task("", total=1.0)
        self._stage, self._begin = "", 0.0

    def show(self, stage: str, share: float, text: str = "") -> None:
        if stage != self._stage:
            self.end()
            self._stage, self._begin = stage, time.perf_counter()
        words = text or (FIRST_WORDS if stage == "train" else "")
        self._bar.update(self._task, completed=share, description=f"{stage}  {words}")

    def end(self) -> None:
        if self._stage:
            took = time.perf_counter() - self._begin
            self._output.say(f"  {self._stage:<10}{took:6.1f} s", style="dim")
        self._stage = ""


@contextmanager
def _shown(output: Output) -> Generator[_Stages]:
    from rich.progress import BarColumn, TextColumn

    words = TextColumn("{task.description}", markup=False)
    with output.progress(words, BarColumn(bar_width=None)) as bar:
        stages = _Stages(output, bar)
        yield stages
        stages.end()
