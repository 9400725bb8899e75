"""Verbs: functions of groups of options, as commands of typer.

A verb takes an `Output`, arguments by position, and groups of options by keyword. A field of a
group is an option, its docstring the help text, and the first line of the group's docstring the
title above it. `verb` makes the flat signature that typer reads, adds `--json`, and ends an
interruption with its exit code. A help text lists the names of a table of `TABLES` by {NAME}.
"""

import shlex
import signal
from collections.abc import Callable
from inspect import Parameter, Signature, getdoc, signature
from typing import Annotated, Any, Final, get_args, get_type_hints

import typer
from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.fields import FieldInfo
from rich.markup import escape

from equipoise.cli.output import Output, complain, signals
from equipoise.entry_points import registered
from equipoise.errors import INTERRUPTED, InputError
from equipoise.learning.rewards import REWARDS
from equipoise.model.worlds import named_twins
from equipoise.settings import RECIPES, Friction

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
    hints, flat = get_type_hints(function), list[Parameter]()
    groups: dict[str, type[Options]] = {
        name: kind
        for name, kind in hints.items()
        if isinstance(kind, type) and issubclass(kind, Options)
    }

    def add(name: str, kind: Any, default: Any, declaration: Any) -> None:
        annotation = Annotated[kind, declaration]
        flat.append(Parameter(name, Parameter.KEYWORD_ONLY, annotation=annotation, default=default))

    for name, parameter in signature(function).parameters.items():
        if group := groups.get(name):
            kinds = get_type_hints(group)  # without the bounds
            for field, info in group.model_fields.items():
                default = Parameter.empty if info.is_required() else info.default
                add(field, kinds[field], default, _option(field, info, group))
        elif hints[name] is not Output:
            argument = typer.Argument(metavar=name.upper(), show_default=False)
            add(name, hints[name], parameter.default, argument)
    json = typer.Option("--json", help="Print one JSON object and nothing else.")
    add("as_json", bool, False, json)

    def run(*, as_json: bool, **given: Any) -> None:
        try:
            for name, group in groups.items():
                given[name] = group(**{field: given.pop(field) for field in group.model_fields})
            output = Output(as_json)
            with signals(raising=True), output.claims:
                function(output, **given)
        except ValidationError as error:
            fault = error.errors()[0]
            raise InputError(f"{_name(str(fault['loc'][0]))}: {fault['msg']}") from None
        except KeyboardInterrupt:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # nothing interrupts the clean-up
            complain("interrupted")
            raise typer.Exit(INTERRUPTED) from None

    run.__name__, run.__doc__, run.__annotations__ = function.__name__, function.__doc__, {}
    run.__signature__ = Signature(flat)  # pyright: ignore[reportFunctionMemberAccess]  # for typer
    return run


def command(verb: str, *arguments: object, **options: object) -> str:
    """Return the next command to try, as typed after `equipoise`.

    Args:
        verb: The verb.
        arguments: Arguments, without those that are None; of a group of options, those that differ
            from the defaults.
        options: Further options by their fields; None is left out.
    """
    words, given = verb.split(), dict[str, object]()
    for each in arguments:
        if isinstance(each, Options):
            given |= each.model_dump(exclude_defaults=True)
        elif each is not None:
            words.append(str(each))
    for field, value in (given | options).items():
        for one in value if isinstance(value, list) else [value]:
            if one is not None:
                words += [_name(field)] if one is True else [_name(field), str(one)]
    return shlex.join(words)


def _name(field: str) -> str:
    return "--" + field.rstrip("_").replace("_", "-")


def _option(field: str, info: FieldInfo, group: type[Options]) -> Any:
    """Return the declaration of an option."""
    title = (getdoc(group) or "").partition("\n")[0].rstrip(".")
    text = (info.description or "").format_map({key: ", ".join(TABLES[key]) for key in TABLES})
    return typer.Option(_name(field), help=escape(text), rich_help_panel=title)
