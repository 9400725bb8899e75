"""`equipoise train`: trains a policy for a pendulum and an arm."""

import time
from pathlib import Path
from typing import TYPE_CHECKING

from equipoise.cli import next_step
from equipoise.cli import options as opt
from equipoise.cli.destinations import choose_file, unfinished
from equipoise.cli.output import Output, verb
from equipoise.errors import InputError

if TYPE_CHECKING:
    from equipoise.control.policy import TabularPolicy


@verb
def train(
    pendulum: Path | None = opt.argument(
        "PENDULUM", "From equipoise identify; by default the shipped pendulum.", None
    ),
    arm: str = opt.ARM,
    actuator: str | None = opt.ACTUATOR,
    recipe: str = opt.RECIPE,
    learner: str | None = opt.value(
        "NAME", "q_learning (the paper's), sarsa, watkins, double_q, or MODULE:NAME."
    ),
    reward: str | None = opt.value("NAME", "paper, alive, centred, or MODULE:NAME of a function."),
    episodes: int | None = opt.value(
        "N", "Number of episodes; by default the paper's 10,000.", min=1
    ),
    seeds: int | None = opt.value(
        "N", "Number of learners; by default 3, of which the best is kept.", min=1
    ),
    max_speed: float | None = opt.MAX_SPEED,
    seed: int = opt.SEED,
    workers: int | None = opt.WORKERS,
    held: str | None = opt.HELD,
    base: str | None = opt.BASE,
    tip: str | None = opt.TIP,
    out: Path | None = opt.out("Policy to write.", "policy.json"),
    force: bool = opt.FORCE,
    resume: bool = opt.RESUME,
    settings_file: Path | None = opt.SETTINGS_FILE,
    settings: list[str] | None = opt.SET,
    as_json: bool = opt.JSON,
) -> None:
    """Train a policy by Q-learning, or by another learner.

    Writes the policy: the table of 270 boxes by 8 actions, its learning curve,
    and everything needed to train it again. After an interruption the same
    command with --resume continues.
    """
    output = Output(as_json)
    output.say(f"Training for {pendulum or 'the shipped pendulum'} on {arm}")
    destination = choose_file(output, out, "policy.json", pendulum, settings_file, force=force)

    from equipoise.settings import resolve

    chosen = list(settings or ())
    named = {"episodes": episodes, "learner": learner, "reward": reward}
    chosen += [f"learning.{name}={given}" for name, given in named.items() if given is not None]
    resolved = resolve(recipe, settings_file, chosen, max_speed=max_speed)
    if max_speed is not None and not resolved.selection.every:
        raise InputError(
            f"--max-speed needs a selection, and recipe {recipe} takes the last table; give "
            "another, or --set selection.every=20"
        )
    source = opt.read_pendulum(pendulum)
    machine = opt.read_arm(arm, held, base, tip)
    response = opt.read_actuator(actuator)

    from equipoise.studies.compilation import FUNCTIONS, compile_training, compiling
    from equipoise.studies.progress import TrainingProgress
    from equipoise.training import LEARNERS, check_task, train_several

    output.warn(check_task(source, machine, resolved, response))
    begin = time.perf_counter()
    learners = LEARNERS if seeds is None else seeds
    with unfinished(destination, resume=resume) as partial:
        with output.stages() as show:
            with compiling(show, FUNCTIONS):
                compile_training(machine, resolved)
            progress = TrainingProgress(resolved, learners, show)
            policies = train_several(
                source,
                machine,
                resolved,
                learners=learners,
                actuator=response,
                seed=seed,
                workers=opt.available_workers(workers),
                partial=partial,
                report=progress.report,
                selecting=progress.selecting,
            )
        wall, speed = time.perf_counter() - begin, progress.speed
        best = policies[0]
        inputs = {"pendulum": source.digest, "actuator": best.actuator.digest}
        with destination.claimed() as out:
            best.save(out, command="train", inputs=inputs)
    _say(output, policies, wall, speed, resume)
    output.wrote(out)
    again = next_step.given(
        arm=arm if arm != "iiwa7" else None,
        actuator=actuator,
        recipe=recipe if recipe != "robust" else None,
        held=held,
        base=base,
        tip=tip,
        max_speed=max_speed,
        settings=settings_file,
    )
    again += tuple(word for text in chosen for word in ("--set", text))
    again = (pendulum, *again)
    output.next(*next_step.after_training(out, best, again))
    output.result(
        policy=out,
        **{name: getattr(best, name) for name in ("seed", "learner", "episodes", "steps")},
        steps_per_second=speed,
        wall_s=wall,
        learners=[_learner(policy) for policy in policies],
    )


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
        rows["resumed"] = "from a checkpoint; time and speed count from there"
    if speed:
        rows["speed"] = f"{speed:,.0f} steps/s, selection included"
    for policy in policies:
        name = "selected" if policy is best else f"learner {policy.learner}"
        whose = f"learner {policy.learner}, " if policy is best and of_each else ""
        rows[name] = whose + _chosen(policy)
    output.rows(rows)


def _chosen(policy: "TabularPolicy") -> str:
    if not policy.checkpoints:
        return "the last table, as the recipe requires"
    chosen, longest = policy.checkpoints[0], policy.settings.selection.final_duration
    return (
        f"after {chosen.episodes:,} episodes; {chosen.survived} of {chosen.trials} "
        f"selection trials lasted {longest:g} s"
    )


def _learner(policy: "TabularPolicy") -> dict[str, object]:
    chosen = policy.checkpoints[0] if policy.checkpoints else None
    scores = {name: chosen and getattr(chosen, name) for name in ("score", "survived", "trials")}
    return {"learner": policy.learner, "steps": policy.steps, **scores}
