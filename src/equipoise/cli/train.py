"""Verbs that train: `equipoise train`, `reproduce` and `warm-up`."""

import time
from pathlib import Path
from typing import Annotated

from pydantic import Field

import equipoise as eq
from equipoise.cli import options as opt
from equipoise.cli.output import Output


class Training(opt.Options):
    """The training."""

    arm: str = "iiwa7"
    """{arms}, a URDF or a rig.toml."""
    actuator: str | None = None
    """File from equipoise identify RUN, or ideal; by default the shipped actuator."""
    world: str = "model"
    """World of the episodes: model; or twin:NAME ({worlds}) or coppeliasim://HOST:PORT (slow)."""
    algorithm: str | None = None
    """q_learning (the paper's), or MODULE:NAME."""
    reward: str | None = None
    """{rewards}, or MODULE:NAME of a function; by default the recipe's."""
    episodes: Annotated[int | None, Field(ge=1)] = None
    """Number of episodes; by default the paper's 10,000."""
    target: Annotated[float | None, Field(ge=0.0, le=1.0)] = None
    """Probability of surviving a 60 s trial, shown with 95 % confidence; by default 0.99, or 0
    without a selection. 0 accepts the first policy."""
    attempts: Annotated[int, Field(ge=1)] = 6
    """Maximum number of trainings to meet the target; the seed increases by one each time."""


@opt.verb
def train(
    output: Output,
    pendulum: Path | None = None,
    *,
    training: Training,
    changes: opt.Changes,
    random: opt.Random,
    files: opt.Files,
) -> None:
    """Train a policy by Q-learning, or by another algorithm.

    PENDULUM is from equipoise identify; by default the shipped one. Trains up
    to --attempts times, until a policy meets the target in held-out trials.
    Exit code 1: none meets it; the best one is still written, and marked.
    """
    from equipoise.executors import open_workers
    from equipoise.learning.train import TARGET, check_task
    from equipoise.model.pendulum import read_pendulum

    named = {f"learning.{n}": getattr(training, n) for n in ("algorithm", "reward", "episodes")}
    settings = changes.resolve(**named)
    source, arm, actuator = read_pendulum(pendulum), opt.read_arm(training.arm), training.actuator
    target = training.target
    if target is None:
        target = TARGET if settings.selection.every else 0.0
    output.warn(check_task(source, settings, actuator, world=training.world, target=target))
    out = files.file(output, "policy.json", pendulum, changes.settings)
    with open_workers(random.workers) as workers, output.progress() as show:
        best = eq.train_to_target(
            source,
            arm,
            settings,
            target=target,
            attempts=training.attempts,
            actuator=actuator,
            world=training.world,
            seed=random.seed,
            workers=workers,
            show=show,
        )
    inputs = {"pendulum": source.digest, "world": training.world, "actuator": best.actuator.digest}
    best.save(out, command="train", inputs=inputs)
    output.result(
        test=best.test,
        policy=out,
        seed=best.seed,
        episodes=best.episodes,
        steps=best.steps,
        warnings=[best.shortfall],
        code=int(bool(best.shortfall)),
        then=opt.command("evaluate", out),
    )


class Extent(opt.Options):
    """The reproduction."""

    arm: str = "iiwa7"
    """{arms}, a URDF or a rig.toml."""
    swing: Path | None = None
    """Recorded swing, as identify reads it; by default a simulated one."""
    counts_per_rev: int | None = None
    """Encoder counts per revolution, after x4."""


@opt.verb
def reproduce(
    output: Output,
    *,
    extent: Extent,
    changes: opt.Changes,
    random: opt.Random,
    files: opt.Files,
) -> None:
    """Reproduce the paper, from a free swing to a report.

    Identifies the pendulum, then trains, evaluates and runs a policy on the
    digital twin, for the literal recipe (paper) and the default one. Writes all
    files to a folder (equipoise-report), with a self-contained HTML report that
    compares both with the paper's robot.
    """
    from equipoise.executors import open_workers
    from equipoise.learning.choice import with_digests
    from equipoise.report.page import build, comparison
    from equipoise.reproduction.results import POLICY

    recorded = None
    if extent.swing is not None:
        recorded = eq.read_swing(extent.swing, counts_per_rev=extent.counts_per_rev)
    arm, settings = opt.read_arm(extent.arm), changes.resolve()
    with_digests(settings.learning)
    out = files.folder(output, Path("equipoise-report"))
    with open_workers(random.workers) as workers, output.progress() as show:
        results = eq.reproduce(
            out,
            swing=recorded,
            arm=arm,
            settings=settings,
            seed=random.seed,
            workers=workers,
            report=show,
        )
        show("report", None, "")
        page = build(results, out)
        show("report", 1.0, "")
    evaluation = results.default.evaluation
    output.result(
        duration_s=evaluation.duration,
        report=page,
        comparison=comparison(results),
        warnings=[results.default.policy.shortfall],
        code=int(evaluation.results.summary().median < evaluation.duration),
        then=opt.command("evaluate", out / POLICY, trials=1000),
    )


@opt.verb
def warm_up(output: Output) -> None:
    """Compile all kernels once, on all cores, so that every verb starts at once.

    Takes half a minute on two cores. All environments of a user share the
    machine code; each version of the package needs its own.
    """
    from equipoise.jit import cache_directory
    from equipoise.reproduction.warm_up import warm_up

    begin = time.perf_counter()
    with output.progress() as show:
        warm_up(show)
    output.result(
        compiled_s=round(time.perf_counter() - begin, 1),
        cache=cache_directory(),
        then="reproduce",
    )
