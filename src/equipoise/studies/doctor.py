"""Diagnosis of a machine and a rig before a run: all checks that need no policy, and a verdict."""

from collections.abc import Mapping, Sequence
from typing import Literal

from equipoise.artefacts import Value
from equipoise.checks.deadlines import check_lateness, check_loaded_lateness
from equipoise.checks.encoder import EncoderReading, check_encoder
from equipoise.checks.host import HostInfo, check_host, check_realtime
from equipoise.checks.link import check_link, check_networks
from equipoise.checks.results import CheckResult, Spread
from equipoise.devices.realtime import RealtimeSetting

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
    loaded: Spread | None
    """Lateness of deadlines with every core busy."""
    link: Spread | None
    """Round trips to the robot."""
    encoder: EncoderReading | None
    """Statistics of the encoder's stream."""


def diagnose(
    machine: HostInfo,
    measures: Sequence[RealtimeSetting],
    lateness: Spread,
    *,
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
        loaded: Lateness of deadlines with every core busy.
        link: Round trips to the robot.
        encoder: Statistics of the encoder's stream.
        counts_per_rev: Counts per revolution of `rig.toml`, after x4.
        silent: Error message of each device that could not be reached, by the device's name.
    """
    findings = [*check_host(machine), *check_realtime(measures), check_lateness(lateness)]
    if loaded is not None:
        findings.append(check_loaded_lateness(loaded))
    if link is not None:
        findings += [check_link(link), check_networks(machine.networks)]
    if encoder is not None:
        findings += check_encoder(encoder, counts_per_rev)
    findings += [_unreachable(name, error) for name, error in (silent or {}).items()]
    verdicts = {finding.verdict for finding in findings}
    return Diagnosis(
        verdict="not fit"
        if "bad" in verdicts
        else "usable with care"
        if "warning" in verdicts
        else "fit",
        findings=tuple(findings),
        machine=machine,
        lateness=lateness,
        loaded=loaded,
        link=link,
        encoder=encoder,
    )


def _unreachable(name: str, error: str) -> CheckResult:
    """Return the result for a device that could not be reached, from its driver's message."""
    found, _, cure = error.removeprefix(f"{name}: ").partition("; ")
    cure = cure or "check its power, its cable and its address"
    return CheckResult(name, "bad", found, cure, outside=True)
