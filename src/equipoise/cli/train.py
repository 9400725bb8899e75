"""`equipoise train`: a pendulum and an arm become a policy."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equipoise.cli import next_step
from equipoise.cli.destinations import choose_file
from equipoise.cli.options import (
    IN_AND_OUT,
    ActuatorFile,
    ArmName,
    Base,
    Force,
    Held,
    Json,
    MaxSpeed,
    Resume,
    Seed,
    Set,
    SettingsFile,
    Tip,
    Workers,
    available_workers,
    read_actuator,
    read_arm,
    read_pendulum,
)
from equipoise.cli.output import Output, verb
from equipoise.cli.unfinished import unfinished
from equipoise.errors import InputError

if TYPE_CHECKING:
    from equipoise.control.policy import TabularPolicy
    from equipoise.model.actuator import Actuator
    from equipoise.model.arms.arm import Arm
    from equipoise.model.pendulum import Pendulum
    from equipoise.settings import Settings


@verb
def train(
    pendulum: Annotated[
        Path | None,
        typer.Argument(
            metavar="PENDULUM",
            help="From equipoise identify; without it, the pendulum that ships.",
            show_default=False,
        ),
    ] = None,
    arm: ArmName = "iiwa7",
    actuator: ActuatorFile = None,
    recipe: Annotated[
        str,
        typer.Option(metavar="NAME", help="robust, or paper: the barest reading of its text."),
    ] = "robust",
    episodes: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Episodes; by default the paper's 10,000."),
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Learners to train over the cores, by default 3; the best of a selection is kept.",
        ),
    ] = None,
    max_speed: MaxSpeed = None,
    seed: Seed = 0,
    workers: Workers = None,
    held: Held = None,
    base: Base = None,
    tip: Tip = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="The policy that is written.",
            rich_help_panel=IN_AND_OUT,
            show_default="policy.json",
        ),
    ] = None,
    force: Force = False,
    resume: Resume = False,
    settings_file: SettingsFile = None,
    settings: Set = None,
    as_json: Json = False,
) -> None:
    """Train a policy by Q-learning.

    Writes the policy: the table of 270 boxes by 8 actions, its learning curve,
    and all that is needed to train it again. Interrupted, the same command with
    --resume goes on where it stopped.
    """
    output = Output(as_json)
    output.say(f"Training for {pendulum or 'the pendulum that ships with Equipoise'} on {arm}")
    destination = choose_file(output, out, "policy.json", pendulum, settings_file, force=force)

    from equipoise.settings import resolve

    chosen = list(settings or ())
    if episodes is not None:
        chosen.append(f"learning.episodes={episodes}")
    resolved = resolve(recipe, settings_file, chosen, max_speed=max_speed)
    if max_speed is not None and not resolved.selection.every:
        raise InputError(
            f"--max-speed needs a selection, and recipe {recipe} takes the last table; give "
            "another, or --set selection.every=20"
        )
    source = read_pendulum(pendulum)
    machine = read_arm(arm, held, base, tip)
    response = read_actuator(actuator)
    begin = time.perf_counter()
    with unfinished(destination, resume=resume) as partial:
        policies, speed = _train(
            output, source, machine, response, resolved, seeds, seed, recipe, workers, partial
        )
        wall = time.perf_counter() - begin
        best = policies[0]
        inputs = {"pendulum": source.digest, "actuator": best.actuator.digest}
        with destination.claimed() as out:
            best.save(out, command="train", inputs=inputs)
    _say(output, policies, wall, speed, resume)
    output.wrote(out)
    words = {
        "--arm": arm if arm != "iiwa7" else None,
        "--actuator": actuator,
        "--recipe": recipe if recipe != "robust" else None,
        "--held": held,
        "--base": base,
        "--tip": tip,
        "--max-speed": max_speed,
        "--settings": settings_file,
    }
    given = [str(word) for pair in words.items() if pair[1] is not None for word in pair]
    given += [word for text in chosen for word in ("--set", text)]
    again = [*([str(pendulum)] if pendulum else []), *given]
    output.next(*next_step.after_training(out, best, again))
    output.result(
        {
            "policy": str(out),
            "seed": best.seed,
            "learner": best.learner,
            "episodes": best.episodes,
            "steps": best.steps,
            "steps_per_second": speed,
            "wall_s": wall,
            "learners": [_learner(policy) for policy in policies],
        }
    )


def _train(
    output: Output,
    pendulum: "Pendulum",
    arm: "Arm",
    actuator: "Actuator | None",
    settings: "Settings",
    seeds: int | None,
    seed: int,
    recipe: str,
    workers: int | None,
    partial: Path,
) -> "tuple[list[TabularPolicy], float]":
    """Train behind progress bars; return the policies, the best first, and the steps/s."""
    from equipoise.studies.compilation import FUNCTIONS, compile_training, compiling
    from equipoise.studies.progress import TrainingProgress
    from equipoise.training import LEARNERS, train_several

    learners = LEARNERS if seeds is None else seeds
    with output.stages() as show:
        with compiling(show, FUNCTIONS):
            compile_training(arm, settings)
        progress = TrainingProgress(settings, learners, show)
        policies = train_several(
            pendulum,
            arm,
            settings,
            learners=learners,
            actuator=actuator,
            seed=seed,
            recipe=recipe,
            workers=available_workers(workers),
            partial=partial,
            report=progress.report,
            selecting=progress.selecting,
        )
        return policies, progress.speed


def _say(
    output: Output, policies: "list[TabularPolicy]", wall: float, speed: float, resumed: bool
) -> None:
    best = policies[0]
    steps = sum(policy.steps for policy in policies)
    of_each = f" each of {len(policies)} learners" if len(policies) > 1 else ""
    rows = {"trained": f"{best.episodes:,} episodes{of_each}, {steps:,} steps in {wall:.1f} s"}
    if (limit := best.settings.plant.max_speed) is not None:
        rows["for a flange"] = f"below {limit:g} m/s"
    if resumed:
        rows["resumed"] = "from a checkpoint; time and speed are those since then"
    if speed:
        rows["speed"] = f"{speed:,.0f} steps/s, selection included"
    for policy in policies:
        name = "selected" if policy is best else f"learner {policy.learner}"
        whose = f"learner {policy.learner}, " if policy is best and of_each else ""
        rows[name] = whose + _chosen(policy)
    output.rows(rows)


def _chosen(policy: "TabularPolicy") -> str:
    if not policy.checkpoints:
        return "the last table, as the recipe says"
    chosen, longest = policy.checkpoints[0], policy.settings.selection.final_duration
    return (
        f"after {chosen.episodes:,} episodes; {chosen.survived} of {chosen.trials} "
        f"selection trials lasted {longest:g} s"
    )


def _learner(policy: "TabularPolicy") -> dict[str, object]:
    chosen = policy.checkpoints[0] if policy.checkpoints else None
    return {
        "learner": policy.learner,
        "steps": policy.steps,
        "score": chosen and chosen.score,
        "survived": chosen and chosen.survived,
        "trials": chosen and chosen.trials,
    }
