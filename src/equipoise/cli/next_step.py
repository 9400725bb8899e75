"""The next command to try: the last line of each verb, chosen from its result.

Each function returns the words after `equipoise`. The command keeps the given policy, world,
actuator, arm and limits. Input files of a value are found beside it by their digest; a missing file
is named in capitals, as in the help.
"""

from collections.abc import Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Final

from equipoise.errors import SettingsError
from equipoise.model.sim_configs import IDEAL, MODEL, PREFIX, read_world

if TYPE_CHECKING:
    from equipoise.control.policy import TabularPolicy, TaskPolicy
    from equipoise.logs.run_log import RunLog

Command = tuple[object, ...]
"""Words after `equipoise`; `Output.next` leaves out those that are None."""

NOMINAL: Final = f"{PREFIX}nominal"
PLANTS: Final = (IDEAL, MODEL)
"""Worlds without a twin's robot."""
LEARNERS: Final = 12
"""Maximum number of learners of a training after a failure: twice the default."""
LOOKED_AT: Final = 200
"""Maximum number of files that are searched for a digest."""
HEAD: Final = 400
"""Length of the head of a file that contains its digest [bytes]."""


def given(**options: object) -> Command:
    """Return the options that have a value, as words of a command."""
    words = [
        (f"--{name.replace('_', '-')}", f"{value:g}" if isinstance(value, float) else str(value))
        for name, value in options.items()
        if value is not None
    ]
    return tuple(word for pair in words for word in pair)


def file_with(digest: str, *beside: Path | None) -> Path | None:
    """Find a file by its digest, in the folders of other files and in the current one.

    Args:
        digest: Digest of the file.
        beside: Files whose folders are searched.
    """
    folders = dict.fromkeys([*(path.parent for path in beside if path is not None), Path()])
    for folder in folders:
        for path in islice(sorted(folder.glob("*.json")), LOOKED_AT):
            with suppress(OSError), path.open("rb") as file:
                if f'"digest": "{digest}"'.encode() in file.read(HEAD):  # not that of an input
                    return path
    return None


def after_training(
    out: Path, policy: "TabularPolicy", again: Sequence[object], learners: int
) -> Command:
    """Return the command after a training: the evaluation, or a training of more learners.

    Args:
        out: The policy's file.
        policy: The policy.
        again: Words of this training, without `--learners` and `--out`.
        learners: Maximum number of learners of this training.
    """
    if policy.shortfall:
        return ("train", *again, *given(learners=2 * learners))
    return ("evaluate", out)


def train_again(
    policy: "TaskPolicy",
    path: Path | None = None,
    *,
    pendulum: Path | None = None,
    actuator: str | None = None,
    max_speed: float | None = None,
) -> Command:
    """Return a training of more learners for the pendulum and the arm of a policy.

    Args:
        policy: The policy that failed.
        path: Its file.
        pendulum: The pendulum's file, where it was given.
        actuator: The actuator's file, where it was given.
        max_speed: Limit of the flange's speed, where it was given [m/s].
    """
    from equipoise.model.actuator import shipped_actuator
    from equipoise.model.arms.resolve import arm_option
    from equipoise.model.pendulum import shipped_pendulum

    swinging, response = policy.pendulum.digest, policy.actuator
    if pendulum is None and swinging != shipped_pendulum().digest:
        pendulum = file_with(swinging, path) or Path("PENDULUM")
    if not actuator and response.fit and response.digest != shipped_actuator().digest:
        actuator = str(file_with(response.digest, path) or "ACTUATOR")
    limit = policy.settings.plant.max_speed if max_speed is None else max_speed
    options = given(
        arm=arm_option(policy.arm.name), actuator=actuator, max_speed=limit, learners=LEARNERS
    )
    return ("train", pendulum, *options)


def after_evaluation(
    balanced: bool,
    policy: "TaskPolicy",
    path: Path | None,
    *task: object,
    world: str,
    pendulum: Path | None = None,
    actuator: str | None = None,
    max_speed: float | None = None,
) -> Command:
    """Return the command after an evaluation.

    A policy that balances goes from the plant of its training to the twin, and from there to a run;
    one that does not is trained again. On a world of its own without an actuator of that world, the
    arm is excited there first.

    Args:
        balanced: Whether the policy balanced.
        policy: The policy.
        path: Its file or name; None for the shipped policy.
        task: Given options of the task; empty for a table.
        world: The world.
        pendulum: The pendulum's file, where it was given.
        actuator: The actuator's file, where it was given.
        max_speed: Limit of the flange's speed, where it was given [m/s].
    """
    there = given(world=NOMINAL if world in PLANTS else world, actuator=actuator)
    if balanced and world in PLANTS:
        return ("evaluate", path, *there, *task, *given(max_speed=max_speed))
    if balanced:
        return ("deploy", path, *there, *task)
    if world not in PLANTS and not world.startswith(NOMINAL) and actuator is None:
        from equipoise.model.arms.resolve import arm_option

        words = given(world=world, arm=arm_option(policy.arm.name), out="excitation.mcap")
        return ("deploy", "--excite", *words)
    return train_again(policy, path, pendulum=pendulum, actuator=actuator, max_speed=max_speed)


def after_run(run: "RunLog", out: Path, path: Path | None, *task: object, world: str) -> Command:
    """Return the command after a simulated run: many such trials, or the explanation of its end.

    Args:
        run: The run.
        out: Its file.
        path: The policy's file; None for the shipped policy.
        task: Options of the policy's task, where they were given.
        world: The world.
    """
    if run.cause != "lasted":
        return ("log", "explain", out)
    return ("evaluate", path, *given(world=world), *task)


def after_explanation(run: Path, policy: str, moved: bool) -> Command:
    """Return the command after an explanation: the replay, if the policy of the log is found.

    Args:
        run: The log.
        policy: Digest of the policy of the run; empty for an excitation.
        moved: Whether the run reached its first tick.
    """
    from equipoise.control.policy import shipped_policy

    if not policy:
        return ("identify", run)
    if not moved:
        return ("rig", "doctor")
    if policy == shipped_policy().digest:
        return ("log", "replay", run)
    found = file_with(policy, run)
    return ("log", "replay", run, found) if found else ("log", "export", run)


def after_refinement(
    moved: bool, refined: Path | None, path: Path, runs: Sequence[Path], worlds: Sequence[str]
) -> Command:
    """Return the command after a comparison with logs.

    Args:
        moved: Whether the model of the policy had drifted.
        refined: The policy after further training; None without one.
        path: The policy that was compared.
        runs: The logs.
        worlds: Worlds or robots of the logs.
    """
    world = worlds[-1]
    simulated = world.startswith(PREFIX)
    if simulated:
        try:
            read_world(world)
        except SettingsError:  # a twin made in Python, or its file is missing
            world = NOMINAL
    if refined is not None:
        return ("evaluate", refined, *given(world=world if simulated else NOMINAL))
    if moved:
        return ("refine", path, *runs)
    if world == MODEL or simulated:
        return ("deploy", path, *given(world=world))
    return ("deploy", path, *given(robot=world, encoder="serial:///dev/ttyACM0"))
