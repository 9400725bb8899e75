"""`equipoise reproduce`: reproduces the whole paper, from a free swing to a report."""

import time
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from equipoise.cli import options as opt
from equipoise.cli.destinations import Destination, check_folder, choose_file
from equipoise.cli.output import Interrupted, Output, trial_fields, verb
from equipoise.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from equipoise.studies.progress import Show
    from equipoise.studies.reproduction import ReproductionRequest

FOLDER = "equipoise-report"
"""Folder by default."""


@verb
def reproduce(
    context: typer.Context,
    quick: bool = opt.flag("--quick", "Fewer episodes and trials: under a minute."),
    recipe: str = opt.RECIPE,
    arm: str = opt.ARM,
    seed: int = opt.SEED,
    workers: int | None = opt.WORKERS,
    swing: Path | None = opt.value(
        "CSV",
        "Recorded swing, as identify reads it; by default a simulated one.",
        panel=opt.RECORDING,
    ),
    start: float | None = opt.START,
    end: float | None = opt.END,
    counts_per_rev: int | None = opt.COUNTS_PER_REV,
    from_upright: bool = opt.FROM_UPRIGHT,
    columns: str | None = opt.COLUMNS,
    held: str | None = opt.HELD,
    base: str | None = opt.BASE,
    tip: str | None = opt.TIP,
    out: Path | None = opt.out("Folder for all files.", FOLDER, "DIR"),
    force: bool = opt.FORCE,
    settings_file: Path | None = opt.SETTINGS_FILE,
    settings: list[str] | None = opt.SET,
    as_json: bool = opt.JSON,
) -> None:
    """Reproduce the paper, from a free swing to a report.

    Identification, training, evaluation, a run on the digital twin and a short
    study of the gap. Writes every file to a folder, with a self-contained
    report in HTML. After an interruption the same command continues.
    """
    output = Output(as_json)
    begin = time.perf_counter()
    output.say(f"Reproducing the paper{f' from {swing}' if swing else ''}")

    from equipoise.settings import resolve

    resolved = resolve(recipe, settings_file, settings or ())
    machine = opt.read_arm(arm, held, base, tip)
    recording = None
    if swing is None:
        taken = context.params.keys() - set(opt.SWING_OPTIONS)
        opt.only(context, "a simulated swing", *taken, hint="give a recording with --swing")
    if swing is not None:
        from equipoise.trajectory import read_swing

        recording = read_swing(swing, **opt.swing_options(context))
    from equipoise.apps.report.page import PAGE, build
    from equipoise.studies import reproduction as study
    from equipoise.studies.results import POLICY

    request = study.make_request(recording, machine, resolved, seed, quick)
    destination, resumed = _choose(output, out, request, force)
    with ExitStack() as stack:
        folder = destination.path if resumed else stack.enter_context(destination.claimed())
        if not resumed:
            study.discard(folder)
        stack.enter_context(_going_on(destination))
        show = stack.enter_context(output.stages())
        found = study.reproduce(
            folder,
            swing=recording,
            arm=machine,
            settings=resolved,
            seed=seed,
            quick=quick,
            workers=workers,
            report=show,
            finish=lambda folder: _draw(build, folder, show),
        )
        page = folder / PAGE
    output.points(found.verdict)
    output.warn(found.results.policy.shortfall)
    output.wrote(page)
    output.next("evaluate", folder / POLICY, "--trials", "1000")
    evaluation, run = found.results.evaluation, found.results.run
    trials = trial_fields(evaluation.results)
    output.result(
        out=folder,
        report=page,
        verdict=list(found.verdict),
        **trials,
        duration=evaluation.duration,
        world=run.conditions.world,
        lasted_s=run.lasted,
        outcome=run.outcome,
        wall_s=time.perf_counter() - begin,
        bad=trials["median_s"] < evaluation.duration,
    )


def _choose(
    output: Output, given: Path | None, request: "ReproductionRequest", force: bool
) -> tuple[Destination, bool]:
    """Return the folder, and whether it holds an interrupted reproduction to continue."""
    from equipoise.studies.reproduction import differences

    first = Destination(Path(FOLDER) if given is None else given, folder=True, force=force)
    check_folder(first.path)
    candidates = [first] if given else takewhile(lambda one: one.existing(), first.numbered())
    for one in () if force else candidates:
        other = differences(one.path, request)
        if other == []:
            output.say(f"Continuing the interrupted reproduction in {one.path}")
            return one, True
        if other and given:
            raise InputError(
                f"{given} holds an interrupted reproduction with another {' and '.join(other)}; "
                "give the same inputs, another --out, or --force to replace it"
            )
    return choose_file(output, given, FOLDER, force=force, suffix=""), False


@contextmanager
def _going_on(destination: Destination) -> Generator[None]:
    """Print after an interruption how to continue."""
    from equipoise.studies.reproduction import unfinished_path

    try:
        yield
    except KeyboardInterrupt:
        if not unfinished_path(destination.path).exists():
            raise
        raise Interrupted(without="--force") from None


def _draw(
    build: "Callable[[Path, Callable[[str, float], None]], Path]", folder: Path, show: "Show"
) -> None:
    """Draw the report as a stage."""
    from equipoise.studies.progress import ProgressReporter

    show(ProgressReporter("report"))
    build(folder, lambda name, share: show(ProgressReporter("report", share, text=name)))
