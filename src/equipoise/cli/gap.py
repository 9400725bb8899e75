"""`equipoise gap`: measures what each effect of the twin costs a policy, and what cures it."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from equipoise.cli import options as opt
from equipoise.cli.destinations import choose_file, pictures
from equipoise.cli.output import Output, verb

if TYPE_CHECKING:
    from equipoise.studies.gap_results import Controller, Gap, GapPoint

STUDY = ("quick", "trials", "duration", "world", "seed")
POINT = ("part", "controller", "on_clean", "name", "at")
"""Fields of the study, and of each of its points, in the JSON object."""


@verb
def gap(
    policy: Path | None = opt.POLICY,
    paper_policy: Path | None = opt.value(
        "FILE", "Policy trained as the paper describes; by default one is trained here."
    ),
    world: str = opt.TWIN,
    actuator: str | None = opt.KNOWN_ACTUATOR,
    pendulum: Path | None = opt.TASK_PENDULUM,
    arm: str | None = opt.TASK_ARM,
    settings_file: Path | None = opt.SETTINGS_FILE,
    trials: int | None = opt.value("N", "Trials of each point; 40, or 8 with --quick.", min=2),
    duration: float | None = opt.value("SECONDS", "Duration of a trial; 60, or 20 with --quick."),
    quick: bool = opt.flag("--quick", "Fewer points and trials."),
    seed: int = opt.SEED,
    workers: int | None = opt.WORKERS,
    ray: str | None = opt.RAY,
    out: Path | None = opt.out("Study to write, its figure beside it.", "gap.json"),
    force: bool = opt.FORCE,
    as_json: bool = opt.JSON,
) -> None:
    """Separate the gap between training plant and twin into its effects.

    A policy with its cures, without prediction and without bias estimate runs
    beside a table that was trained as the paper describes. Takes some minutes
    on two cores, and half a minute with --quick.
    """
    output = Output(as_json)
    output.say(f"Measuring the gap of {policy or 'the shipped policy'} to {world}")

    def beside(path: Path) -> tuple[Path, ...]:
        return *pictures(path), *(() if paper_policy else (_paper_policy(path),))

    destination = choose_file(
        output, out, "gap.json", policy, paper_policy, pendulum, force=force, beside=beside
    )
    opt.check_range("--duration", duration, 0.01, 3600.0, " s")

    from equipoise.apps.report.figures.gap import gap_figure
    from equipoise.apps.report.style import save
    from equipoise.control.policy import TabularPolicy
    from equipoise.studies import compilation
    from equipoise.studies import gap as study
    from equipoise.studies.progress import TrainingProgress, counted

    chosen = opt.read_policy(policy, pendulum, arm, actuator, settings_file)
    known = opt.read_actuator(actuator)
    total = study.trials_of(world, quick=quick, trials=trials)
    settings, threads = study.paper_settings(quick=quick), opt.executor(workers, ray)
    with output.stages() as show:
        with compilation.compiling(show, compilation.FUNCTIONS + compilation.TWIN_FUNCTIONS):
            compilation.compile_training(chosen.arm, settings)
            compilation.compile_trials(chosen, world)
        if paper_policy is None:
            progress = TrainingProgress(settings, show, of="paper").of_learner()
            other = study.train_paper(chosen, quick=quick, seed=seed, workers=threads, **progress)
        else:
            other = TabularPolicy.load(paper_policy)
        found = study.gap(
            chosen,
            world=world,
            paper_policy=other,
            actuator=known,
            trials=trials,
            duration=duration,
            quick=quick,
            seed=seed,
            workers=threads,
            done=counted("gap", total, show),
        )
    inputs = {"policy": found.policy, "paper policy": found.paper_policy}
    with destination.claimed() as out:
        found.save(out, command="gap", inputs=inputs)
        wrote = [out, *save(gap_figure(found), out.with_suffix(""))]
        if paper_policy is None:
            wrote.append(_paper_policy(out))
            other.save(wrote[-1], command="gap", inputs={"pendulum": chosen.pendulum.digest})
    _say(output, found)
    output.wrote(*wrote)
    output.next("evaluate", policy, "--world", world, "--claim", "0.99")
    output.result(**_result(found, wrote))


def _paper_policy(out: Path) -> Path:
    return out.with_name(f"{out.stem}-paper-policy.json")


def _say(output: Output, found: "Gap") -> None:
    from equipoise.studies.gap_results import LABELS, sentences

    error = abs(found.delay - found.world_settings.transport)
    if error > found.settings.controller.margin:
        output.warn(
            f"the cures assume a delay of {1e3 * found.delay:.1f} ms, and {found.world} has "
            f"{1e3 * found.world_settings.transport:.1f} ms; identify that twin and give its "
            "--actuator"
        )
    output.say(
        f"{found.trials} trials of {found.duration:g} s at each point, on the {found.arm}, world "
        f"{found.world}, seed {found.seed}"
    )
    output.say(f"pendulum: {found.friction.describe(found.world)}")
    output.say("\nMean survival [s], in brackets the share of the falls on the track limit [%]")
    _say_curves(output, found, "delay")
    _say_curves(output, found, "zero")
    for controller in found.by_effect:
        output.say(f"Effect by effect, {LABELS[controller]}")
        columns = ("", "added alone, clean twin", "removed alone, twin")
        output.table(columns, list(_effects(found, controller)), section=0)
    if names := found.names("named"):
        output.say("Named worlds: mean survival [s]")
        columns = ("", "actuator identified there", "actuator of the training")
        output.table(columns, [_named(found, name) for name in names], section=None)
    output.points(sentences(found))


def _named(found: "Gap", name: str) -> Sequence[str]:
    from equipoise.studies.gap_results import CURED, UNTUNED

    return name, *(_cell(found, found.point("named", who, name)) for who in (CURED, UNTUNED))


def _say_curves(output: Output, found: "Gap", part: Literal["delay", "zero"]) -> None:
    curves = {key: found.curve(part, *key) for key in found.curves}
    title = {"delay": "transport delay", "zero": "zero error"}[part]
    points = next(iter(curves.values()))
    output.table(
        [title, *(point.condition for point in points)],
        [
            [f"{controller}, clean twin" if on_clean else controller]
            + [_cell(found, point) for point in curve]
            for (controller, on_clean), curve in curves.items()
            if curve
        ],
    )


def _cell(found: "Gap", point: "GapPoint") -> str:
    from equipoise.studies.gap_results import mean, track_share

    share = track_share(point.results)
    ends = "" if share is None else f" ({100.0 * share:.0f})"
    return f"{mean(point.results, found.duration).mean:.1f}{ends}"


def _effects(found: "Gap", controller: "Controller") -> Iterator[Sequence[str]]:
    from equipoise.studies.gap_results import difference, mean

    plant, clean, world = (
        found.point(part, controller).results for part in ("plant", "clean", "world")
    )
    own = mean(plant, found.duration).mean
    base = (mean(results, found.duration).text for results in (clean, world))
    yield (f"none ({own:.1f} s on its own plant)", *base)
    for name in found.names("alone"):
        alone, without = (found.point(p, controller, name).results for p in ("alone", "without"))
        yield name, difference(alone, clean).text, difference(without, world).text


def _result(found: "Gap", wrote: list[Path]) -> dict[str, Any]:
    from equipoise.studies.gap_results import mean, sentences, track_share

    return {
        "gap": str(wrote[0]),
        "files": [str(path) for path in wrote],
        **{name: getattr(found, name) for name in STUDY},
        "points": [
            {
                **{name: getattr(point, name) for name in POINT},
                "mean_s": mean(point.results, found.duration).mean,
                "interval_s": list(mean(point.results, found.duration)[1:]),
                "causes": point.results.summary().outcomes,
                "track_share": track_share(point.results),
            }
            for point in found.points
        ],
        "words": list(sentences(found)),
    }
