"""The command and its verbs, in the order in which one needs them."""

from typing import Annotated

import typer

from equipoise.cli.bench import bench
from equipoise.cli.certify import certify
from equipoise.cli.deploy import deploy
from equipoise.cli.doctor import doctor
from equipoise.cli.emulate import emulate
from equipoise.cli.evaluate import evaluate
from equipoise.cli.explain import explain
from equipoise.cli.export import export
from equipoise.cli.gap import gap
from equipoise.cli.identify import identify
from equipoise.cli.record import record
from equipoise.cli.refine import refine
from equipoise.cli.rehearse import rehearse
from equipoise.cli.replay import replay
from equipoise.cli.reproduce import reproduce
from equipoise.cli.train import train
from equipoise.cli.verify import verify

STORY = "The story"
RIG = "The rig"
STUDIES = "Studies"

app = typer.Typer(
    name="equipoise",
    help="Teach a robot arm to balance an inverted pendulum: identify, train, evaluate, deploy.",
    epilog="Begin with: equipoise reproduce --quick",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)

for verb in (reproduce, identify, train, evaluate, deploy):
    app.command(rich_help_panel=STORY)(verb)
for verb in (doctor, record, emulate, rehearse):
    app.command(rich_help_panel=RIG)(verb)
for verb in (explain, replay, certify, gap, refine, verify, export, bench):
    app.command(rich_help_panel=STUDIES)(verb)


def _version(wanted: bool) -> None:
    if wanted:
        from equipoise import __version__

        print(f"equipoise {__version__}")
        raise typer.Exit


@app.callback()
def _command(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Say which version.")
    ] = False,
) -> None:
    """Carry the options that belong to no verb; typer takes its help from `app`."""
