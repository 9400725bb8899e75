"""Series of runs on a rig without a hand in between: what leads on, the logs, the summary."""

from collections import Counter
from collections.abc import Sequence
from math import degrees
from pathlib import Path
from statistics import median
from typing import Any, ClassVar, Final

from equipoise.errors import OutsideError
from equipoise.files import Artefact
from equipoise.log.conditions import RunConditions, RunEnd
from equipoise.log.recorder import Recorder
from equipoise.log.writer import RunWriter
from equipoise.outcomes import Outcome
from equipoise.simulation.evaluation import exact_interval

LEADS_ON: Final = {Outcome.SURVIVED, Outcome.ANGLE, Outcome.TRACK}
"""Ends after which the next run of a series begins; every other end is that of the series."""
MAX_LOGS: Final = 100
"""Maximum number of logs of a series: older ones are deleted. A log takes 4 MB a minute."""


class Series(Artefact):
    """Summary of a series."""

    FORMAT: ClassVar[str] = "equipoise-series"

    policy: str
    """Digest of the policy."""
    world: str
    """Address of the robot."""
    runs: tuple[RunEnd, ...]
    """End of each run, in their order."""


class RunLogs:
    """Logs of the runs of a request, a file each, and the summary of a series beside them."""

    def __init__(self, out: Path, conditions: RunConditions, runs: int, now: float) -> None:
        """Begin the log of the first run.

        Args:
            out: Path of the log of a single run; those of a series have a number added.
            conditions: Conditions of the first run.
            runs: Number of runs.
            now: Time on the rig's clock [s].

        Raises:
            OutsideError: The disk rejects the file.
        """
        self._out, self._runs = out, runs
        self._conditions, self._lost = conditions, 0
        self.ends: list[RunEnd] = []
        """Ends of the runs so far."""
        self.problem: str | None = None
        """Reason of an early end of the logs; None without a failure."""
        self._writer: RunWriter | None = RunWriter(run_path(out, 1, runs), conditions, now)

    def drain(self, recorder: Recorder) -> None:
        """Write the rows recorded since the last call; a failure of the disk sets `problem`."""
        if self._writer is None:
            recorder.take()
            return
        self._writer.drain(recorder)
        self.problem = self.problem or self._writer.problem

    def follow(
        self, recorder: Recorder, now: float, end: RunEnd, conditions: RunConditions
    ) -> None:
        """End the log of a run, and begin that of the next; arguments as of `finish`."""
        self.finish(recorder, now, end)
        number = len(self.ends) + 1
        try:
            self._writer = RunWriter(run_path(self._out, number, self._runs), conditions, now)
            run_path(self._out, number - MAX_LOGS, self._runs).unlink(missing_ok=True)
        except (OSError, OutsideError) as error:
            self._writer, self.problem = None, self.problem or str(error)

    def finish(self, recorder: Recorder, now: float, end: RunEnd) -> None:
        """End the log of a run, and write the summary; a failure of the disk sets `problem`.

        Args:
            recorder: Rings of the run.
            now: Time on the rig's clock [s].
            end: End of the run.
        """
        self.drain(recorder)
        lost, self._lost = recorder.lost - self._lost, recorder.lost
        end = end.model_copy(update={"lost_rows": lost})
        if lost:
            self.problem = self.problem or f"the disk was too slow for {lost:,} rows"
        if self._writer is not None:
            self._writer.finish(now, end)
            self.problem = self.problem or self._writer.problem
        self.ends.append(end)
        if self._runs > 1:
            policy, world = self._conditions.policy, self._conditions.world
            summary = Series(policy=policy, world=world, runs=tuple(self.ends))
            try:
                path = self._out.with_name(f"{self._out.stem}-series.json")
                summary.save(path, command="deploy", inputs={"policy": policy})
            except OutsideError as error:
                self.problem = self.problem or str(error)


def run_path(out: Path, number: int, runs: int) -> Path:
    """Return the path of the log of a run.

    Args:
        out: Path of the log of a single run.
        number: Number of the run, from one.
        runs: Number of runs of the series.
    """
    return out.with_name(f"{out.stem}-{number:03d}{out.suffix}") if runs > 1 else out


def summarise(ends: Sequence[RunEnd]) -> dict[str, Any]:
    """Return the statistics of the runs of a series, by names that end in the unit."""
    swung = [end for end in ends if end.upright is not None or end.outcome is Outcome.NOT_UPRIGHT]
    survived = sum(end.outcome is Outcome.SURVIVED for end in swung)
    values: dict[str, Any] = {"runs": len(ends), "survived": survived}
    if swung:
        values["interval_95"] = exact_interval(survived, len(swung))
    values["outcomes"] = dict(Counter(end.outcome for end in ends))
    upright = [end.upright for end in ends if end.upright is not None]
    if upright:
        values |= {"upright_median_s": median(upright), "upright_max_s": max(upright)}
    ranges = {"zero_change_deg": degrees(1.0), "w2": 1.0, "delay_ms": 1e3}
    for name, scale in ranges.items():
        field = name.removesuffix("_deg").removesuffix("_ms")
        tested = [scale * value for end in ends if (value := getattr(end, field)) is not None]
        if tested:
            values[name] = min(tested), max(tested)
    return values
