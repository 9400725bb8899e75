"""`equipoise evaluate`: measures how long a policy stands, and why it falls."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from equipoise.cli import options as opt
from equipoise.cli.claim import TRAIN_MORE, certify, repeat
from equipoise.cli.destinations import check_output, choose_file
from equipoise.cli.output import Output, trial_fields, verb
from equipoise.errors import InputError

if TYPE_CHECKING:
    from equipoise.control.policy import TaskPolicy
    from equipoise.worlds.evaluation import Evaluation, TrialResults

TASK = (
    *("policy", "named", "actuator", "pendulum", "arm"),
    *("held", "base", "tip", "settings_file"),
)
"""Options that choose a policy and its task."""
CLAIM = "A claim and its certificate"
CLAIM_OPTIONS = (
    "claim",
    "confidence",
    "duration",
    "world",
    "trials",
    "workers",
    "ray",
    "out",
    "force",
)
"""Options that go with `--claim`."""
BASELINES = 4
"""Number of baselines; it only scales a progress bar."""


@verb
def evaluate(
    context: typer.Context,
    policy: Path | None = opt.POLICY,
    named: Path | None = opt.value("POLICY", "The same, as an option.", "--policy"),
    trials: int | None = opt.value(
        "N", "Number of trials; by default 200, or as --claim requires.", min=1
    ),
    duration: float | None = opt.value("SECONDS", "Duration of a trial; by default 60."),
    world: str = opt.value(
        "WORLD",
        "ideal: the paper's plant; model: behind the actuator; twin:NAME or twin:FILE; "
        "coppeliasim://HOST:PORT.",
        default="model",
    ),
    max_speed: float | None = opt.MAX_SPEED,
    actuator: str | None = opt.KNOWN_ACTUATOR,
    with_baselines: bool = opt.flag(
        "--baselines/--no-baselines", "Run LQR, PD and random actions too.", default=True
    ),
    claim: float | None = opt.value(
        "P",
        "Claim that a trial lasts with at least this probability, e.g. 0.99, and write a "
        "certificate.",
        panel=CLAIM,
    ),
    confidence: float = opt.value("C", "Confidence of the claim.", panel=CLAIM, default=0.95),
    verify: Path | None = opt.value(
        "CERTIFICATE", "Repeat the trials of this certificate of POLICY.", panel=CLAIM
    ),
    pendulum: Path | None = opt.TASK_PENDULUM,
    arm: str | None = opt.TASK_ARM,
    settings_file: Path | None = opt.SETTINGS_FILE,
    seed: int = opt.SEED,
    workers: int | None = opt.WORKERS,
    ray: str | None = opt.RAY,
    held: str | None = opt.HELD,
    base: str | None = opt.BASE,
    tip: str | None = opt.TIP,
    out: Path | None = opt.out(
        "Evaluation to write; with --claim the certificate, its trials beside it.",
        "evaluation.json or certificate.json",
    ),
    force: bool = opt.FORCE,
    as_json: bool = opt.JSON,
) -> None:
    """Evaluate a policy: how long it stands, and why it falls.

    Four baselines run the same trials. After an interruption the same command
    continues. Exit code 1: the median trial ended early.

    --claim grants or refuses a claim by an exact bound. Claim and policy
    determine the number of trials and their seed, so a second attempt is the
    same. --verify repeats a certificate. Exit code 1: refused, or not repeated.
    """
    output = Output(as_json)
    if named is not None and policy is not None:
        raise InputError(f"both {policy} and --policy {named} are given; give one of them")
    policy = policy or named
    of_urdf = opt.read_arm(arm or "iiwa7", held, base, tip) if arm or held or base or tip else None
    given = (policy, pendulum, of_urdf, actuator, settings_file)
    threads = opt.executor(workers, ray)
    if verify is not None:
        opt.only(context, "--verify", *TASK, "verify", "workers", "ray", "as_json")
        output.say(f"Repeating the trials of {verify}")
        repeat(output, verify, policy, _of_claim(opt.read_policy(*given), actuator), threads)
        return
    if claim is not None:
        opt.only(context, "--claim", *TASK, *CLAIM_OPTIONS, "as_json")
        output.say(f"Certifying {policy or 'the shipped policy'}")
        task = _of_claim(opt.read_policy(*given), actuator)
        length = 60.0 if duration is None else duration
        certify(output, policy, task, claim, confidence, length, world, trials, threads, out, force)
        return
    output.say(f"Evaluating {policy or 'the shipped policy'}")
    destination = choose_file(output, out, "evaluation.json", policy, pendulum, force=force)

    from equipoise.artefacts import partial_path
    from equipoise.settings import LONGEST_TRIAL, MOST_TRIALS
    from equipoise.worlds.evaluation import evaluate

    partial = partial_path(destination.path)
    check_output(partial)
    opt.check_range("--trials", trials, 1, MOST_TRIALS)
    opt.check_range("--duration", duration, 0.01, LONGEST_TRIAL, " s")
    opt.check_range("--max-speed", max_speed, 0.01, 2.0, " m/s")
    task, response = opt.read_policy(*given), opt.read_actuator(actuator)
    output.warn(opt.shortfall(task))
    old = task.settings
    settings = opt.changed(
        old,
        evaluation=opt.changed(old.evaluation, trials=trials, duration=duration),
        plant=opt.changed(old.plant, max_speed=max_speed),
    )
    total = settings.evaluation.trials * (1 + BASELINES * with_baselines)
    with output.trials("evaluate", task, world, total) as done:
        evaluation = evaluate(
            task,
            settings,
            world=world,
            actuator=response,
            seed=seed,
            with_baselines=with_baselines,
            workers=threads,
            partial=partial,
            done=done,
        )
    inputs = {"policy": evaluation.policy, "pendulum": evaluation.pendulum}
    with destination.claimed() as out:
        evaluation.save(out, command="evaluate", inputs=inputs)
    balanced = _say(output, evaluation)
    output.wrote(out)
    output.next(*(("deploy", policy) if balanced else TRAIN_MORE))
    output.result(
        **trial_fields(evaluation.results),
        duration=evaluation.duration,
        yardsticks={results.name: trial_fields(results) for results in evaluation.baselines},
        world=evaluation.world,
        seed=evaluation.seed,
        evaluation=out,
        bad=not balanced,
    )


def _of_claim(policy: "TaskPolicy", actuator: str | None) -> "TaskPolicy":
    """Return the policy of a claim, which is tested with the policy's own actuator."""
    from equipoise.control.policy import TabularPolicy

    if actuator is not None and isinstance(policy, TabularPolicy):
        raise InputError(
            "a claim about a table is tested with the actuator of its training; leave out "
            "--actuator"
        )
    return policy


