"""`equipoise rig doctor`: checks whether machine and rig are fit for a run."""

from pathlib import Path
from typing import TYPE_CHECKING, Final

from equipoise.cli import options as opt
from equipoise.cli.output import VERDICT_STYLES, Output, verb
from equipoise.errors import InputError
from equipoise.printable import printable

if TYPE_CHECKING:
    from rich.table import Table

    from equipoise.rig.checks.results import Spread
    from equipoise.rig.doctor import Diagnosis

FITNESS_STYLES: Final = {"fit": "green", "usable with care": "yellow", "not fit": "red"}
"""Styles of the verdict on machine and rig."""


@verb
def doctor(
    seconds: float = opt.value("S", "Duration of each measurement.", default=5.0),
    load: bool = opt.flag("--load", "Measure again while every core is kept busy."),
    robot: str | None = opt.ROBOT,
    encoder: str | None = opt.ENCODER,
    rig: Path | None = opt.RIG,
    logs: Path = opt.value(
        "FOLDER", "Folder of the run logs.", panel=opt.IN_AND_OUT, default=Path()
    ),
    as_json: bool = opt.JSON,
) -> None:
    """Check whether machine and rig are fit for a run, and advise a cure.

    Nothing moves. The robot's answers are timed at rest, and its server ends
    with that session. Exit code 1: not fit.
    """
    opt.check_range("--seconds", seconds, 0.05, 3600.0, " s")
    if logs.is_file():
        raise InputError(f"--logs is the file {logs}; give the name of a folder")
    output = Output(as_json)
    examined = "this machine" if robot is None and encoder is None else "machine and rig"
    output.say(f"Examining {examined}; nothing moves")

    from equipoise.rig.config import is_virtual, read_rig, restart_instruction
    from equipoise.rig.doctor import examine

    if robot is not None and is_virtual(robot):
        raise InputError(
            f"{robot} has no link to time; give kst://HOST:30001, such as that of equipoise rig "
            "emulate"
        )
    diagnosis = examine(
        robot,
        encoder,
        None if rig is None else read_rig(rig),
        seconds=seconds,
        load=load,
        logs=logs,
        busy=output.busy,
        tell=output.say,
    )
    _say(output, diagnosis, examined)
    if robot and diagnosis.link is not None and (restart := restart_instruction(robot)):
        output.say(
            f"This session with the robot has ended; before the next one, {restart}. "
            "equipoise deploy times the link itself, in the session of the run."
        )
    output.result(**diagnosis.model_dump(mode="json"), bad=diagnosis.verdict == "not fit")


def _say(output: Output, diagnosis: "Diagnosis", examined: str) -> None:
    from rich.table import Table
    from rich.text import Text

    encoder = diagnosis.encoder
    histograms = {
        "Lateness of deadlines at 200 Hz": diagnosis.lateness,
        "... with every core busy": diagnosis.loaded,
        "Round trip to the robot": diagnosis.link,
        "Age of the encoder's newest sample": None if encoder is None else encoder.age,
    }
    for title, spread in histograms.items():
        if spread is not None:
            output.say(f"\n{title}")
            output.say(bars(spread))
            shares = (f"{share:.2%} above {t} ms" for t, share in spread.longer.items())
            output.say(f"  {', '.join(shares)}", style="dim")
    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True, style="dim")
    table.add_column(overflow="fold")
    for finding in diagnosis.findings:
        verdict = Text(f"  {finding.verdict}", style=VERDICT_STYLES[finding.verdict])
        table.add_row(verdict, finding.name, finding.found)
        if finding.cure:
            table.add_row("", "", Text(f"-> {printable(finding.cure)}", style="italic"))
    output.say()
    output.say(table)
    verdict = f"\nVerdict on {examined}: {diagnosis.verdict}."
    output.say(verdict, style=FITNESS_STYLES[diagnosis.verdict])
    output.say("What each line means: docs/how-to/real-time.md", style="dim")


BLOCKS: Final = " ▏▎▍▌▋▊▉█"
BAR_WIDTH: Final = 40
"""Length of the longest bar of a histogram, in characters."""


def bars(spread: "Spread") -> "Table":
    """Return a histogram as bars of characters, one range on each line."""
    from rich.table import Table

    from equipoise.rig.checks.results import HISTOGRAM_EDGES

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
