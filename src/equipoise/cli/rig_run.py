"""The run of `equipoise deploy` on an emulated or a real rig."""

from contextlib import ExitStack
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

from equipoise.cli.output import Output, signals
from equipoise.cli.terminal_operator import TerminalOperator, single_keys
from equipoise.errors import InputError
from equipoise.user_code import guest_code

if TYPE_CHECKING:
    from equipoise.rig.request import RunRequest

ACTUATOR = "-actuator.json"
"""End of the name of the actuator that a run identifies, after the log's."""


class Spectator:
    """Operator who receives messages, and can stop the run by a signal only."""

    def __init__(self, person: TerminalOperator, stopped: Event) -> None:
        """Pass messages on to a person."""
        self.notify, self._stopped = person.notify, stopped

    def read_input(self) -> list[str]:
        """Return a stop after a signal."""
        return ["stop"] if self._stopped.is_set() else []


def run_on_rig(output: Output, request: "RunRequest", out: Path, *, console: bool) -> None:
    """Run on an emulated or a real rig, write the log, and print the result.

    Args:
        output: The terminal.
        request: The run.
        out: Path of the log.
        console: Whether the run is shown in the browser, too.
    """
    from equipoise.rig.connection import world_of
    from equipoise.rig.preflight import check_request
    from equipoise.rig.processes import run_in_processes
    from equipoise.rig.run import run_virtually

    check_request(request)
    if console and world_of(request.robot):
        raise InputError(
            f"--console shows a run in real time, and {request.robot} runs in virtual time; start "
            "equipoise rig emulate, and give the --robot and --encoder that it prints"
        )
    person = TerminalOperator(output)
    if world_of(request.robot):
        with signals() as stopped, guest_code(f"the driver of {request.robot}"):
            end = run_virtually(request, out, Spectator(person, stopped))
    else:
        with ExitStack() as stack:
            if console:
                from equipoise.apps.console.server import console_process

                output.tell(f"  console  {stack.enter_context(console_process())}")
            stack.enter_context(single_keys())
            end = run_in_processes(request, out, person, person.live)
    actuator = None
    if end.identified is not None:
        actuator = out.with_name(out.stem + ACTUATOR)
        end.identified.save(actuator, command="deploy", inputs={})
    names = ("outcome", "reason", "stoppable", "zero", "missed", "late", "compute")
    output.result(
        world=request.robot,
        lasted_s=end.lasted,
        **{name: getattr(end, name) for name in names},
        identified=end.identified and end.identified.summary,
        actuator=actuator,
        run=out,
        code=end.exit_code,
        then="log explain RUN",
    )