def _say(output: Output, evaluation: "Evaluation") -> bool:
    """Print the table and the verdict; return whether the policy balances."""
    duration, trials = evaluation.duration, len(evaluation.results.survival)
    limit = evaluation.settings.plant.max_speed
    output.say(
        f"{trials} trials of {duration:g} s on the {evaluation.arm}, world {evaluation.world}, "
        f"seed {evaluation.seed}" + (f", flange below {limit:g} m/s" if limit else "")
    )
    if evaluation.friction is not None:
        output.say(f"pendulum: {evaluation.friction.describe(evaluation.world)}")
    columns = ("", "lasted", "share", "95 % interval", "median", "ended by<")
    rows = [_row(results) for results in (evaluation.results, *evaluation.baselines)]
    output.table(columns, rows, bold=0)
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
    which = f"the median trial lasted all {duration:g} s; {fell} of {summary.trials} did not"
    if not fell:
        which = f"all {summary.trials} trials lasted {duration:g} s"
    output.say(f"It balances: {which}.", style="green")
    return True


def _row(results: "TrialResults") -> tuple[str, ...]:
    from equipoise.worlds.formatting import percent

    summary = results.summary()
    low, high = summary.interval
    failures = {cause: n for cause, n in summary.outcomes.items() if cause != "lasted"}
    return (
        results.name,
        f"{summary.survived} of {summary.trials}",
        percent(summary.rate),
        f"{percent(low)} to {percent(high)}",
        f"{summary.median:.1f} s",
        ", ".join(f"{cause} {n}" for cause, n in failures.items()),
    )
