"""`equipoise rig record`: records a free swing from the encoder."""

from contextlib import closing
from math import degrees, pi
from pathlib import Path
from typing import TYPE_CHECKING

from equipoise.cli import options as opt
from equipoise.cli.destinations import choose_file
from equipoise.cli.output import Output, gauge, verb
from equipoise.user_code import guest_code

if TYPE_CHECKING:
    pass

GAUGE = 41
"""Characters that show the half turn to either side of hanging."""


@verb
def record(
    encoder: str = opt.value(
        "URI", "Encoder: serial:///dev/ttyACM0, or socket://HOST:PORT.", default=...
    ),
    duration: float = opt.value(
        "SECONDS", "Maximum duration of the swing, from the release.", default=30.0
    ),
    counts_per_rev: int | None = opt.COUNTS_PER_REV,
    out: Path | None = opt.out("Recording to write, CSV.", "swing.csv"),
    force: bool = opt.FORCE,
    as_json: bool = opt.JSON,
) -> None:
    """Record a free swing of the pendulum from its encoder.

    Hold the pivot still. Let the pendulum hang, lift it, hold it, release it.
    The angle is shown meanwhile. Ctrl-C ends the recording without a file.
    """
    output = Output(as_json)
    output.say(f"Listening to {encoder}")
    destination = choose_file(output, out, "swing.csv", force=force, suffix=".csv")
    opt.check_range("--duration", duration, 1.0, 600.0, " s")

    from equipoise.identification.recording import write_swing
    from equipoise.rig.clocks import SystemClock
    from equipoise.rig.config import encoder_at
    from equipoise.robots.encoder.swing import SwingRecorder, record_swing

    prompted = ""

    def prompt(recorder: SwingRecorder) -> None:
        """Print the next action of the operator once, and show the angle on the display."""
        nonlocal prompted
        hint = f"{recorder.hint}; " if recorder.hint else ""
        if (text := f"  {hint}{recorder.stage.value}") != prompted:
            prompted = text
            output.say(text)
        rename(
            f"{gauge(recorder.theta / pi, GAUGE, '-')} {degrees(recorder.theta):+7.1f} deg, "
            f"amplitude {degrees(recorder.amplitude):5.1f} deg, {recorder.elapsed:4.1f} s"
        )

    clock = SystemClock()
    sensor = encoder_at(encoder, clock, counts_per_rev=counts_per_rev)
    try:
        driver = guest_code(f"the driver of {encoder}")
        with output.busy("connecting") as rename, driver, closing(sensor):
            sensor.connect()
            output.say(sensor.description)
            swing, recorder = record_swing(sensor, clock, duration, prompt)
        with destination.claimed() as out:
            write_swing(out, swing)
    except KeyboardInterrupt:
        output.warn(f"interrupted: nothing was recorded, {destination.path} was not written")
        raise
    lasts = float(swing.time[-1])
    output.rows(
        {
            "swing": f"{recorder.periods:g} periods, {recorder.elapsed:.1f} s",
            "amplitude": f"{degrees(recorder.first_amplitude):.1f} deg at first, "
            f"{degrees(recorder.amplitude):.1f} deg at last",
            "samples": f"{len(swing.time):,}, {recorder.missing} missing; "
            f"{sensor.rejected} damaged",
        }
    )
    output.wrote(out)
    output.next("identify", out)
    output.result(
        recording=out,
        samples=len(swing.time),
        duration_s=lasts,
        periods=recorder.periods,
        amplitude_deg=degrees(recorder.first_amplitude),
        missing=recorder.missing,
        rejected=sensor.rejected,
        counts_per_rev=sensor.counts_per_rev,
    )
