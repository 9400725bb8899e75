"""`equipoise train`: trains a policy for a pendulum and an arm."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from equipoise.cli import options as opt
from equipoise.cli.destinations import choose_file
from equipoise.cli.output import Output, verb
from equipoise.errors import InputError

if TYPE_CHECKING:
    from equipoise.control.policy import TabularPolicy
    from equipoise.learning.target import TrainedLearners

HELP: Final = {
    "track": "track: the pendulum stays up, and the table moves the flange off its track. Tables "
    "differ in this from learner to learner: train more of them, or finer boxes "
    "(--recipe fine), which a slow pendulum needs.",
    "angle": "angle: the pendulum falls within the track; release more gently, or identify the "
    "actuator again.",
    "joint limit": "joint limit: the posture leaves no room; choose another home.",
    "flange speed": "flange speed: the flange exceeds --max-speed; allow more, if the "
    "mode of the arm does.",
}
"""Remedies for each cause of a failed trial. Smaller uncertainties are not among them: of 12 tables
that failed on the track, 897 of 1,152 trials lasted, and 901 without variation of the plant."""


@verb
def train(
    pendulum: Path | None = opt.argument(
        "PENDULUM", "From equipoise identify; by default the shipped pendulum.", None
    ),
    arm: str = opt.ARM,
    actuator: list[str] | None = opt.ACTUATORS,
    world: str = opt.value(
        "WORLD",
        "World of the episodes: model, compiled; or a twin or coppeliasim://HOST:PORT, slowly.",
        default="model",
    ),
    recipe: str = opt.RECIPE,
    learner: str | None = opt.value(
        "NAME", "q_learning (the paper's), sarsa, watkins, double_q, or MODULE:NAME."
    ),
    reward: str | None = opt.value("NAME", "paper, alive, or MODULE:NAME of a function."),
    episodes: int | None = opt.value(
        "N", "Number of episodes; by default the paper's 10,000.", min=1
    ),
    target: float | None = opt.value(
        "P",
        "Share of trials of 60 s that the policy has to last, with 95 % confidence; by default "
        "0.99, or 0 without a selection: the first learner.",
    ),
    learners: int | None = opt.value(
        "N", "Maximum number of learners that are trained for it; by default 6.", min=1
    ),
    max_speed: float | None = opt.MAX_SPEED,
    seed: int = opt.SEED,
    workers: int | None = opt.WORKERS,
    ray: str | None = opt.RAY,
    held: str | None = opt.HELD,
    base: str | None = opt.BASE,
    tip: str | None = opt.TIP,
    out: Path | None = opt.out("Policy to write.", "policy.json"),
    force: bool = opt.FORCE,
    settings_file: Path | None = opt.SETTINGS_FILE,
    settings: list[str] | None = opt.SET,
    as_json: bool = opt.JSON,
) -> None:
    """Train a policy by Q-learning, or by another learner.

    Learners are trained one after the other until a policy meets the target in
    trials that chose nothing. Writes the policy: the table of boxes by 8
    actions, its learning curve, its tests, and everything needed to train it
    again. Exit code 1: no learner meets the target; the best policy is written
    and marked.

    Several --actuator make one policy for an arm of which none is sure:
    episodes take turns behind them, the worst one scores, and each has to meet
    the target. Before the pendulum is lifted, a run selects one of them.
    """
    output = Output(as_json)
    output.say(f"Training for {pendulum or 'the shipped pendulum'} on {arm}")
    destination = choose_file(output, out, "policy.json", pendulum, settings_file, force=force)

    from equipoise.settings import resolve

    chosen = list(settings or ())
    named = {"episodes": episodes, "learner": learner, "reward": reward}
    chosen += [] if max_speed is None else [f"plant.max_speed={max_speed}"]
    chosen += [f"learning.{name}={given}" for name, given in named.items() if given is not None]
    resolved = resolve(recipe, settings_file, chosen)
    if max_speed is not None and not resolved.selection.every:
        raise InputError(
            f"--max-speed needs a selection, and recipe {recipe} takes the last table; give "
            "another, or --set selection.every=20"
        )
    source = opt.read_pendulum(pendulum)
    machine = opt.read_arm(arm, held, base, tip)
    responses = [one for each in actuator or () if (one := opt.read_actuator(each))] or None

    from equipoise.learning.target import LEARNERS, TARGET, train_to_target
    from equipoise.learning.train import check_task
    from equipoise.progress import TrainingProgress, compile_training, compiling

    begin = time.perf_counter()
    opt.check_range("--target", target, 0.0, 1.0)
    if target is None:
        target = TARGET if resolved.selection.every else 0.0
    output.warn(check_task(source, machine, resolved, responses, world=world, target=target))
    budget = LEARNERS if learners is None else learners
    with output.stages() as show:
        with compiling(show):
            compile_training(machine, resolved)
        progress = TrainingProgress(resolved, show, budget)
        trained = train_to_target(
            source,
            machine,
            resolved,
            target=target,
            learners=budget,
            actuator=responses,
            world=world,
            seed=seed,
            workers=opt.executor(workers, ray),
            observer=progress,
        )
        progress.ended()
    wall, best = time.perf_counter() - begin, trained.policy
    names = ("actuator", *(f"actuator {i}" for i in range(2, 1 + len(best.actuators))))
    inputs = {"pendulum": source.digest}
    inputs |= {} if world == "model" else {"world": world}
    inputs |= {n: each.digest for n, each in zip(names, best.actuators, strict=True)}
    with destination.claimed() as out:
        best.save(out, command="train", inputs=inputs)
    _say(output, trained, wall)
    output.wrote(out)
    output.next("evaluate", out)
    test = best.test
    output.result(
        policy=out,
        **{name: getattr(best, name) for name in ("seed", "learner", "episodes", "steps")},
        wall_s=wall,
        **({} if test is None else test.model_dump(mode="json")),
        actuators=[
            {"actuator": response.summary, **test.model_dump(mode="json")}
            for response, test in zip(best.actuators, best.tests, strict=False)
        ],
        learners=[result.model_dump(mode="json") for result in trained.learners],
        bad=bool(best.shortfall),
    )


def _say(output: Output, trained: "TrainedLearners", wall: float) -> None:
    best, count = trained.policy, len(trained.learners)
    steps = sum(result.steps for result in trained.learners)
    of_each = f" each of {count} learners" if count > 1 else ""
    rows = {"trained": f"{best.episodes:,} episodes{of_each}, {steps:,} steps in {wall:.1f} s"}
    if (limit := best.settings.plant.max_speed) is not None:
        rows["for a flange"] = f"below {limit:g} m/s"
    whose = f"learner {best.learner}, " if of_each else ""
    rows["selected"] = whose + _chosen(best)
    if (test := best.test) is not None:
        if len(best.tests) == 1:
            rows["tested"] = test.text
        for i, (response, each) in enumerate(zip(best.actuators, best.tests, strict=True), start=1):
            if len(best.tests) > 1:
                rows[f"tested behind {i}"] = f"{response.summary}: {each.text}"
        if count > 1:
            met = sum(result.test.met for result in trained.learners)
            rows["learners"] = f"{met:,} of {count:,} meet the target"
        if test.failures:
            rows["ended by"] = ", ".join(f"{cause} {n}" for cause, n in test.failures.items())
    output.rows(rows)
    if not best.shortfall:
        return
    which = "It misses" if count == 1 else f"None of {count} learners meets"
    output.say(f"{which} the target. The file is written, and marked.", style="red")
    for cause in best.test.failures if best.test else ():
        if cause in HELP:
            output.say(HELP[cause])


def _chosen(policy: "TabularPolicy") -> str:
    if not policy.checkpoints:
        return "the last table, as the recipe requires"
    chosen, *others = policy.checkpoints
    return (
        f"after {chosen.episodes:,} episodes; {chosen.survived} of {chosen.trials} trials of its "
        f"race with {len(others)} other candidates lasted"
    )
