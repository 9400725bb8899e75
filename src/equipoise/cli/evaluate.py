"""`equipoise evaluate`: how long a policy stands, with what confidence, and why it falls."""

import shlex
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equipoise.cli import next_step
from equipoise.cli.claim import certify, repeat
from equipoise.cli.destinations import check_output, choose_file
from equipoise.cli.options import (
    IN_AND_OUT,
    Base,
    Force,
    Held,
    Json,
    KnownActuator,
    MaxSpeed,
    PolicyFile,
    Seed,
    Tip,
    Workers,
    available_workers,
    only,
    read_actuator,
    read_arm,
    read_pendulum,
    read_policy,
)
from equipoise.cli.output import Output, verb
from equipoise.cli.trial_bar import trials_of
from equipoise.errors import ArtefactError, InputError

if TYPE_CHECKING:
    from equipoise.control.policy import TabularPolicy, TaskPolicy
    from equipoise.evaluation import Evaluation, TrialResults
    from equipoise.model.actuator import Actuator
    from equipoise.model.arms.arm import Arm
    from equipoise.model.pendulum import Pendulum
    from equipoise.settings import Settings

CLAIM = "A claim and its certificate"
DURATION = 60.0
"""Duration of a claim's trials by default [s]."""
QUANTILES = ("0.05", "0.25", "0.75", "0.95")
"""Names of the quantiles of survival in the JSON object."""


