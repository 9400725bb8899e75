"""Options that several verbs share, in groups, and the values that they name."""

import os
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from equipoise.artefacts import claimed
from equipoise.cli.output import Output
from equipoise.cli.verb import Options
from equipoise.errors import InputError

if TYPE_CHECKING:
    from equipoise.artefacts import Artefact
    from equipoise.control.policy import TaskPolicy
    from equipoise.model.arms.arm import Arm
    from equipoise.settings import Settings


Seed = Annotated[int, Field(ge=0, lt=2**32)]
Port = Annotated[int, Field(ge=0, lt=2**16)]


class Changes(Options):
    """Settings."""

    recipe: str = "robust"
    """{recipes}. fine has 756 boxes, for slow pendulums; paper is as literal as possible."""
    settings: Path | None = None
    """Settings as TOML, one table per section."""
    set: list[str] | None = None
    """One setting, e.g. learning.gamma=0.98; repeatable."""

    def resolve(self, **named: object) -> "Settings":
        """Return the settings, with those that an option of their own names, where given."""
        from equipoise.settings import resolve

        given = [f"{name}={value}" for name, value in named.items() if value is not None]
        return resolve(self.recipe, self.settings, [*(self.set or ()), *given])


class Task(Options):
    """Task of a policy; a table carries its own."""

    pendulum: Path | None = None
    """Pendulum from equipoise identify; by default the table's, or the shipped one."""
    arm: str | None = None
    """{arms}, a URDF or a rig.toml; by default the table's, the rig's, or iiwa7."""
    actuator: str | None = None
    """Actuator that the controller assumes; by default the policy's."""
    settings: Path | None = None
    """Settings as TOML, one table per section."""

    def read(self, policy: Path | None) -> "TaskPolicy":
        """Return a policy, bound to its task: that of its training, or what is given or ships.

        Raises:
            InputError: There is no such policy, or it does not fit the task.
        """
        from equipoise.control.bound_policy import load_policy
        from equipoise.settings import resolve

        return load_policy(
            policy,
            pendulum=self.pendulum,
            arm=None if self.arm is None else read_arm(self.arm),
            actuator=self.actuator,
            settings=None if self.settings is None else resolve(file=self.settings),
        )


class Random(Options):
    """Random numbers and threads."""

    seed: Seed = 0
    """Master seed; equal seeds give equal results."""
    workers: Annotated[int | None, Field(ge=1)] = None
    """Threads; by default one per core. Results do not depend on them."""

    @property
    def threads(self) -> int:
        """Number of threads."""
        from equipoise.executors import available_cores

        return available_cores() if self.workers is None else self.workers


class Page(Options):
    """The page."""

    listen: str = "127.0.0.1"
    """Address to listen on; by default, this computer only."""
    port: Port = 0
    """Port of the page; 0 selects a free one."""


class Rig(Options):
    """The rig."""

    robot: str | None = None
    """kst://HOST:30001; or twin:NAME, an emulated rig ({worlds})."""
    encoder: str | None = None
    """Address of the encoder, e.g. serial:///dev/ttyACM0."""
    rig: Path | None = None
    """Description of the rig as TOML."""


class Files(Options):
    """Files."""

    out: Path | None = None
    """File or folder to write; by default named by the verb, with a number if that is taken."""
    force: bool = False
    """Replace existing files; otherwise they are kept."""

    def file(
        self,
        output: Output,
        default: str,
        *inputs: Path | None,
        suffix: str = ".json",
        beside: Iterable[str] = (),
    ) -> Path:
        """Return the file to write; its name is reserved until the end of the verb.

        Args:
            output: Output of the verb.
            default: Name without `--out`; a number is added where it is taken.
            inputs: Files that the verb reads; they are never replaced.
            suffix: Required end of the name.
            beside: Ends of the names of further files, after the stem.

        Raises:
            InputError: The name has another suffix, or a file exists, is read, or is being written.
            OutsideError: The folder cannot be written.
        """
        read = [one for one in inputs if one and os.path.exists(one)]

        def refusal(out: Path, claims: ExitStack) -> str:
            if out.suffix.lower() != suffix:
                return f"{out} is to be written; give a name that ends in {suffix}"
            for path in (out, *(out.with_name(out.stem + end) for end in beside)):
                if not claims.enter_context(claimed(path)):
                    return f"another command is writing {path}; give another name"
                if path.is_dir():
                    return f"{path} is a folder; give the name of a file to write"
                if path.exists() and any(map(path.samefile, read)):
                    return f"{path} is read and would be written over; give another name"
                if os.path.lexists(path) and not self.force:
                    return f"{path} exists; give another name, or --force to replace it"
            return ""

        return self._reserve(output, Path(default), refusal)

    def folder(self, output: Output, default: Path) -> Path:
        """Return the folder to write, which may be new; it is reserved as a file is.

        Raises:
            InputError: It has files that shall not be replaced, or is being written.
            OutsideError: It is a file, or cannot be written.
        """

        def refusal(out: Path, claims: ExitStack) -> str:
            if not claims.enter_context(claimed(out / "folder")):
                return f"another command is writing {out}; give another name"
            if any(one.name[0] != "." for one in out.iterdir()) and not self.force:
                return f"{out} is not empty; give another name, or --force to write there"
            return ""

        return self._reserve(output, default, refusal)

    def _reserve(
        self, output: Output, default: Path, refusal: Callable[[Path, ExitStack], str]
    ) -> Path:
        """Return the first free name: that of `--out`, or the default with a number.

        Args:
            output: Output of the verb, which keeps the reservation.
            default: Name without `--out`.
            refusal: Reserves a name; returns the reason for which it cannot be written, or "".
        """
        out = self.out or default
        for number in count(2):
            with ExitStack() as claims:
                reason = refusal(out, claims)
                if not reason:
                    output.claims.enter_context(claims.pop_all())
                    break
            if self.out is not None:
                raise InputError(reason)
            out = default.with_stem(f"{default.stem}-{number}")
        if out not in (self.out, default):
            output.tell(f"{default} is taken; writing {out}")
        return out


def read_arm(name: str) -> "Arm":
    """Return the arm of `--arm`: a registered name, or the path of a URDF or of a rig.toml.

    Raises:
        InputError: There is no such arm.
    """
    from equipoise.model.arms import resolve
    from equipoise.rig.config import read_rig

    toml = Path(name).suffix.lower() == ".toml"
    return read_rig(Path(name)).described_arm if toml else resolve.read_arm(name)


def file_of(digest: str, shipped: "Artefact") -> Path | None:
    """Return the file in this folder of the pendulum or actuator with a digest.

    Returns:
        None for the shipped one; its kind in capitals if no file has it.
    """
    if digest == shipped.digest:
        return None
    name = type(shipped).__name__
    for path in sorted(Path().glob(f"*{name.lower()}*.json")):
        with suppress(InputError):
            if shipped.load(path).digest == digest:
                return path
    return Path(name.upper())


def name_of(arm: "Arm") -> str | None:
    """Return the registered name of an arm: None for the default, ARM for one without a name."""
    with suppress(InputError):
        if read_arm(arm.name) == arm:
            return None if arm.name == "iiwa7" else arm.name
    return "ARM"
