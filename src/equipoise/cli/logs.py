"""Verbs that read the log of a run: `equipoise log show`, `explain` and `export`."""

from pathlib import Path
from typing import Any

import equipoise as eq
from equipoise import paper
from equipoise.cli import options as opt
from equipoise.cli.output import Output, signals
from equipoise.errors import InputError


@opt.verb
def show(output: Output, run: Path, *, page: opt.Page) -> None:
    """Replay a run in the browser: the arm in 3-D, plots, events, until Ctrl-C.

    Open the printed address, token included. The page plays the run at 0.1 to 4
    times its speed, steps by ticks, and jumps to events. A truncated log is
    shown as far as it is readable.
    """
    from equipoise.console.replay import ReplayPage
    from equipoise.console.web import serving

    log = eq.RunLog.load(run, damaged=True)
    with signals() as stopped, serving(page.listen, page.port) as (server, address):
        replay = ReplayPage(server, log, run.stem)
        output.result(run=run, replay=address, warnings=[log.damage])
        replay.play(stopped.is_set)


@opt.verb
def explain(output: Output, run: Path) -> None:
    """Explain why a run ended, or how well it balanced.

    Examines release, pushes, delay, the encoder's zero, commands and safety
    rules. Prints causes with their evidence, the most likely first, and advice;
    for a run that survived or that the operator ended, motion and limits.
    A truncated log is read as far as it is readable.
    """
    from equipoise.outcomes import Outcome, describe
    from equipoise.rig.explanation import explain as why

    log = eq.RunLog.load(run, damaged=True)
    causes, end = why(log), log.ending
    then = opt.command("log show", run)
    if end.outcome is Outcome.EXCITED:
        then = opt.command("identify", run)
    if end.outcome in (Outcome.SURVIVED, Outcome.OPERATOR) and len(log.ticks):
        fields = _balance(log)
    else:
        fields: dict[str, Any] = {
            "cause": causes[0].cause,
            "advice": causes[0].cause.advice,
            "causes": {
                str(cause.cause): {
                    "score": cause.score,
                    "time_s": cause.time,
                    "evidence": cause.evidence,
                }
                for cause in causes
            },
        }
    output.result(
        warnings=[log.damage],
        outcome=end.outcome,
        reason=describe(end) if end.evidence else None,
        survival_s=causes[0].time and log.survival,
        **fields,
        phase=None if log.conditions.simulated else log.last_phase and log.last_phase.value,
        log_complete=log.end is not None,
        then=then,
    )


def _balance(run: "eq.RunLog") -> dict[str, Any]:
    """Return how a run balanced: values that safety rules compare, and their limits."""
    import numpy as np

    def extent(values: Any, limit: float | None) -> dict[str, Any]:
        rms, largest = np.sqrt(np.mean(values**2)), np.abs(values).max()
        return {"rms": float(rms), "largest": float(largest), "limit": limit}

    arm, h, sent, ticks = run.conditions.arm, run.conditions.h, run.stream.q, run.ticks
    dq = np.diff(sent, axis=0) / (0.5 * h) if len(sent) > 1 else ticks.dq  # of two setpoints a tick
    fraction = (run.conditions.rig or {}).get("speed_fraction")
    limits = np.array([joint.velocity for joint in arm.joints])
    limits *= fraction if isinstance(fraction, float) else 1.0
    fastest = int(np.argmax(np.abs(dq).max(axis=0) / limits))
    return {
        "x_mm": extent(1e3 * ticks.estimated_x, 1e3 * paper.X_LIMIT),
        "phi_deg": extent(np.degrees(ticks.estimated_phi), paper.PHI_LIMIT_DEG),
        "flange_speed_m_s": extent(ticks.estimated_x_dot, run.end and run.end.max_speed),
        "joint_speed_rad_s": {"joint": arm.joints[fastest].name}
        | extent(dq[:, fastest], float(limits[fastest])),
    }


class Film(opt.Options):
    """The film."""

    video: Path | None = None
    """Write a film instead, .mp4 or .webp."""
    from_: float | None = None
    """Start of the film [s], counted from the release."""
    to: float | None = None
    """End of the film [s], counted from the release."""


@opt.verb
def export(output: Output, run: Path, *, film: Film, files: opt.Files) -> None:
    """Write each table of a run log as a CSV file, or film the run.

    Writes a folder, by default named after the log. Headers end in the unit:
    time_s, phi_rad. A truncated log is written as far as it is readable. The
    film begins shortly before the swing-up or the release; --from and --to
    select another part.
    """
    from equipoise.film import film_format, write_film

    video, tables = film.video, None
    suffix = film_format(video) if video else ""  # before the log, which takes longer
    if video is None and film != Film():
        raise InputError("--from and --to choose the part of a film; give --video FILE as well")
    log = eq.RunLog.load(run, damaged=True)
    if video is None:
        tables = log.export(files.folder(output, run.with_name(f"{run.stem}-csv")))
    else:
        opt.Files(out=video, force=files.force).file(output, f"film{suffix}", run)
        with output.busy("drawing the film"):
            write_film(log, video, film.from_, film.to)
    output.result(
        run=run,
        tables=tables,
        video=video,
        warnings=[log.damage],
        then=opt.command("log explain", run),
    )