@verb
def evaluate(
    context: typer.Context,
    policy: PolicyFile = None,
    function: Annotated[
        str | None,
        typer.Option(
            "--policy",
            metavar="MODULE:NAME",
            help="Python instead: a function state -> u, or a class with act(state).",
        ),
    ] = None,
    trials: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="N", help="Number of trials; by default 200, or as --claim requires."
        ),
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Length of a trial; by default 60."),
    ] = None,
    world: Annotated[
        str,
        typer.Option(
            metavar="WORLD",
            help="ideal: the paper's plant; model: behind the actuator; twin:NAME or twin:FILE.",
        ),
    ] = "model",
    max_speed: MaxSpeed = None,
    actuator: KnownActuator = None,
    with_baselines: Annotated[
        bool,
        typer.Option("--baselines/--no-baselines", help="Run LQR, PD and random actions too."),
    ] = True,
    claim: Annotated[
        float | None,
        typer.Option(
            metavar="P",
            help="Claim that a trial lasts with at least this probability, e.g. 0.99, and write "
            "a certificate.",
            rich_help_panel=CLAIM,
        ),
    ] = None,
    confidence: Annotated[
        float,
        typer.Option(metavar="C", help="Confidence of the claim.", rich_help_panel=CLAIM),
    ] = 0.95,
    verify: Annotated[
        Path | None,
        typer.Option(
            metavar="CERTIFICATE",
            help="Repeat the trials of this certificate of POLICY.",
            rich_help_panel=CLAIM,
        ),
    ] = None,
    pendulum: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="To balance with --policy; of a POLICY, what it must be made for."
        ),
    ] = None,
    arm: Annotated[
        str | None,
        typer.Option(
            metavar="ARM", help="To use with --policy; of a POLICY, what it must be made for."
        ),
    ] = None,
    seed: Seed = 0,
    workers: Workers = None,
    held: Held = None,
    base: Base = None,
    tip: Tip = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Evaluation to write; with --claim the certificate, its trials beside it.",
            rich_help_panel=IN_AND_OUT,
            show_default="evaluation.json or certificate.json",
        ),
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Evaluate a policy: how long it stands, and why it falls.

    Four baselines run the same trials. Interrupted, the same command continues
    where it stopped. Exit code 1: the median trial ended early.

    --claim grants or refuses a claim by an exact bound. Claim and policy
    determine the number of trials and their seed, so a second attempt is the
    same. --verify repeats a certificate. Exit code 1: refused, or not repeated.
    """
    output = Output(as_json)
    if verify is not None:
        only(context, "--verify", "policy", "verify", "workers", "as_json")
        output.say(f"Repeating the trials of {verify}")
        repeat(output, verify, policy, workers)
        return
    if claim is not None:
        taken = ("policy", "claim", "confidence", "duration", "world", "trials", "workers")
        only(context, "--claim", *taken, "out", "force", "as_json")
        output.say(f"Certifying {policy or 'the policy that ships with Equipoise'}")
        length = DURATION if duration is None else duration
        certify(output, policy, claim, confidence, length, world, trials, workers, out, force)
        return
    output.say(f"Evaluating {function or policy or 'the policy that ships with Equipoise'}")
    destination = choose_file(output, out, "evaluation.json", policy, pendulum, force=force)

    from equipoise.artefacts import partial_path

    partial = partial_path(destination.path)
    check_output(partial)
    if function is not None and policy is not None:
        raise InputError(f"both {policy} and --policy {function} are given; give one of them")

    of_urdf = (held, base, tip)
    chosen: TaskPolicy
    of_arm = None if arm is None and not any(of_urdf) else read_arm(arm or "iiwa7", *of_urdf)
    if function is not None:
        from equipoise.control.bound_policy import load_policy

        chosen = load_policy(
            function,
            pendulum=read_pendulum(pendulum),
            arm=of_arm,
            actuator=read_actuator(actuator),
        )
    else:
        chosen = read_policy(policy)
        if pendulum is not None:
            _refuse_other_pendulum(chosen, pendulum)
        if of_arm is not None:
            _refuse_other_arm(chosen, of_arm)
    evaluation = _evaluate(
        output,
        chosen,
        world,
        read_actuator(actuator),
        trials,
        duration,
        max_speed,
        seed,
        workers,
        with_baselines,
        partial,
    )
    inputs = {"policy": evaluation.policy, "pendulum": evaluation.pendulum}
    with destination.claimed() as out:
        evaluation.save(out, command="evaluate", inputs=inputs)
    balanced = _say(output, evaluation)
    output.wrote(out)
    if function is not None:
        given = {"pendulum": pendulum, "arm": arm, "held": held, "base": base, "tip": tip}
        words = [(f"--{name}", str(told)) for name, told in given.items() if told is not None]
        count = len(evaluation.results.survival)
        output.next(*next_step.after_function(balanced, function, count, *chain(*words)))
    else:
        output.next(
            *next_step.after_evaluation(
                balanced,
                read_policy(policy),
                policy,
                world=world,
                pendulum=pendulum,
                actuator=actuator,
                max_speed=max_speed,
            )
        )
    output.result(_result(evaluation, out), bad=not balanced)


def _refuse_other_pendulum(policy: "TabularPolicy", asked: Path) -> None:
    if read_pendulum(asked).digest != policy.pendulum.digest:
        raise ArtefactError(
            f"the policy was trained for another pendulum than {asked}; train one for it: "
            f"equipoise train {shlex.quote(str(asked))}"
        )


def _refuse_other_arm(policy: "TabularPolicy", asked: "Arm") -> None:
    if asked.digest != policy.arm.digest:
        raise ArtefactError(
            f"the policy was trained on the {policy.arm.name}, not on this {asked.name}; train one "
            "for it with equipoise train --arm"
        )


def _settings(settings: "Settings", trials: int | None, duration: float | None) -> "Settings":
    """Return the settings with another number or length of trials."""
    changes = {"trials": trials, "duration": duration}
    from equipoise.settings import LONGEST_TRIAL, MOST_TRIALS

    if trials is not None and trials > MOST_TRIALS:
        raise InputError(f"--trials is {trials}; give a number from 1 to {MOST_TRIALS:,}")
    if duration is not None and not 0.01 <= duration <= LONGEST_TRIAL:
        raise InputError(
            f"--duration is {duration:g} s; give a number from 0.01 to {LONGEST_TRIAL:g} (a day)"
        )
    given = {name: value for name, value in changes.items() if value is not None}
    evaluation = settings.evaluation.model_copy(update=given)
    return settings.model_copy(update={"evaluation": evaluation})


def _evaluate(
    output: Output,
    policy: "TaskPolicy",
    world: str,
    actuator: "Actuator | None",
    trials: int | None,
    duration: float | None,
    max_speed: float | None,
    seed: int,
    workers: int | None,
    with_baselines: bool,
    partial: Path,
) -> "Evaluation":
    from equipoise.evaluation import evaluate

    settings = _settings(policy.settings, trials, duration)
    if max_speed is not None:
        if not 0.01 <= max_speed <= 2.0:
            raise InputError(f"--max-speed is {max_speed:g} m/s; give a number from 0.01 to 2")
        plant = settings.plant.model_copy(update={"max_speed": max_speed})
        settings = settings.model_copy(update={"plant": plant})
    runs = _runs(policy.pendulum) if with_baselines else 1
    with trials_of(output, "evaluate", policy, world, runs * settings.evaluation.trials) as done:
        return evaluate(
            policy,
            settings,
            world=world,
            actuator=actuator,
            seed=seed,
            with_baselines=with_baselines,
            workers=available_workers(workers),
            partial=partial,
            done=done,
        )


def _runs(pendulum: "Pendulum") -> int:
    """Return how many policies run all trials: the one asked for and the baselines."""
    from equipoise import paper
    from equipoise.control.baselines import baselines

    return 1 + len(baselines(pendulum.parameters(), paper.STEP))


def _say(output: Output, evaluation: "Evaluation") -> bool:
    """Print the table and the verdict; return whether the policy balances."""
    from rich.box import SIMPLE
    from rich.table import Table

    duration, trials = evaluation.duration, len(evaluation.results.survival)
    limit = evaluation.settings.plant.max_speed
    output.say(
        f"{trials} trials of {duration:g} s on the {evaluation.arm}, world {evaluation.world}, "
        f"seed {evaluation.seed}" + (f", flange below {limit:g} m/s" if limit else "")
    )
    if evaluation.friction is not None:
        output.say(f"pendulum: {evaluation.friction.words(evaluation.world)}")
    table = Table(box=SIMPLE, pad_edge=False)
    table.add_column("", no_wrap=True)
    for title in ("lasted", "share", "95 % interval", "median"):
        table.add_column(title, justify="right", no_wrap=True)
    table.add_column("ended by")
    for results in (evaluation.results, *evaluation.baselines):
        own = results is evaluation.results
        table.add_row(*_row(results), style="bold" if own else None)
    output.say(table)
    summary = evaluation.results.summary()
    if summary.median < duration:
        low, high = summary.quantiles[0], summary.quantiles[-1]
        output.say(
            f"It does not balance: the median trial ended after {summary.median:.1f} s of "
            f"{duration:g} s, nine in ten between {low:.1f} and {high:.1f} s.",
            style="red",
        )
        return False
    fell = summary.trials - summary.survived
    output.say(
        f"It balances: all {summary.trials} trials lasted {duration:g} s."
        if not fell
        else f"It balances: the median trial lasted all {duration:g} s; "
        f"{fell} of {summary.trials} did not.",
        style="green",
    )
    return True


def _row(results: "TrialResults") -> tuple[str, ...]:
    from equipoise.studies.formatting import percent

    summary = results.summary()
    low, high = summary.interval
    failures = {cause: n for cause, n in summary.causes.items() if cause != "lasted"}
    return (
        results.name,
        f"{summary.survived} of {summary.trials}",
        percent(summary.rate),
        f"{percent(low)} to {percent(high)}",
        f"{summary.median:.1f} s",
        ", ".join(f"{cause} {n}" for cause, n in failures.items()),
    )


def _result(evaluation: "Evaluation", out: Path) -> dict[str, object]:
    return {
        **_summary(evaluation.results),
        "duration": evaluation.duration,
        "yardsticks": {results.name: _summary(results) for results in evaluation.baselines},
        "world": evaluation.world,
        "seed": evaluation.seed,
        "evaluation": str(out),
    }


def _summary(results: "TrialResults") -> dict[str, object]:
    summary = results.summary()
    return {
        "trials": summary.trials,
        "survived": summary.survived,
        "rate": summary.rate,
        "interval": list(summary.interval),
        "median_s": summary.median,
        "quantiles_s": dict(zip(QUANTILES, summary.quantiles, strict=True)),
        "causes": summary.causes,
    }
