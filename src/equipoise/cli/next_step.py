"""Which command comes next: the words of each verb's last line, from what came of it.

Each function returns the words after `equipoise`. A command keeps what the user gave: policy,
world, actuator, arm, limits. Files that a value was made from are found beside it by their digest;
where there is none, its name stands in capitals, as in the help.
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
"""Learners of a training that shall do better than one with the default of three."""
LOOKED_AT: Final = 200
"""Files that are looked at for a digest, at most."""
HEAD: Final = 400
"""Length of the beginning of a file that holds its digest [bytes]."""


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
    """Return a file of ours with a digest from the folders of some files, and from this one.

    Args:
        digest: What the file holds.
        beside: Files, in whose folders it may lie.
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
    """Return what follows a training: the evaluation, or a training of more learners.

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
        policy: The policy that did not do.
        path: Its file.
        pendulum: The pendulum's file, where it was given.
        actuator: The actuator's file, where it was given.
        max_speed: Limit of the flange's speed, where it was given [m/s].
    """
    from equipoise.model.arms.resolve import arm_word
    from equipoise.model.pendulum import shipped_pendulum

    words: Command = _file(pendulum)
    if not words and policy.pendulum.digest != shipped_pendulum().digest:
        words = (str(file_with(policy.pendulum.digest, path) or "PENDULUM"),)
    if actuator is None and policy.actuator.fit is not None:
        actuator = _actuator_of(policy, path)
    limit = policy.settings.plant.max_speed if max_speed is None else max_speed
    options = given(arm=arm_word(policy.arm.name), actuator=actuator, max_speed=limit, seeds=SEEDS)
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
    """Return what follows an evaluation.

    A policy that balances goes from the plant of its training to the twin, and from there to a run;
    one that does not is trained again. On a world of its own without an actuator of that world, the
    arm is excited there first.

    Args:
        balanced: Whether it balanced.
        policy: The policy.
        path: Its file or name; none: the policy that ships.
        task: Options of the task, where they were given; none of a table.
        world: Where it was.
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
        from equipoise.model.arms.resolve import arm_word

        words = given(world=world, arm=arm_word(policy.arm.name), out="excitation.mcap")
        return ("deploy", "--excite", *words)
    return train_again(policy, path, pendulum=pendulum, actuator=actuator, max_speed=max_speed)


def after_run(run: "RunLog", out: Path, path: Path | None, *task: str, world: str) -> Command:
    """Return what follows a run on model or twin: many such trials, or why it ended.

    Args:
        run: The run.
        out: Its file.
        path: The policy's file; none: the policy that ships.
        task: Options of the policy's task, where they were given.
        world: Where it was.
    """
    if run.cause != "lasted":
        return ("log", "explain", str(out))
    return ("evaluate", *_file(path), *given(world=world), *task)


def after_explanation(run: Path, policy: str, moved: bool) -> Command:
    """Return what follows an explanation: the replay, where the log's policy is at hand.

    Args:
        run: The log.
        policy: Digest of the policy that ran; empty where the arm was only excited.
        moved: Whether the run got as far as a tick.
    """
    from equipoise.control.policy import shipped_policy

    if not policy:
        return ("identify", str(run))
    if not moved:
        return (
            "rig",
            "doctor",
        )
    if policy == shipped_policy().digest:
        return ("log", "replay", str(run))
    found = file_with(policy, run)
    return ("log", "replay", str(run), str(found)) if found else ("log", "export", str(run))


def after_refinement(
    moved: bool, refined: Path | None, path: Path, runs: Sequence[Path], worlds: Sequence[str]
) -> Command:
    """Return what follows a comparison with logs.

    Args:
        moved: Whether the model of the policy had drifted.
        refined: The policy that was trained on; none where it was not.
        path: The policy that was compared.
        runs: The logs.
        worlds: Where they were made.
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
