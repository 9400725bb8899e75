"""`equipoise evaluate`: measures how long a policy balances, and why it fails."""

from math import ceil, log
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from equipoise.cli import options as opt
from equipoise.cli.options import Options, command, verb
from equipoise.cli.output import Output
from equipoise.errors import InputError

if TYPE_CHECKING:
    from equipoise.worlds.evaluation import Summary, TrialResults


class Report(opt.Files):
    """Files."""

    out: Path | None = None
    """File for the evaluation; by default none is written."""


class Trials(Options):
    """Trials."""

    world: str = "model"
    """ideal: the paper's plant; model: with the actuator; twin:NAME ({worlds}); twin:FILE; or
    coppeliasim://HOST:PORT."""
    trials: Annotated[int | None, Field(ge=1)] = None
    """Number of trials; by default 200, or as --claim needs."""
    duration: float | None = None
    """Duration of a trial [s]; by default 60."""
    no_baselines: bool = False
    """Leave out the trials of LQR, PD and random actions."""
    claim: Annotated[float | None, Field(gt=0.0, lt=1.0)] = None
    """Claim that a trial survives with at least this probability, e.g. 0.99."""


@verb
def evaluate(
    output: Output,
    policy: Path | None = None,
    *,
    trials: Trials,
    task: opt.Task,
    random: opt.Random,
    files: Report,
) -> None:
    """Evaluate a policy: how long it balances, and why it fails.

    POLICY is a table from equipoise train, a network (.onnx), Python
    MODULE:NAME, lqr, lqr-snapped, pd or random; by default the shipped table.
    Four baselines run the same trials. Exit code 1: the median trial ended
    early.

    --claim grants or refuses a claim at 95 % confidence, by an exact bound. It
    determines the number of trials, and leaves out the baselines. Exit code 1:
    refused.
    """
    from equipoise.control.bound_policy import BUILT_IN
    from equipoise.executors import counted
    from equipoise.worlds import setup_of
    from equipoise.worlds.evaluation import evaluate, trials_for

    chosen = task.read(policy)
    given = {"trials": trials.trials, "duration": trials.duration}
    if trials.claim is not None:
        given["trials"] = trials.trials or trials_for(trials.claim)
        check_claim(given["trials"], trials.claim)
    changes = {name: value for name, value in given.items() if value is not None}
    settings = chosen.settings.evaluation
    changed = settings.model_validate({**dict(settings), **changes})
    settings = chosen.settings.model_copy(update={"evaluation": changed})
    setup_of(chosen, trials.world, settings, task.actuator)
    out = files.out and files.file(output, "", policy, task.pendulum)
    output.warn(chosen.shortfall)
    with_baselines = not trials.no_baselines and trials.claim is None
    total = changed.trials * (1 + len(BUILT_IN) * with_baselines)
    with output.progress() as show:
        evaluation = evaluate(
            chosen,
            settings,
            world=trials.world,
            actuator=task.actuator,
            seed=random.seed,
            with_baselines=with_baselines,
            workers=random.threads,
            done=counted("evaluate", total, show),
        )
    if out is not None:
        inputs = {"policy": evaluation.policy, "pendulum": evaluation.pendulum}
        evaluation.save(out, command="evaluate", inputs=inputs)
    fields = _trial_fields(evaluation.results)
    code = int(fields["median_s"] < evaluation.duration)
    if trials.claim is not None:
        verdict = claim_fields(evaluation.results.summary(), trials.claim)
        fields, code = verdict | fields, int(not verdict["granted"])
    world = trials.world if trials.world.startswith("twin:") else None
    output.result(
        **fields,
        duration_s=evaluation.duration,
        world=evaluation.world,
        arm=evaluation.arm,
        seed=evaluation.seed,
        baselines={each.name: _trial_fields(each) for each in evaluation.baselines},
        file=out,
        code=code,
        then=command("deploy", policy, task, world=world),
    )


def _trial_fields(results: "TrialResults") -> dict[str, Any]:
    """Return the summary of trials as fields of a result."""
    found = results.summary()
    counts = {name: getattr(found, name) for name in ("survived", "trials", "rate", "outcomes")}
    return counts | {"interval_95": found.interval, "median_s": found.median}


def check_claim(trials: int, claim: float) -> None:
    """Check that trials can grant a claim.

    Raises:
        InputError: They are too few, even if all survive.
    """
    from equipoise.worlds.evaluation import CLAIM_CONFIDENCE, allowed_failures

    if allowed_failures(trials, claim) < 0:
        least = ceil(log(1.0 - CLAIM_CONFIDENCE) / log(claim))
        raise InputError(
            f"{trials:,} trials cannot grant a claim of {claim:g}, even if all survive; give "
            f"--trials {least} or more"
        )


def claim_fields(found: "Summary", claim: float) -> dict[str, Any]:
    """Return the verdict on a claim as fields of a result."""
    from equipoise.worlds.evaluation import CLAIM_CONFIDENCE, allowed_failures, lower_bound

    bound = lower_bound(found.survived, found.trials, CLAIM_CONFIDENCE)
    return {
        "granted": bound >= claim,
        "claim": claim,
        "bound_95": bound,
        "allowed_failures": allowed_failures(found.trials, claim),
    }
