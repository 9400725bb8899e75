"""Verbs that try a policy in simulation: `equipoise evaluate` and `play`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

import equipoise as eq
from equipoise.cli import options as opt
from equipoise.cli.output import Output, signals
from equipoise.errors import InputError
from equipoise.settings import Start, changed

if TYPE_CHECKING:
    from equipoise.simulation.evaluation import TrialResults


class Trials(opt.Options):
    """Trials."""

    world: str = "model"
    """ideal: the paper's plant; model: with the actuator; twin:NAME ({worlds}); twin:FILE; or
    coppeliasim://HOST:PORT."""
    start: Start | None = None
    """hand: released by hand (default); hanging: the arm swings it up, then the trial begins."""
    trials: Annotated[int | None, Field(ge=1)] = None
    """Number of trials; by default 200, or as --claim needs."""
    duration: float | None = None
    """Duration of a trial [s]; by default 60."""
    no_baselines: bool = False
    """Leave out the trials of LQR, PD and random actions."""
    claim: Annotated[float | None, Field(gt=0.0, lt=1.0)] = None
    """Claim that a trial survives with at least this probability, e.g. 0.99."""


@opt.verb
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
    Four baselines run the same trials. Without --out no file is written. Exit
    code 1: the median trial ended early.

    --claim grants or refuses a claim at 95 % confidence, by an exact bound. It
    determines the number of trials, and leaves out the baselines. Exit code 1:
    the claim is refused.
    """
    from equipoise.control.bound_policy import BUILT_IN
    from equipoise.executors import counted, open_workers
    from equipoise.simulation.evaluation import CLAIM_CONFIDENCE

    chosen, claim = task.read(policy), trials.claim
    values = trials.model_dump(include={"trials", "duration", "start"})
    if claim is not None and trials.trials is None:
        values["trials"] = eq.trials_for(claim)
    changes = {f"evaluation.{name}": value for name, value in values.items()}
    settings = changed(chosen.settings, changes)
    count = settings.evaluation.trials
    if claim is not None and eq.lower_bound(count, count, CLAIM_CONFIDENCE) < claim:
        raise InputError(
            f"{count:,} trials cannot grant a claim of {claim:g}, even if all survive; leave out "
            f"--trials, or give {eq.trials_for(claim)}"
        )
    out = files.out and files.file(output, "evaluation.json", policy, task.pendulum)
    output.warn(chosen.shortfall)
    with_baselines = not trials.no_baselines and claim is None
    total = count * (1 + len(BUILT_IN)) if with_baselines else count
    with open_workers(random.workers) as workers, output.progress() as show:
        evaluation = eq.evaluate(
            chosen,
            settings,
            world=trials.world,
            actuator=task.actuator,
            seed=random.seed,
            with_baselines=with_baselines,
            workers=workers,
            done=counted("evaluate", total, show),
        )
    if out is not None:
        inputs = {"policy": evaluation.policy, "pendulum": evaluation.pendulum}
        evaluation.save(out, command="evaluate", inputs=inputs)
    fields, claimed = _trial_fields(evaluation.results), dict[str, Any]()
    good = fields["median_s"] >= evaluation.duration
    if claim is not None:
        bound = eq.lower_bound(fields["survived"], count, CLAIM_CONFIDENCE)
        good = bound >= claim
        claimed = {"granted": good, "claim": claim, "bound_95": bound}
    twin = trials.world if trials.world.startswith("twin:") else None
    output.result(
        **claimed,
        **fields,
        duration_s=evaluation.duration,
        world=evaluation.world,
        arm=evaluation.arm,
        seed=evaluation.seed,
        baselines={row.name: _trial_fields(row) for row in evaluation.baselines},
        file=out,
        code=int(not good),
        then=opt.command("deploy", policy, task, world=twin, start=trials.start),
    )


def _trial_fields(results: "TrialResults") -> dict[str, Any]:
    """Return the summary of trials as fields of a result."""
    summary = results.summary()
    counts = {name: getattr(summary, name) for name in ("survived", "trials", "rate", "outcomes")}
    fields = counts | {"interval_95": summary.interval, "median_s": summary.median}
    if summary.upright is not None:
        fields |= dict(zip(("upright_median_s", "upright_max_s"), summary.upright, strict=True))
    return fields


@opt.verb
def play(
    output: Output, scene: str = "balance", policy: Path | None = None, *, page: opt.Page
) -> None:
    """Balance the twin in the browser: push it, change the rig.

    SCENE is balance (default), why-it-falls, zero-error, friction or lqr.
    POLICY adds one of yours to the page. Open the printed address; everyone
    who has it plays with the same pendulum. Runs until Ctrl-C, and needs no
    robot and no recording.
    """
    from equipoise.console.play import SCENES, PlayPage
    from equipoise.console.web import serving

    if scene not in SCENES:
        raise InputError(f"there is no scene {scene!r}; choose one of {', '.join(SCENES)}")
    yours = None if policy is None else opt.Task().read(policy)
    with signals() as stopped, serving(page.listen, page.port) as (server, address):
        output.result(playground=address)
        PlayPage(server, SCENES[scene], yours).run(stopped.is_set)
