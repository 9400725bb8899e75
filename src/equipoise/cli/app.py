"""The command and its verbs, grouped: pipeline, robot, logs."""

from functools import partial

import typer

from equipoise import __version__
from equipoise.cli.deploy import console, deploy
from equipoise.cli.evaluate import evaluate, play
from equipoise.cli.identify import identify, refine
from equipoise.cli.logs import explain, export, show
from equipoise.cli.rig import doctor, emulate, record
from equipoise.cli.train import reproduce, train, warm_up

group = partial(
    typer.Typer,
    no_args_is_help=True,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)
app = group(
    name="equipoise",
    help="Teach a robot arm to balance an inverted pendulum: identify, train, evaluate, deploy.",
    epilog="Begin with: equipoise reproduce",
)
rig = group(help="Check, emulate and use a rig: doctor, emulate, record.")
log = group(help="Read the log of a run: show, explain, export.")
members = (
    (app, "Pipeline", (reproduce, identify, train, evaluate, refine, play, warm_up)),
    (app, "The robot", (deploy, console)),
    (rig, None, (doctor, emulate, record)),
    (log, None, (show, explain, export)),
)
for parent, panel, verbs in members:
    for verb in verbs:
        parent.command(rich_help_panel=panel)(verb)
app.add_typer(rig, name="rig", rich_help_panel="The robot")
app.add_typer(log, name="log", rich_help_panel="Logs")


@app.callback(invoke_without_command=True)
def _command(version: bool = typer.Option(False, "--version", help="Print the version.")) -> None:
    """Carry the options that belong to no verb; typer takes its help from `app`."""
    if version:
        print(f"equipoise {__version__}")
        raise typer.Exit
