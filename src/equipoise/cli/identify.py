"""Verbs that identify pendulum and arm: `equipoise identify` and `refine`."""

from math import degrees
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

import equipoise as eq
from equipoise.cli import options as opt
from equipoise.cli.output import Output
from equipoise.errors import InputError


class Fit(opt.Options):
    """The recording, friction, and measurements for I and b."""

    start: float | None = None
    """Begin here [s]; by default at the detected release."""
    end: float | None = None
    """End here [s]."""
    counts_per_rev: int | None = None
    """Encoder counts per revolution, after x4."""
    from_upright: bool = False
    """The recorded angle is zero when upright."""
    friction: str | None = None
    """{frictions}; by default viscous, the paper's."""
    mass: Annotated[float | None, Field(gt=0.0, le=1e3)] = None
    """Mass of everything that rotates [kg]."""
    mass_uncertainty: Annotated[float, Field(ge=0.0, le=1e3)] = 0.0
    """Its standard deviation [kg]."""
    length: Annotated[float | None, Field(gt=0.0, le=1e3)] = None
    """Distance from the axis to its centre of mass [m]."""
    length_uncertainty: Annotated[float, Field(ge=0.0, le=1e3)] = 0.0
    """Its standard deviation [m]."""


@opt.verb
def identify(
    output: Output,
    recording: Path,
    *,
    fit: Fit,
    changes: opt.Changes,
    files: opt.Files,
) -> None:
    """Identify a pendulum from a free swing, or an arm's response from a run log.

    A swing is a CSV file with time_s (or time_ms, time_us) and one of theta_rad,
    theta_deg, counts, rate_rad_s. From it come the pendulum (pendulum.json) and
    figure 2 of the paper, the recording and its fit. From a log (MCAP, from
    equipoise deploy --excite) comes the actuator (actuator.json).
    """
    if recording.suffix.lower() == ".mcap":
        _identify_actuator(output, recording, files)
        return
    from equipoise.report.figures import free_swing
    from equipoise.report.style import save

    settings = changes.resolve(**{"identification.friction": fit.friction})
    mass = length = None
    if fit.mass is not None and fit.length is not None:
        mass = eq.Estimate.normal(fit.mass, fit.mass_uncertainty, "given")
        length = eq.Estimate.normal(fit.length, fit.length_uncertainty, "given")
    elif fit.mass is not None or fit.length is not None:
        raise InputError("I and b need both --mass and --length; give the other one too")
    part = fit.model_dump(include={"start", "end", "counts_per_rev", "from_upright"})
    recorded = eq.read_swing(recording, **part)
    out = files.file(output, "pendulum.json", recording, beside=(".svg", ".png"))
    with output.busy(f"fitting {len(recorded.time):,} samples") as show:
        pendulum = eq.identify(recorded, settings.identification, mass, length, show)
        pendulum.save(out, command="identify", inputs={"recording": recorded.sha256})
        drawn = save(free_swing(recorded, pendulum), out.with_suffix(""))
    then, found = opt.command("train", out), pendulum.fit
    if found and found.richer_friction:
        then = opt.command("identify", recording, fit, changes, friction=found.richer_friction)
    output.result(
        pendulum,
        period_s=pendulum.period,
        unexplained_percent=found and 100.0 * found.unexplained,
        zero_deg=degrees(found.offset) if found and found.quantity == "angle" else None,
        pendulum=out,
        figures=drawn,
        then=then,
    )


def _identify_actuator(output: Output, log: Path, files: opt.Files) -> None:
    run = eq.RunLog.load(log, damaged=True)
    out = files.file(output, "actuator.json", log)
    with output.busy(f"fitting {len(run.replies.time):,} measured postures"):
        actuator = eq.identify_run(run)
    actuator.save(out, command="identify", inputs={"run": run.digest})
    pendulum = opt.file_of(run.conditions.pendulum_digest, eq.shipped_pendulum())
    output.result(
        actuator,
        warnings=list(filter(None, [run.damage])),
        actuator=out,
        then=opt.command("train", pendulum, arm=opt.name_of(run.conditions.arm), actuator=out),
    )


@opt.verb
def refine(output: Output, policy: Path, runs: list[Path], *, files: opt.Files) -> None:
    """Compare logs of runs with the model of a policy, and write what has changed.

    POLICY is the table that ran, RUNS are logs from equipoise deploy, on one rig.
    Identifies w2 and the actuator again, and writes what has left its
    interval: the pendulum (refined.json), and the actuator next to it.
    """
    from equipoise.identification.refine import inspect

    table = eq.TabularPolicy.load(policy)
    logs = [eq.RunLog.load(run, damaged=True) for run in runs]
    out = files.file(output, "refined.json", policy, *runs, beside=("-actuator.json",))
    for log in logs:
        output.warn(log.damage)
    with output.busy("identifying again"):
        findings = inspect(table, *logs)
    inputs = {f"run {number}": log.digest for number, log in enumerate(logs, start=1)}
    inputs["policy"] = table.digest
    pendulum = opt.file_of(table.pendulum.digest, eq.shipped_pendulum())
    actuator = opt.file_of(table.actuator.digest, eq.shipped_actuator())
    paths: dict[str, Any] = {}
    if findings.pendulum.digest != table.pendulum.digest:
        paths["pendulum"] = pendulum = out
        findings.pendulum.save(out, command="refine", inputs=inputs)
    if findings.actuator.digest != table.actuator.digest:
        paths["actuator"] = actuator = out.with_name(out.stem + "-actuator.json")
        findings.actuator.save(actuator, command="refine", inputs=inputs)
    then = opt.command("train", pendulum, arm=opt.name_of(table.arm), actuator=actuator)
    output.result(
        findings.fit,
        **findings.response,
        moved=list(findings.moves.values()) or ["nothing"],
        warnings=findings.warnings,
        **paths,
        then=then if paths else "",
    )
