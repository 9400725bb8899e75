"""The next command to try: the last line of each verb, chosen from its result.

Each function returns the words after `equipoise`. The command keeps the given policy, world,
actuator, arm and limits. Input files of a value are found beside it by their digest; a missing file
is named in capitals, as in the help.
"""

from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Final

from equipoise.errors import SettingsError
from equipoise.model.sim_configs import IDEAL, MODEL, PREFIX, read_world

if TYPE_CHECKING:
    from equipoise.control.policy import TabularPolicy, TaskPolicy
    from equipoise.logs.run_log import RunLog

Command = tuple[str, ...]

NOMINAL: Final = f"{PREFIX}nominal"
PLANTS: Final = (IDEAL, MODEL)
"""Worlds without a twin's robot."""
SEEDS: Final = 5
"""Number of learners of a training after a failure; the default is three."""
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


def _file(path: Path | None) -> Command:
    return () if path is None else (str(path),)


def file_with(digest: str, *beside: Path | None) -> Path | None:
    """Find a file by its digest, in the folders of other files and in the current one.

    Args:
        digest: Digest of the file.
        beside: Files whose folders are searched.
    """
    folders = dict.fromkeys([*(path.parent for path in beside if path is not None), Path()])
    for folder in folders:
        for path in islice(sorted(folder.glob("*.json")), LOOKED_AT):
            try:
                with path.open("rb") as file:
                    if digest.encode() in file.read(HEAD):
                        return path
            except OSError:
                continue
    return None


def after_training(out: Path, policy: "TabularPolicy", again: Sequence[str]) -> Command:
    """Return the command after a training: the evaluation, or a training of more learners.

    Args:
        out: The policy's file.
        policy: The policy.
        again: Words of this training, without `--seeds` and `--out`.
    """
    if policy.checkpoints and 2 * policy.checkpoints[0].survived < policy.checkpoints[0].trials:
        return ("train", *again, *given(seeds=2 * SEEDS))
    return ("evaluate", str(out))


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
    from equipoise.model.arms.resolve import arm_option
    from equipoise.model.pendulum import shipped_pendulum

    words: Command = _file(pendulum)
    if not words and policy.pendulum.digest != shipped_pendulum().digest:
        words = (str(file_with(policy.pendulum.digest, path) or "PENDULUM"),)
    if actuator is None and policy.actuator.fit is not None:
        actuator = _actuator_of(policy, path)
    limit = policy.settings.plant.max_speed if max_speed is None else max_speed
    options = given(
        arm=arm_option(policy.arm.name), actuator=actuator, max_speed=limit, seeds=SEEDS
    )
    return ("train", *words, *options)


def _actuator_of(policy: "TaskPolicy", path: Path | None) -> str | None:
    from equipoise.model.actuator import shipped_actuator

    if policy.actuator.digest == shipped_actuator().digest:
        return None
    return str(file_with(policy.actuator.digest, path) or "ACTUATOR")


def after_evaluation(
    balanced: bool,
    policy: "TaskPolicy",
    path: Path | None,
    *task: str,
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
    known = (*_file(path), *there, *task)
    if balanced and world in PLANTS:
        return ("evaluate", *known, *given(max_speed=max_speed))
    if balanced:
        return ("deploy", *known)
    if world not in PLANTS and not world.startswith(NOMINAL) and actuator is None:
        from equipoise.model.arms.resolve import arm_option

        words = given(world=world, arm=arm_option(policy.arm.name), out="excitation.mcap")
        return ("deploy", "--excite", *words)
    return train_again(policy, path, pendulum=pendulum, actuator=actuator, max_speed=max_speed)


def after_run(run: "RunLog", out: Path, path: Path | None, *task: str, world: str) -> Command:
    """Return the command after a simulated run: many such trials, or the explanation of its end.

    Args:
        run: The run.
        out: Its file.
        path: The policy's file; None for the shipped policy.
        task: Options of the policy's task, where they were given.
        world: The world.
    """
    if run.cause != "lasted":
        return ("log", "explain", str(out))
    return ("evaluate", *_file(path), *given(world=world), *task)


def after_explanation(run: Path, policy: str, moved: bool) -> Command:
    """Return the command after an explanation: the replay, if the policy of the log is found.

    Args:
        run: The log.
        policy: Digest of the policy of the run; empty for an excitation.
        moved: Whether the run reached its first tick.
    """
    from equipoise.control.policy import shipped_policy

    if not policy:
        return ("identify", str(run))
    if not moved:
        return ("rig", "doctor")
    if policy == shipped_policy().digest:
        return ("log", "replay", str(run))
    found = file_with(policy, run)
    return ("log", "replay", str(run), str(found)) if found else ("log", "export", str(run))


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
        except SettingsError:  # one that was made in Python, or whose file is gone
            world = NOMINAL
    if refined is not None:
        return ("evaluate", str(refined), *given(world=world if simulated else NOMINAL))
    if moved:
        return ("refine", str(path), *map(str, runs))
    if world == MODEL or simulated:
        return ("deploy", str(path), *given(world=world))
    return ("deploy", str(path), *given(robot=world), "--encoder", "serial:///dev/ttyACM0")
