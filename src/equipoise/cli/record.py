"""`equipoise rig record`: records a free swing from the encoder."""

from contextlib import closing
from math import degrees
from typing import Annotated

from pydantic import Field

from equipoise.cli import options as opt
from equipoise.cli.output import Output
from equipoise.cli.verb import Options, command, verb
from equipoise.user_code import guest_code


class Recording(Options):
    """The recording."""

    encoder: str
    """Address of the encoder, e.g. serial:///dev/ttyACM0."""
    duration: Annotated[float, Field(ge=1.0, le=600.0)] = 30.0
    """Maximum duration from the release [s]."""
    counts_per_rev: int | None = None
    """Encoder counts per revolution, after x4."""


@verb
def record(output: Output, *, recording: Recording, files: opt.Files) -> None:
    """Record a free swing of the pendulum from its encoder (swing.csv).

    Hold the pivot still. Let the pendulum hang, lift it, hold it, release it.
    The angle is shown meanwhile. Ctrl-C ends the recording without a file.
    """
    from equipoise.identification.recording import write_swing
    from equipoise.rig.clocks import SystemClock
    from equipoise.rig.connection import open_encoder
    from equipoise.robots.encoder.swing import record_swing

    clock = SystemClock()
    sensor = open_encoder(recording.encoder, clock, counts_per_rev=recording.counts_per_rev)
    out = files.file(output, "swing.csv", suffix=".csv")
    driver = guest_code(f"the driver of {recording.encoder}")
    with output.busy("connecting") as rename, driver, closing(sensor):
        sensor.connect()
        swing, missing = record_swing(
            sensor,
            clock,
            recording.duration,
            tell=lambda instruction: output.tell(f"  {instruction}"),
            show=lambda theta: rename(f"{degrees(theta):+7.1f} deg"),
        )
    write_swing(out, swing)
    output.result(
        samples=len(swing.time),
        duration_s=float(swing.time[-1]),
        missing=missing,
        rejected=sensor.rejected,
        counts_per_rev=sensor.counts_per_rev,
        recording=out,
        then=command("identify", out),
    )
