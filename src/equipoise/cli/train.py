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
    """iiwa7, iiwa14, another registered arm, a URDF or a rig.toml."""
    actuator: list[str] | None = None
    """From equipoise identify RUN, or ideal; by default the shipped actuator. Repeatable."""
    world: str = "model"
    """World of the episodes: model, compiled; or a twin or coppeliasim://HOST:PORT, slowly."""


class Learning(Options):
    """Learning."""

    learner: str | None = None
    """q_learning (the paper's), sarsa, double_q, or MODULE:NAME."""
    reward: str | None = None
    """paper, alive, or MODULE:NAME of a function."""
    episodes: Annotated[int | None, Field(ge=1)] = None
    """Number of episodes; by default the paper's 10,000."""
    target: Annotated[float | None, Field(ge=0.0, le=1.0)] = None
    """Share of trials of 60 s to last, with 95 % confidence; by default 0.99, or 0 without a
    selection: the first learner."""
    learners: Annotated[int, Field(ge=1)] = 6
    """Maximum number of learners that are trained for it."""


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
    """Train a policy by Q-learning, or by another learner.

    PENDULUM is from equipoise identify; by default the shipped one. Learners
    are trained one after the other until a policy meets the target in held-out
    trials. Exit code 1: no learner meets it; the best policy is written and
    marked.

    Several --actuator make one policy for an arm whose model is uncertain:
    episodes take turns behind them, and each has to meet the target.
    """
    from equipoise.learning.target import TARGET, train_to_target
    from equipoise.learning.train import check_task
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
            learners=learning.learners,
            actuator=given,
            world=plant.world,
            seed=random.seed,
            workers=random.threads,
            show=show,
        )
    actuators = {f"actuator {i}": each.digest for i, each in enumerate(best.actuators, start=1)}
    inputs = {"pendulum": source.digest, "world": plant.world, **actuators}
    best.save(out, command="train", inputs=inputs)
    output.result(
        seed=best.seed,
        learner=best.learner,
        episodes=best.episodes,
        steps=best.steps,
        tests={f"actuator {i}": test.model_dump() for i, test in enumerate(best.tests, start=1)},
        policy=out,
        warnings=[best.shortfall],
        code=int(bool(best.shortfall)),
        then=command("evaluate", out),
    )
