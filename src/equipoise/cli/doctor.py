"""`equipoise rig doctor`: are machine and rig fit for a run?"""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from equipoise.cli import options as opt
from equipoise.cli.output import Output, verb
from equipoise.errors import InputError, LinkError
from equipoise.printable import printable

if TYPE_CHECKING:
    from rich.table import Table

    from equipoise.checks.encoder import EncoderReading
    from equipoise.checks.results import Spread
    from equipoise.devices.interfaces import AngleSensor, Clock, Robot
    from equipoise.studies.doctor import Diagnosis

THE_RIG = "The rig"
NOT_FIT: Final = 1
"""Exit code where no run should follow."""
LOOKS: Final = {
    "good": ("good", "green"),
    "warning": ("warning", "yellow"),
    "bad": ("bad", "bold red"),
    "unknown": ("unknown", "dim"),
}


@verb
def doctor(
    seconds: Annotated[
        float, typer.Option(min=0.05, max=3600.0, metavar="S", help="How long each is measured.")
    ] = 5.0,
    load: Annotated[
        bool, typer.Option("--load", help="Measure again while every core is kept busy.")
    ] = False,
    robot: Annotated[
        str | None,
        typer.Option(
            metavar="URI",
            help="Time its answers, at rest: kst://HOST:30001. Its server ends with that.",
            rich_help_panel=THE_RIG,
        ),
    ] = None,
    encoder: Annotated[
        str | None,
        typer.Option(
            metavar="URI",
            help="Listen to it: serial:///dev/ttyACM0.",
            rich_help_panel=THE_RIG,
        ),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(
            metavar="TOML", help="What the encoder should be like.", rich_help_panel=THE_RIG
        ),
    ] = None,
    logs: Annotated[
        Path,
        typer.Option(
            metavar="FOLDER", help="Where runs will be logged.", rich_help_panel=opt.IN_AND_OUT
        ),
    ] = Path(),
    as_json: opt.Json = False,
) -> None:
    """Say whether machine and rig are fit for a run, and the cure for what is not.

    Nothing moves. Exit code 1 says that they are not fit.
    """
    if not math.isfinite(seconds):  # typer lets nan through its range
        raise InputError(f"--seconds is {seconds}; give a number of seconds, such as 5")
    if logs.is_file():
        raise InputError(f"--logs is the file {logs}; give the name of a folder")
    output = Output(as_json)
    looked_at = "this machine" if robot is None and encoder is None else "machine and rig"
    output.say(f"Looking at {looked_at}; nothing moves")

    from equipoise.checks.deadlines import burning, lateness
    from equipoise.checks.host import read_host_info
    from equipoise.checks.results import Spread
    from equipoise.devices.clocks import SystemClock
    from equipoise.devices.realtime import run_with_realtime_priority
    from equipoise.rigs import encoder_at, is_virtual, read_rig, robot_at
    from equipoise.studies.doctor import diagnose

    if robot is not None and is_virtual(robot):
        raise InputError(
            f"{robot} has no link to time; give kst://HOST:30001, such as that of equipoise rig "
            "emulate"
        )
    clock, settings = SystemClock(), read_rig(rig)
    arm = None if robot is None else robot_at(robot, clock, tell=output.say)
    # The board's own word on its counts is wanted, and judged here.
    sensor = None if encoder is None else encoder_at(encoder, clock, sign=settings.encoder_sign)
    machine = read_host_info(logs)
    with output.busy("waiting for deadlines"):
        late, measures = run_with_realtime_priority(lambda: lateness(clock, seconds))
    loaded = None
    if load:
        with output.busy("... while every core is busy"), burning(machine.cores or 1):
            loaded = Spread.of(run_with_realtime_priority(lambda: lateness(clock, seconds))[0])
    reading, link, silent = _examine(output, arm, sensor, clock, seconds)
    diagnosis = diagnose(
        machine,
        measures,
        Spread.of(late),
        loaded=loaded,
        link=link,
        encoder=reading,
        counts_per_rev=None if rig is None else settings.counts_per_rev,
        silent=silent,
    )
    _say(output, diagnosis, looked_at)
    if link is not None:
        output.say(
            "The robot's server has ended with this session: start it again on the smartPAD. "
            "equipoise deploy times the link itself, in the session of the run.",
        )
    output.result(diagnosis.model_dump(mode="json"))
    if diagnosis.verdict == "not fit":
        raise typer.Exit(NOT_FIT)


