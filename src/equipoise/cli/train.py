"""`equipoise train`: trains a policy for a pendulum and an arm."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from equipoise.cli import options as opt
from equipoise.cli.output import Output
from equipoise.cli.verb import Options, command, verb


class Plant(Options):
    """The plant."""

    arm: str = "iiwa7"
    """{arms}, a URDF or a rig.toml."""
    actuator: str | None = None
    """File from equipoise identify RUN, or ideal; by default the shipped actuator."""
    world: str = "model"
    """World of the episodes: model; or twin:NAME ({worlds}) or coppeliasim://HOST:PORT (slow)."""


class Learning(Options):
    """Learning."""

    learner: str | None = None
    """q_learning (the paper's), or MODULE:NAME."""
    reward: str | None = None
    """{rewards}, or MODULE:NAME of a function; by default the recipe's."""
    episodes: Annotated[int | None, Field(ge=1)] = None
    """Number of episodes; by default the paper's 10,000."""
    target: Annotated[float | None, Field(ge=0.0, le=1.0)] = None
    """Probability to survive a 60 s trial, shown with 95 % confidence; by default 0.99, or 0
    without a selection. 0 accepts the first policy."""
    attempts: Annotated[int, Field(ge=1)] = 6
    """Maximum number of trainings to meet the target; the seed increases by one each time."""


@verb
def train(
    output: Output,
    pendulum: Path | None = None,
    *,
    plant: Plant,
    learning: Learning,
    changes: opt.Changes,
    random: opt.Random,
    files: opt.Files,
) -> None:
    """Train a policy by Q-learning, or by another algorithm.

    PENDULUM is from equipoise identify; by default the shipped one. Trains
    again, at most --attempts times, until a policy meets the target in held-out
    trials. Exit code 1: none meets it; the best policy is written and marked.
    """
    from equipoise.learning.train import TARGET, check_task, train_to_target
    from equipoise.model.pendulum import read_pendulum

    named = {f"learning.{n}": getattr(learning, n) for n in ("learner", "reward", "episodes")}
    settings = changes.resolve(**named)
    source, arm, given = read_pendulum(pendulum), opt.read_arm(plant.arm), plant.actuator
    target = learning.target
    if target is None:
        target = TARGET if settings.selection.every else 0.0
    output.warn(check_task(source, settings, given, world=plant.world, target=target))
    out = files.file(output, "policy.json", pendulum, changes.settings)
    with output.progress() as show:
        best = train_to_target(
            source,
            arm,
            settings,
            target=target,
            attempts=learning.attempts,
            actuator=given,
            world=plant.world,
            seed=random.seed,
            workers=random.threads,
            show=show,
        )
    inputs = {"pendulum": source.digest, "world": plant.world, "actuator": best.actuator.digest}
    best.save(out, command="train", inputs=inputs)
    output.result(
        test=best.test,
        policy=out,
        seed=best.seed,
        episodes=best.episodes,
        steps=best.steps,
        warnings=[best.shortfall],
        code=int(bool(best.shortfall)),
        then=command("evaluate", out),
    )
