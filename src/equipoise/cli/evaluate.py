"""`equipoise evaluate`: measures how long a policy stands, and why it falls."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from equipoise.cli import options as opt
from equipoise.cli.output import Output
from equipoise.cli.verb import Options, command, verb
from equipoise.errors import InputError

if TYPE_CHECKING:
    from equipoise.worlds.certification import Certificate
    from equipoise.worlds.evaluation import Evaluation, TrialResults


class Report(opt.Files):
    """Files."""

    out: Path | None = None
    """File for the evaluation or certificate; by default none is written."""


class Trials(Options):
    """Trials."""

    world: str = "model"
    """ideal: the paper's plant; model: behind the actuator; twin:NAME, twin:FILE, or
    coppeliasim://HOST:PORT."""
    trials: Annotated[int | None, Field(ge=1)] = None
    """Number of trials; by default 200, or as --claim needs."""
    duration: float | None = None
    """Duration of a trial [s]; by default 60."""
    baselines: bool = True
    """Run LQR, PD and random actions too."""
    claim: float | None = None
    """Claim that a trial lasts with at least this probability, e.g. 0.99."""


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
    """Evaluate a policy: how long it stands, and why it falls.

    POLICY is a table from equipoise train, a network (.onnx), Python
    MODULE:NAME, lqr, lqr-snapped, pd or random; by default the shipped table.
    Four baselines run the same trials. Exit code 1: the median trial ended
    early.

    --claim grants or refuses a claim at 95 % confidence, by an exact bound.
    Claim and policy determine the number of trials and their seed, so a second
    attempt is the same. Exit code 1: refused.
    """
    from equipoise.control.bound_policy import BUILT_IN
    from equipoise.executors import counted
    from equipoise.worlds import setup_of
    from equipoise.worlds.certification import certify, make_claim
    from equipoise.worlds.evaluation import evaluate

    chosen = task.read(policy)
    work: partial[Any]
    describe: Callable[[Any], dict[str, Any]]
    if trials.claim is None:
        given = {"trials": trials.trials, "duration": trials.duration}
        changes = {name: value for name, value in given.items() if value is not None}
        settings = chosen.settings.evaluation
        changed = settings.model_validate({**dict(settings), **changes})
        settings = chosen.settings.model_copy(update={"evaluation": changed})
        setup_of(chosen, trials.world, settings, task.actuator)
        total = changed.trials * (1 + len(BUILT_IN) * trials.baselines)
        work = partial(
            evaluate,
            chosen,
            settings,
            world=trials.world,
            actuator=task.actuator,
            seed=random.seed,
            with_baselines=trials.baselines,
        )
        describe = _measured
    else:
        if random.seed or task.actuator is not None:
            raise InputError("a claim fixes seed and actuator; leave out --seed and --actuator")
        length = 60.0 if trials.duration is None else trials.duration
        claim = make_claim(trials.claim, duration=length, world=trials.world, trials=trials.trials)
        total, work, describe = claim.trials, partial(certify, chosen, claim), _certified
    out = files.out and files.file(output, "", policy, task.pendulum)
    output.warn(opt.shortfall(chosen))
    with output.progress() as show:
        found = work(workers=random.threads, done=counted("evaluate", total, show))
    if out is not None:
        inputs = {"policy": chosen.digest, "pendulum": chosen.pendulum.digest}
        found.save(out, command="evaluate", inputs=inputs)
    world = trials.world if trials.world.startswith("twin:") else None
    then = command("deploy", policy, task, world=world)
    output.result(**describe(found), file=out, then=then)


def _measured(evaluation: "Evaluation") -> dict[str, Any]:
    """Return the results of trials and their baselines as fields of a result, with exit code."""
    fields = _trial_fields(evaluation.results)
    return {
        "world": evaluation.world,
        "arm": evaluation.arm,
        "duration_s": evaluation.duration,
        "seed": evaluation.seed,
        **fields,
        "baselines": {each.name: _trial_fields(each) for each in evaluation.baselines},
        "code": int(fields["median_s"] < evaluation.duration),
    }


def _trial_fields(results: "TrialResults") -> dict[str, Any]:
    """Return the summary of trials as fields of a result."""
    found = results.summary()
    names = ("survived", "trials", "rate", "interval", "outcomes")
    return {name: getattr(found, name) for name in names} | {"median_s": found.median}


def _certified(certificate: "Certificate") -> dict[str, Any]:
    """Return a verdict about a claim as fields of a result, with exit code."""
    claim = certificate.claim
    return {
        "claim": str(claim),
        "granted": certificate.granted,
        "bound": certificate.bound,
        "trials": claim.trials,
        "failures": certificate.failed,
        "allowed": claim.allowed,
        "outcomes": _trial_fields(certificate.evaluation.results)["outcomes"],
        "code": int(not certificate.granted),
    }
