"""`equipoise export`: a run log becomes tables that any program reads."""

from pathlib import Path
from typing import Annotated

import typer

from equipoise.cli.options import IN_AND_OUT, Json, RunFile, check_folder
from equipoise.cli.output import Output, verb


@verb
def export(
    run: RunFile,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the tables; by default named as the log.",
            rich_help_panel=IN_AND_OUT,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Write each table of a run log as a CSV file.

    Headers end in the unit: time_s, phi_rad. A log that breaks off is
    written as far as it goes.
    """
    output = Output(as_json)
    folder = run.with_name(f"{run.stem}-csv") if out is None else out
    output.say(f"Writing the tables of {run}")

    from equipoise.studies.runs import export as write
    from equipoise.studies.runs import read_any

    log = read_any(run)
    check_folder(folder)
    made = write(log, folder)
    output.wrote(*made)
    output.next("explain", run)
    output.result({"run": str(run), "tables": [str(path) for path in made]})
