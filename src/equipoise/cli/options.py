"""Verbs of the command line, and the options that several of them share.

A verb is a function that takes an `Output`, arguments by position, and groups of options by
keyword. A field of a group is an option, its docstring the help text, and the first line of the
group's docstring the title above it. `verb` makes the flat signature that typer reads, adds
`--json`, and ends an interruption with its exit code. A help text lists the names of a table of
`TABLES` by {NAME}.
"""

import os
import shlex
import signal
from collections.abc import Callable, Iterable
from contextlib import suppress
from inspect import Parameter, Signature, getdoc, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, get_args, get_type_hints

import typer
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from rich.markup import escape

import equipoise as eq
from equipoise.cli.output import Output, complain, signals
from equipoise.entry_points import registered
from equipoise.errors import INTERRUPTED, InputError
from equipoise.files import Artefact, reserved
from equipoise.learning.rewards import REWARDS
from equipoise.model.worlds import named_twins
from equipoise.settings import RECIPES, Friction

if TYPE_CHECKING:
    from equipoise.control.policy import TaskPolicy

TABLES: Final = {
    "arms": sorted(registered("equipoise.arms")),
    "frictions": get_args(Friction),
    "recipes": RECIPES,
    "rewards": REWARDS,
    "worlds": named_twins(),
}
"""Names that help texts list; each table is light to import."""


