"""`equipoise identify`: identifies a pendulum from a swing, or an actuator from a run log."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from equipoise.cli import options as opt
from equipoise.cli.destinations import choose_file, pictures
from equipoise.cli.output import Output, in_ms, measured, verb, with_intervals
from equipoise.errors import InputError

if TYPE_CHECKING:
    from equipoise.artefacts import Estimate
    from equipoise.identification.recording import Trajectory
    from equipoise.model.pendulum import Pendulum


SEPARATE = "Measured separately, for I and b"


@verb
def identify(
    context: typer.Context,
    recording: Path = opt.argument(
        "FILE",
        "A swing: CSV with time_s (or time_ms, time_us) and one of theta_rad, theta_deg, "
        "counts, rate_rad_s. Or a run log, MCAP.",
    ),
    friction: str | None = opt.value(
        "MODEL", "viscous (the paper's, and the default), coulomb or quadratic."
    ),
    start: float | None = opt.START,
    end: float | None = opt.END,
    counts_per_rev: int | None = opt.COUNTS_PER_REV,
    from_upright: bool = opt.FROM_UPRIGHT,
    columns: str | None = opt.COLUMNS,
    mass: float | None = opt.value("KG", "Mass of everything that rotates.", panel=SEPARATE),
    mass_uncertainty: float | None = opt.value("KG", "Its standard deviation.", panel=SEPARATE),
    length: float | None = opt.value(
        "METRES", "Distance from the axis to its centre of mass.", panel=SEPARATE
    ),
    length_uncertainty: float | None = opt.value(
        "METRES", "Its standard deviation.", panel=SEPARATE
    ),
    out: Path | None = opt.out(
        "File to write; pendulum.json, or actuator.json for a run log.", False
    ),
    force: bool = opt.FORCE,
    figure: bool = opt.flag(
        "--figure/--no-figure", "Draw figure 2 beside it.", panel=opt.IN_AND_OUT, default=True
    ),
    settings_file: Path | None = opt.SETTINGS_FILE,
    settings: list[str] | None = opt.SET,
    as_json: bool = opt.JSON,
) -> None:
    """Identify a pendulum from a free swing, or an arm's response from a run log.

    For a swing it writes the pendulum, and figure 2 of the paper: the recording
    and its fit. For a log (equipoise deploy --excite) it writes the actuator.
    """
    output = Output(as_json)
    output.say(f"Reading {recording}")
    if recording.suffix.lower() == ".mcap":
        opt.only(context, "a run log", "recording", "out", "force", "as_json")
        _identify_actuator(output, recording, out, force)
        return
    destination = choose_file(
        output, out, "pendulum.json", force=force, beside=pictures if figure else lambda _: ()
    )

    from equipoise.identification.recording import read_swing
    from equipoise.identification.swing import identify as fit
    from equipoise.settings import resolve

    chosen = list(settings or ())
    if friction is not None:
        chosen.append(f"identification.friction={friction}")
    resolved = resolve(file=settings_file, overrides=chosen).identification
    m = _given_estimate("mass", mass, mass_uncertainty, "kg")
    l = _given_estimate("length", length, length_uncertainty, "m")
    if (m is None) != (l is None):
        raise InputError("I and b need both --mass and --length; give the other one too")
    swing = read_swing(recording, **opt.swing_options(context))
    with output.busy(f"fitting {len(swing.time):,} samples"):
        pendulum = fit(swing, resolved, m, l)
        with destination.claimed() as out:
            pendulum.save(out, command="identify", inputs={"recording": swing.sha256})
            drawn = _draw(out.with_suffix(""), swing, pendulum) if figure else ()
    _say(output, pendulum)
    output.wrote(out, *drawn)
    output.next("train", out)
    output.result(**_result(pendulum, out))


def _identify_actuator(output: Output, log: Path, given: Path | None, force: bool) -> None:
    destination = choose_file(output, given, "actuator.json", log, force=force)

    from equipoise.identification.actuator import identify_run
    from equipoise.logs.runs import load_run
    from equipoise.model.actuator import LAWS, describe_rotor

    run = load_run(log)
    output.warn(run.damage)
    with output.busy(f"fitting {len(run.replies.time):,} measured postures"):
        actuator = identify_run(run)
    with destination.claimed() as out:
        actuator.save(out, command="identify", inputs={"run": run.digest})
    rows = {"servo law": actuator.kind, "transport delay": in_ms(actuator.delay)}
    if actuator.kind in LAWS:
        rows["servo cycle"] = in_ms(actuator.cycle)
    for place, lag in zip(run.conditions.arm.free, actuator.lags, strict=True):
        rows[f"lag of {run.conditions.joints[place]}"] = in_ms(lag)
    rotor = actuator.drive_inertia and actuator.drive_inertia.rotor
    if rotor is not None:
        rows["rotor of the last joint"] = describe_rotor(rotor)
    fit = actuator.fit
    if fit is not None:
        rows["residual"] = f"{fit.rms:.3g} rad RMS over {fit.samples:,} positions"
        rows["one step ahead"] = f"{fit.one_step:.3g} rad, the noise is {fit.noise:.3g} rad"
    output.rows(rows)
    output.warn(*(fit.warnings if fit else ()))
    output.wrote(out)
    from equipoise.model.arms.resolve import arm_option

    arm = arm_option(run.conditions.arm.name)
    output.next("train", "--actuator", out, *(("--arm", arm) if arm else ()))
    output.result(
        kind=actuator.kind,
        **with_intervals({"delay": actuator.delay, "cycle": actuator.cycle}),
        lags=[lag.value for lag in actuator.lags],
        lag_intervals=[list(lag.interval) for lag in actuator.lags],
        rotor_inertia=rotor and [end if math.isfinite(end) else None for end in rotor],
        one_step=fit and fit.one_step,
        noise=fit and fit.noise,
        warnings=list(fit.warnings) if fit else [],
        actuator=out,
    )


def _draw(stem: Path, swing: "Trajectory", pendulum: "Pendulum") -> tuple[Path, ...]:
    from equipoise.apps.report.figures import free_swing
    from equipoise.apps.style import save

    return save(free_swing(swing, pendulum), stem)


def _given_estimate(
    name: str, value: float | None, uncertainty: float | None, unit: str
) -> "Estimate | None":
    from equipoise.artefacts import Estimate

    if value is None:
        if uncertainty is not None:
            raise InputError(f"--{name}-uncertainty is given without --{name}; give both")
        return None
    opt.check_range(f"--{name}", value, 1e-6, 1e3, f" {unit}")
    if uncertainty is not None and not 0.0 <= uncertainty < value:
        raise InputError(
            f"--{name}-uncertainty is {uncertainty:g}; give a number from 0 to --{name}"
        )
    return Estimate.normal(value, uncertainty or 0.0, "given")


def _say(output: Output, pendulum: "Pendulum") -> None:
    import numpy as np

    from equipoise.identification.fitted import amplitudes

    fit = pendulum.fit
    quantities = [
        ("w2 = m g l / I", pendulum.w2, "1/s^2"),
        ("k = m l / I", pendulum.k, "1/m"),
        ("c = b / I", pendulum.c, "1/s"),
    ]
    friction = [("Coulomb / I", pendulum.coulomb, "1/s^2"), ("drag / I", pendulum.drag, "1/rad")]
    quantities += [row for row in friction if row[1].source == "identified"]
    if pendulum.inertia and pendulum.friction:
        quantities += [("I", pendulum.inertia, "kg m^2"), ("b", pendulum.friction, "N m s")]
    rows = {name: measured(estimate, unit) for name, estimate, unit in quantities}
    rows["period"] = f"{pendulum.period:.4g} s, small swings"
    if fit:
        begin, end = fit.window
        unit = "deg/s" if fit.quantity == "rate" else "deg"
        found = "" if fit.release is None else " (release)"
        rows["window"] = f"{begin:.3f} s{found} to {end:.3f} s, {fit.periods:.1f} periods"
        first, last = np.rad2deg(amplitudes(pendulum))
        rows["amplitude"] = (
            f"{first:.3g} deg at first, {last:.3g} deg at last: the range of validity"
        )
        rows["residual"] = f"{fit.rms_deg:.3g} {unit} RMS over {fit.samples:,} samples"
    output.rows(rows)
    output.warn(*(fit.warnings if fit else ()))


def _result(pendulum: "Pendulum", out: Path) -> dict[str, Any]:
    fit = pendulum.fit
    names = ["w2", "k", "c", "coulomb", "drag"]
    names += ["inertia", "friction"] if pendulum.inertia and pendulum.friction else []
    result = with_intervals({name: getattr(pendulum, name) for name in names})
    if fit:
        fields = ("rms_deg", "quantity", "release", "periods")
        result |= {name: getattr(fit, name) for name in fields}
        result |= {"window": list(fit.window), "warnings": list(fit.warnings)}
    return result | {"friction_model": pendulum.friction_model, "pendulum": str(out)}
