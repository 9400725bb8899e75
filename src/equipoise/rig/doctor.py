"""Diagnosis of a machine and a rig before a run: all checks that need no policy, and a verdict."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Literal, TypeVar

from equipoise.artefacts import Value
from equipoise.errors import LinkError
from equipoise.rig.checks.deadlines import (
    burning,
    check_lateness,
    check_loaded_lateness,
    check_stalls,
    lateness,
    stalls,
)
from equipoise.rig.checks.encoder import EncoderReading, check_encoder, listen
from equipoise.rig.checks.host import HostInfo, check_host, check_realtime, read_host_info
from equipoise.rig.checks.link import check_link, check_networks, connected, round_trips
from equipoise.rig.checks.results import CheckResult, Spread
from equipoise.rig.clocks import SystemClock
from equipoise.rig.config import RigSettings, encoder_at, robot_at
from equipoise.rig.interfaces import AngleSensor, Clock, Robot
from equipoise.rig.realtime import RealtimeSetting, run_with_realtime_priority
from equipoise.user_code import guest_code

D = TypeVar("D", Robot, AngleSensor)
T = TypeVar("T")

Fitness = Literal["fit", "usable with care", "not fit"]


class Diagnosis(Value):
    """Readings of machine and rig, and their verdict."""

    verdict: Fitness
    """Whether a run may follow."""
    findings: tuple[CheckResult, ...]
    """Result of each check."""
    machine: HostInfo
    """Properties of the machine."""
    lateness: Spread
    """Lateness of deadlines."""
    stalls: tuple[float, ...]
    """Duration of each stall of the loop above 20 ms [s]."""
    loaded: Spread | None
    """Lateness of deadlines with every core busy."""
    link: Spread | None
    """Round trips to the robot."""
    encoder: EncoderReading | None
    """Statistics of the encoder's stream."""


def examine(
    robot: str | None,
    encoder: str | None,
    settings: RigSettings | None,
    *,
    seconds: float,
    load: bool,
    logs: Path,
    busy: Callable[[str], AbstractContextManager[object]],
    tell: Callable[[str], None],
) -> Diagnosis:
    """Measure a machine and a rig, and judge the readings; the arm does not move.

    Args:
        robot: Address of the robot; None examines none.
        encoder: Address of the encoder; None examines none.
        settings: Description of the rig; None where it is unknown.
        seconds: Duration of each measurement [s].
        load: Whether deadlines are measured again with every core busy.
        logs: Folder of the run logs.
        busy: Shows the name of a measurement while its context is open.
        tell: Receives messages while a connection is established.

    Raises:
        InputError: An address is invalid.
    """
    clock, rig = SystemClock(), settings or RigSettings()
    arm = None if robot is None else robot_at(robot, clock, tell=tell)
    # The board states its own counts per revolution, and a check compares them.
    sensor = None if encoder is None else encoder_at(encoder, clock, sign=rig.encoder_sign)
    machine = read_host_info(logs)
    with busy("measuring deadlines"):
        late, measures = run_with_realtime_priority(lambda: lateness(clock, seconds))
    loaded: Spread | None = None
    if load:
        with busy("measuring deadlines with every core busy"), burning(machine.cores or 1):
            loaded = Spread.of(run_with_realtime_priority(lambda: lateness(clock, seconds))[0])
    errors: dict[str, str] = {}

    def measure(
        name: str, what: str, device: D | None, work: Callable[[D, Clock, float], T]
    ) -> T | None:
        if device is None:
            return None
        try:
            with busy(what), guest_code(f"the driver of the {name}"), connected(device):
                return run_with_realtime_priority(lambda: work(device, clock, seconds))[0]
        except LinkError as error:
            errors[name] = str(error)

    reading = measure("encoder", "reading the encoder", sensor, listen)
    trips = measure("robot", "timing the robot's replies", arm, round_trips)
    return diagnose(
        machine,
        measures,
        Spread.of(late),
        stalls(late),
        seconds=seconds,
        loaded=loaded,
        link=None if trips is None else Spread.of(trips),
        encoder=reading,
        counts_per_rev=None if settings is None else settings.counts_per_rev,
        silent=errors,
    )


def diagnose(
    machine: HostInfo,
    measures: Sequence[RealtimeSetting],
    lateness: Spread,
    stalls: Sequence[float] = (),
    *,
    seconds: float = 0.0,
    loaded: Spread | None = None,
    link: Spread | None = None,
    encoder: EncoderReading | None = None,
    counts_per_rev: int | None = None,
    silent: Mapping[str, str] | None = None,
) -> Diagnosis:
    """Judge readings of a machine and a rig.

    Args:
        machine: Properties of the machine.
        measures: Results of the real-time settings.
        lateness: Lateness of deadlines.
        stalls: Duration of each stall [s].
        seconds: Length of the measurement [s].
        loaded: Lateness of deadlines with every core busy.
        link: Round trips to the robot.
        encoder: Statistics of the encoder's stream.
        counts_per_rev: Counts per revolution of `rig.toml`, after x4.
        silent: Error message of each device that could not be reached, by the device's name.
    """
    findings = [*check_host(machine), *check_realtime(measures), check_lateness(lateness)]
    findings.append(check_stalls(stalls, seconds))
    if loaded is not None:
        findings.append(check_loaded_lateness(loaded))
    if link is not None:
        findings += [check_link(link), check_networks(machine.networks)]
    if encoder is not None:
        findings += check_encoder(encoder, counts_per_rev)
    for name, error in (silent or {}).items():
        found, _, cure = error.removeprefix(f"{name}: ").partition("; ")
        cure = cure or "check its power, its cable and its address"
        findings.append(CheckResult(name, "bad", found, cure, outside=True))
    verdicts = {finding.verdict for finding in findings}
    care = "usable with care" if "warning" in verdicts else "fit"
    verdict: Fitness = "not fit" if "bad" in verdicts else care
    return Diagnosis(
        verdict=verdict,
        findings=tuple(findings),
        machine=machine,
        lateness=lateness,
        stalls=tuple(stalls),
        loaded=loaded,
        link=link,
        encoder=encoder,
    )