class Options(BaseModel):
    """Group of options."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


def verb(function: Callable[..., None]) -> Callable[..., None]:
    """Return a verb with the flat signature that typer reads."""
    hints, parameters = get_type_hints(function), list[Parameter]()
    groups: dict[str, type[Options]] = {}

    def add(name: str, kind: Any, default: Any, declaration: Any) -> None:
        annotation = Annotated[kind, declaration]
        parameters.append(
            Parameter(name, Parameter.KEYWORD_ONLY, annotation=annotation, default=default)
        )

    for name, parameter in signature(function).parameters.items():
        kind = hints[name]
        if parameter.kind is Parameter.KEYWORD_ONLY:
            groups[name] = kind
            title = (getdoc(kind) or "").partition("\n")[0].rstrip(".")
            kinds = get_type_hints(kind)  # without the bounds
            for field, info in kind.model_fields.items():
                names = {table: ", ".join(TABLES[table]) for table in TABLES}
                text = escape((info.description or "").format_map(names))
                option = typer.Option(_name(field), help=text, rich_help_panel=title)
                default = Parameter.empty if info.is_required() else info.default
                add(field, kinds[field], default, option)
        elif kind is not Output:
            argument = typer.Argument(metavar=name.upper(), show_default=False)
            add(name, kind, parameter.default, argument)
    json = typer.Option("--json", help="Print one JSON object and nothing else.")
    add("as_json", bool, False, json)

    def run(*, as_json: bool, **args: Any) -> None:
        try:
            for name, group in groups.items():
                args[name] = group(**{field: args.pop(field) for field in group.model_fields})
            output = Output(as_json)
            with signals(raising=True) as output.stopped, output.reserved_names:
                function(output, **args)
        except ValidationError as error:
            fault = error.errors()[0]
            raise InputError(f"{_name(str(fault['loc'][-1]))}: {fault['msg']}") from None
        except KeyboardInterrupt:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # nothing interrupts the clean-up
            complain("interrupted")
            raise typer.Exit(INTERRUPTED) from None

    run.__name__, run.__doc__, run.__annotations__ = function.__name__, function.__doc__, {}
    run.__signature__ = Signature(parameters)  # pyright: ignore[reportFunctionMemberAccess]
    return run


def command(verb: str, *arguments: object, **options: object) -> str:
    """Return the next command to try, as typed after `equipoise`.

    Args:
        verb: The verb.
        arguments: Arguments, without those that are None; of a group of options, those that differ
            from the defaults.
        options: Further options by their fields; None is left out.
    """
    words, fields = verb.split(), dict[str, object]()
    for argument in arguments:
        if isinstance(argument, Options):
            fields |= argument.model_dump(exclude_defaults=True)
        elif argument is not None:
            words.append(str(argument))
    for field, value in (fields | options).items():
        for item in value if isinstance(value, list) else [value]:
            if item is not None:
                words += [_name(field)] if item is True else [_name(field), str(item)]
    return shlex.join(words)


def _name(field: str) -> str:
    return "--" + field.rstrip("_").replace("_", "-")


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

    def resolve(self, **named: object) -> "eq.Settings":
        """Return the settings, with those that an option of their own names, where given."""
        chosen = [f"{name}={value}" for name, value in named.items() if value is not None]
        return eq.resolve(self.recipe, self.settings, [*(self.set or ()), *chosen])


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
        return eq.load_policy(
            policy,
            pendulum=self.pendulum,
            arm=None if self.arm is None else read_arm(self.arm),
            actuator=self.actuator,
            settings=None if self.settings is None else eq.resolve(file=self.settings),
        )


class Random(Options):
    """Random numbers and workers."""

    seed: Seed = 0
    """Master seed; equal seeds give equal results."""
    workers: str | None = None
    """Number of threads (default: one per core); or a Dask scheduler, tcp://HOST:8786. Results do
    not depend on it."""


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
        self, output: Output, default: str, *inputs: Path | None, beside: Iterable[str] = ()
    ) -> Path:
        """Return the file to write; its name is reserved until the end of the verb.

        Args:
            output: Output of the verb.
            default: Name without `--out`; a number is added where it is taken.
            inputs: Files that the verb reads; they are never replaced.
            beside: Ends of the names of further files, after the stem.

        Raises:
            InputError: The name has another suffix, or a file exists or is read.
            OSError: It cannot be written.
        """
        suffix = Path(default).suffix
        if self.out and self.out.suffix.lower() != suffix:
            raise InputError(f"{self.out} is to be written; give a name that ends in {suffix}")
        out, *others = self._reserve(output, Path(default), beside)
        read = [path for path in inputs if path and os.path.exists(path)]
        for path in (out, *others):
            if path.exists() and any(map(path.samefile, read)):
                raise InputError(f"{path} is read and would be written over; give another name")
        return out

    def folder(self, output: Output, default: Path) -> Path:
        """Return the folder to write; it is created, and removed if it stays empty.

        Raises:
            InputError: It has files that shall not be replaced.
            OSError: It cannot be created.
        """
        (out,) = self._reserve(output, default)
        if not out.exists():
            output.reserved_names.callback(_remove_empty, out)
        out.mkdir(parents=True, exist_ok=True)
        return out

    def _reserve(self, output: Output, default: Path, beside: Iterable[str] = ()) -> list[Path]:
        """Reserve the first free names: that of `--out`, or the default with a number."""
        out, number = self.out or default, 2
        while True:
            paths = [out, *(out.with_name(out.stem + end) for end in beside)]
            try:
                output.reserved_names.enter_context(reserved(paths, replace=self.force))
            except FileExistsError as error:
                if self.out is not None:
                    raise InputError(
                        f"{error.filename} exists; give another name, or --force to write over it"
                    ) from None
                out = default.with_stem(f"{default.stem}-{number}")
                number += 1
            else:
                if number > 2:
                    output.tell(f"{default} is taken; writing {out}")
                return paths


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):  # it has files
        folder.rmdir()


def read_arm(name: str) -> "eq.Arm":
    """Return the arm of `--arm`: a registered name, or the path of a URDF or of a rig.toml.

    Raises:
        InputError: There is no such arm.
    """
    from equipoise.arm import urdf
    from equipoise.rig.config import read_rig

    toml = Path(name).suffix.lower() == ".toml"
    return read_rig(Path(name)).described_arm if toml else urdf.read_arm(name)


def file_of(digest: str, shipped: Artefact) -> Path | None:
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


def name_of(arm: "eq.Arm") -> str | None:
    """Return the registered name of an arm: None for the default, ARM for one without a name."""
    with suppress(InputError):
        if read_arm(arm.name) == arm:
            return None if arm.name == "iiwa7" else arm.name
    return "ARM"
