"""`equipoise evaluate`: measures how long a policy balances, and why it fails."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from equipoise.cli import options as opt
from equipoise.cli.output import Output
from equipoise.cli.verb import Options, command, verb
from equipoise.errors import InputError

if TYPE_CHECKING:
    from equipoise.worlds.evaluation import TrialResults


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
    claim: float | None = None
    """Claim that a trial survives with at least this probability, e.g. 0.99."""


@verb
def evaluate(
    output: Output,
    policy: Path | None = None,
    *,
    trials: Trials,
    task: opt.Task,
    random: opt.Random,
    files: opt.Files,
) -> None:
    """Evaluate a policy: how long it balances, and why it fails.

    POLICY is a table from equipoise train, a network (.onnx), Python
    MODULE:NAME, lqr, lqr-snapped, pd or random; by default the shipped table.
    Four baselines run the same trials. Exit code 1: the median trial ended
    early.

    --claim grants or refuses a claim at 95 % confidence, by an exact bound.
    Claim and policy determine the number of trials and their seed, so a second
    attempt is the same. Exit code 1: refused.
    """
    if trials.claim is not None:
        certify(output, policy, trials.claim, trials, task, random, files)
        return
    from equipoise.control.bound_policy import BUILT_IN
    from equipoise.executors import counted
    from equipoise.worlds.evaluation import evaluate

    chosen = task.read(policy)
    out = files.file("evaluation.json", policy, task.pendulum)
    settings, given = chosen.settings, {"trials": trials.trials, "duration": trials.duration}
    changes = {name: value for name, value in given.items() if value is not None}
    changed = settings.evaluation.model_validate({**dict(settings.evaluation), **changes})
    output.warn(chosen.shortfall)
    total = changed.trials * (1 if trials.no_baselines else 1 + len(BUILT_IN))
    with output.progress() as show:
        evaluation = evaluate(
            chosen,
            settings.model_copy(update={"evaluation": changed}),
            world=trials.world,
            actuator=task.actuator,
            seed=random.seed,
            with_baselines=not trials.no_baselines,
            workers=random.threads,
            done=counted("evaluate", total, show),
        )
    inputs = {"policy": evaluation.policy, "pendulum": evaluation.pendulum}
    evaluation.save(out, command="evaluate", inputs=inputs)
    fields = _trial_fields(evaluation.results)
    output.result(
        **fields,
        duration_s=evaluation.duration,
        world=evaluation.world,
        arm=evaluation.arm,
        seed=evaluation.seed,
        baselines={each.name: _trial_fields(each) for each in evaluation.baselines},
        evaluation=out,
        code=int(fields["median_s"] < evaluation.duration),
        then=_deploy(policy, trials, task),
    )


def _deploy(policy: Path | None, trials: Trials, task: opt.Task) -> str:
    world = trials.world if trials.world.startswith("twin:") else None
    return command("deploy", policy, task, world=world, makes="run.mcap")


def _trial_fields(results: "TrialResults") -> dict[str, Any]:
    """Return the summary of trials as fields of a result."""
    found = results.summary()
    counts = {name: getattr(found, name) for name in ("survived", "trials", "rate", "outcomes")}
    return counts | {"interval_95": found.interval, "median_s": found.median}


def certify(
    output: Output,
    policy: Path | None,
    probability: float,
    trials: Trials,
    task: opt.Task,
    random: opt.Random,
    files: opt.Files,
) -> None:
    """Grant or refuse a claim about a policy, and write the certificate."""
    if random.seed or task.actuator is not None:
        raise InputError("a claim fixes seed and actuator; leave out --seed and --actuator")
    from equipoise.executors import counted
    from equipoise.worlds import certification

    chosen = task.read(policy)
    out = files.file("certificate.json", policy, task.pendulum)
    length = 60.0 if trials.duration is None else trials.duration
    claim = certification.make_claim(
        probability, duration=length, world=trials.world, trials=trials.trials
    )
    with output.progress() as show:
        done = counted("evaluate", claim.trials, show)
        certificate = certification.certify(chosen, claim, workers=random.threads, done=done)
    certificate.save(out, command="evaluate", inputs={"policy": chosen.digest})
    output.result(
        granted=certificate.granted,
        claim=str(claim),
        bound=certificate.bound,
        trials=claim.trials,
        failures=certificate.failed,
        allowed=claim.allowed,
        outcomes=_trial_fields(certificate.evaluation.results)["outcomes"],
        certificate=out,
        code=int(not certificate.granted),
        then=_deploy(policy, trials, task),
    )
