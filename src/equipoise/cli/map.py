"""`equipoise map`: draws the recoverable set, and the part of it that a policy holds."""

from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING

from equipoise import paper
from equipoise.cli import options as opt
from equipoise.cli.destinations import choose_file, pictures
from equipoise.cli.output import Output, verb

if TYPE_CHECKING:
    from equipoise.studies.recovery_map import HeldShare, MapSlice, RecoveryMap

NAMES = {"pendulum": "phi, phi_dot", "flange": "x, x_dot"}


@verb
def map_recoverable(
    policy: Path | None = opt.POLICY,
    world: str = opt.value("WORLD", "model, ideal or a twin.", default="model"),
    actuator: str | None = opt.KNOWN_ACTUATOR,
    pendulum: Path | None = opt.TASK_PENDULUM,
    arm: str | None = opt.TASK_ARM,
    settings_file: Path | None = opt.SETTINGS_FILE,
    starts: int | None = opt.value("N", "Starts of each slice; 1,600, or 400 on a twin.", min=1),
    duration: float | None = opt.value("SECONDS", "Duration of a trial; by default 10."),
    seed: int = opt.SEED,
    workers: int | None = opt.WORKERS,
    ray: str | None = opt.RAY,
    out: Path | None = opt.out("Map to write, its figure beside it.", "map.json"),
    force: bool = opt.FORCE,
    as_json: bool = opt.JSON,
) -> None:
    """Draw the recoverable set, and the part of it that a policy holds.

    The set holds the states from which some controller balances this
    pendulum, with the delay of the arm, its largest acceleration, the
    failure angle and the track. The policy is tried from starts all over
    two slices of it. Takes a quarter of a minute.
    """
    output = Output(as_json)
    output.say(f"Mapping the starts that {policy or 'the shipped policy'} holds in {world}")
    destination = choose_file(
        output, out, "map.json", policy, pendulum, force=force, beside=pictures
    )
    opt.check_range("--duration", duration, 0.01, 3600.0, " s")

    from equipoise.apps.report.figures.recovery_map import recovery_figure
    from equipoise.apps.report.style import save
    from equipoise.studies import recovery_map as study

    chosen = opt.read_policy(policy, pendulum, arm, actuator, settings_file)
    output.warn(opt.shortfall(chosen))
    known = opt.read_actuator(actuator)
    starts = starts or study.default_starts(world)
    total = study.trials_of(world, starts)
    with output.trials("map", chosen, world, total) as done:
        found = study.map_recovery(
            chosen,
            world=world,
            actuator=known,
            starts=starts,
            duration=study.DURATION if duration is None else duration,
            seed=seed,
            workers=opt.executor(workers, ray),
            done=done,
        )
    inputs = {"policy": found.policy, "pendulum": found.pendulum, "actuator": found.actuator}
    with destination.claimed() as out:
        found.save(out, command="map", inputs=inputs)
        wrote = [out, *save(recovery_figure(found), out.with_suffix(""))]
    _say(output, found)
    output.wrote(*wrote)
    output.next("evaluate", policy, "--world", world)
    output.result(
        map=str(wrote[0]),
        files=[str(path) for path in wrote],
        **{name: getattr(found, name) for name in ("world", "delay", "rate", "seed", "duration")},
        releases_recoverable=found.releases_recoverable,
        release_use=found.use,
        slices=[_result(one) for one in found.slices],
    )


def _say(output: Output, found: "RecoveryMap") -> None:
    e = found.settings.evaluation
    spans = ((e.phi_low, e.phi_high, "deg"), (e.phi_dot_low, e.phi_dot_high, "deg/s"))
    releases = ", ".join(f"{degrees(a):g} to {degrees(b):g} {unit}" for a, b, unit in spans)
    output.rows(
        {
            "limit": f"phi + phi_dot / {found.fade:.1f} of {degrees(found.limit):.1f} deg when the "
            f"arm responds, {1e3 * found.delay:.0f} ms after the release; it grows by "
            f"exp({found.rate:.1f} t)",
            "set by": f"{found.u_max:g} m/s^2 on a track of {paper.X_LIMIT:g} m, falls at "
            f"{paper.PHI_LIMIT_DEG:g} deg",
            "releases": f"{releases}: {100.0 * found.releases_recoverable:.3g} % recoverable; the "
            f"worst reaches {degrees(found.worst):.1f} deg, {100.0 * found.use:.0f} % of the limit",
        }
        | {f"held ({NAMES[one.plane]})": _held(one) for one in found.slices}
    )


def _held(one: "MapSlice") -> str:
    inside, outside = one.held_share("necessary"), one.held_share("outside")
    return (
        f"{_percent(inside)} of the recoverable set; {outside.held} of {outside.starts:,} starts "
        "outside"
    )


def _percent(share: "HeldShare") -> str:
    low, high = (100.0 * end for end in share.interval)
    return (
        f"{share.held:,} of {share.starts:,} starts, {100.0 * share.share:.1f} % "
        f"(95 %: {low:.1f} to {high:.1f})"
    )


def _result(one: "MapSlice") -> dict[str, object]:
    fields: dict[str, object] = {"plane": one.plane}
    for where in ("necessary", "sufficient", "outside"):
        share = one.held_share(where)
        fields[where] = {"held": share.held, "starts": share.starts, "share": share.share}
        fields[f"{where}_interval"] = list(share.interval)
    return fields