def _examine(
    output: Output,
    robot: "Robot | None",
    sensor: "AngleSensor | None",
    clock: "Clock",
    seconds: float,
) -> "tuple[EncoderReading | None, Spread | None, dict[str, str]]":
    """Look at what there is of a rig; a part that fails is named, with what its driver said."""
    from equipoise.checks.encoder import EncoderReading, listen
    from equipoise.checks.link import connected, round_trips
    from equipoise.checks.results import Spread
    from equipoise.devices.realtime import run_with_realtime_priority

    reading = link = None
    silent: dict[str, str] = {}
    if sensor is not None:
        try:
            with output.busy("listening to the encoder"), connected(sensor):
                heard, _ = run_with_realtime_priority(lambda: listen(sensor, clock, seconds))
            reading = EncoderReading.of(heard)
        except LinkError as error:
            silent["encoder"] = str(error)
    if robot is not None:
        try:
            with output.busy("asking the robot for its joints"), connected(robot):
                trips, _ = run_with_realtime_priority(lambda: round_trips(robot, clock, seconds))
            link = Spread.of(trips)
        except LinkError as error:
            silent["robot"] = str(error)
    return reading, link, silent


def _say(output: Output, diagnosis: "Diagnosis", looked_at: str) -> None:
    from rich.table import Table
    from rich.text import Text

    _draw(output, "How late deadlines of 200 a second were met", diagnosis.lateness)
    if diagnosis.loaded is not None:
        _draw(output, "... while every core was busy", diagnosis.loaded)
    if diagnosis.link is not None:
        _draw(output, "How long the robot took to answer", diagnosis.link)
    if diagnosis.encoder is not None:
        _draw(output, "How old the encoder's newest sample was", diagnosis.encoder.age)
    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True, style="dim")
    table.add_column(overflow="fold")
    for finding in diagnosis.findings:
        words, style = LOOKS[finding.verdict]
        table.add_row(Text(f"  {words}", style=style), finding.name, finding.found)
        if finding.cure:
            table.add_row("", "", Text(f"-> {printable(finding.cure)}", style="italic"))
    output.say()
    output.say(table)
    output.say()
    style = {"fit": "green", "usable with care": "yellow", "not fit": "red"}[diagnosis.verdict]
    output.say(f"Verdict on {looked_at}: {diagnosis.verdict}.", style=style)
    output.say("What each line means: docs/how-to/real-time.md", style="dim")


def _draw(output: Output, title: str, spread: "Spread") -> None:
    output.say()
    output.say(title)
    output.say(bars(spread))
    later = ", ".join(f"{share:.2%} by more than {t} ms" for t, share in spread.longer.items())
    output.say(f"  {later}", style="dim")


BLOCKS: Final = " ▏▎▍▌▋▊▉█"
BAR_WIDTH: Final = 40
"""Length of the longest bar of a histogram, in characters."""


def bars(spread: "Spread") -> "Table":
    """Return a histogram as bars of characters, one range on each line."""
    from rich.table import Table

    from equipoise.checks.results import HISTOGRAM_EDGES

    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(justify="right", style="dim", no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(justify="right", no_wrap=True)
    most = max(count for _, count in spread.histogram)
    for end, count in spread.histogram:
        label = f"over {1e3 * HISTOGRAM_EDGES[-1]:g} ms" if end is None else f"to {1e3 * end:g} ms"
        table.add_row(f"  {label}", bar(count, most), f"{count}" if count else "")
    return table


def bar(count: int, most: int) -> str:
    """Return a bar for a count of at most `most`; any count but zero is visible.

    Example:
        >>> bar(40, 40) == 40 * "█", bar(1, 100_000), bar(0, 5)
        (True, '▏', '')
    """
    eighths = max(round(8 * BAR_WIDTH * count / most), 1) if count else 0
    whole, rest = divmod(eighths, 8)
    return BLOCKS[-1] * whole + (BLOCKS[rest] if rest else "")
