"""`equipoise bench`: steps per second, side by side."""

from equipoise.cli.options import ArmName, Base, Held, Json, Tip, read_arm
from equipoise.cli.output import Output, verb


@verb
def bench(
    arm: ArmName = "iiwa7",
    held: Held = None,
    base: Base = None,
    tip: Tip = None,
    as_json: Json = False,
) -> None:
    """Measure training steps per second beside Pinocchio and Gymnasium, on one core."""
    output = Output(as_json)
    output.say("Measuring on one core, in alternating rounds; half a minute or so")

    from equipoise.model.pendulum import shipped_pendulum
    from equipoise.settings import Settings
    from equipoise.studies.benchmark import benchmark, table

    machine = read_arm(arm, held, base, tip)
    with output.busy("preparing") as tell:
        result = benchmark(shipped_pendulum(), machine, Settings(), progress=tell)
    output.say(table(result))
    output.next("reproduce")
    output.result(
        {
            "steps_per_second": result.steps_per_second,
            "ratios": result.ratios,
            "missing": result.missing,
            "processor": result.processor,
        }
    )
