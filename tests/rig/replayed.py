"""Replay of a run on a rig: the measurements of its log go through the controller again.

The log holds all inputs of a tick: counts, replies, typed lines, failures, lateness. A new
`RunController` receives the same inputs at the same times, from the first setpoint to rest.
"""

from concurrent.futures import Future
from dataclasses import replace

import numpy as np

from equipoise.control.bound_policy import BoundPolicy
from equipoise.control.ticks import TickInputs, TickRecord
from equipoise.identification.actuator import identify_actuator
from equipoise.log.recorder import FAILED, WORD_TYPED
from equipoise.outcomes import End, Outcome
from equipoise.rig.config import RigSettings
from equipoise.rig.interfaces import Reply, Sample
from equipoise.rig.request import RunRequest
from equipoise.rig.run_controller import RunController
from equipoise.rig.script import Run

JOBS = {"self-test", "actuator", "identified"}
"""Names of events in ticks in which a job has ended."""
JOBS_FAILED = {Outcome.SELF_TEST, Outcome.UNIDENTIFIED}
"""Ends by a job that failed."""


class PolicyClock:
    """Clock of the policy's computing time: a call takes no time, or exceeds its limit."""

    late, now = False, 0.0

    def __call__(self):
        self.now += 1.0 if self.late else 0.0
        return self.now


class Jobs:
    """Helper process of a replay, whose jobs end when they ended in the run."""

    def __init__(self):
        self.running = []

    def submit(self, job):
        self.running.append((job, Future()))
        return self.running[-1][1]

    def end(self):
        job, future = self.running.pop()
        try:
            future.set_result(job())
        except Exception as error:  # the run controller stops on it
            future.set_exception(error)


def replay(run, policy):
    """Return the number of equal ticks, and the names of what differs first; empty for nothing."""
    conditions, reply = run.conditions, run.tables["reply"]
    assert conditions.actuator == policy.actuator.digest
    if isinstance(policy, BoundPolicy):
        policy = replace(policy, settings=conditions.settings)
    request = RunRequest(
        policy, policy.actuator, RigSettings.model_validate(conditions.rig),
        conditions.world, conditions.encoder, conditions.duration,
        identify=identify_actuator if conditions.identifies else None,
        max_speed=run.end and run.end.max_speed,
        start=conditions.settings.evaluation.start, reference=conditions.reference,
    )  # fmt: skip
    at_start = reply[np.isnan(reply["sent"])]["q"][0].tolist()
    clock, jobs = PolicyClock(), Jobs()
    state = Run(request, at_start, clock, jobs.submit)
    return compared(run, RunController(state), clock, jobs)


def compared(run, controller, clock, jobs):
    """Give a controller the inputs of each tick, and compare its outputs with the log."""
    tables = ("tick", "stream", "encoder", "reply")
    tick, stream, encoder, reply = (run.tables[name] for name in tables)
    reply = reply[np.isfinite(reply["sent"])]
    ends = [*np.searchsorted(stream["time"], tick["time"][1:]).tolist(), len(stream)]
    unsent = False
    for number, (row, end) in enumerate(zip(tick, ends, strict=True)):
        now = float(row["time"])
        events = [event for event in run.events if event.time == now]
        names = {event.name for event in events}
        failures = [event.text for event in events if event.name == FAILED]
        ended = run.end if "stopping" in names else None
        # In the tick of a verdict, or of a selected actuator, its job has ended.
        if jobs.running and (JOBS & names or (ended and ended.outcome in JOBS_FAILED)):
            jobs.end()
        samples = during(encoder, "received", now)[list(Sample._fields)].tolist()
        replies = during(reply, "taken", now)[["sent", "time", "q", "torque"]].tolist()
        inputs = TickInputs(
            samples=[Sample(t, n, bool(p), bool(i), missing) for t, n, p, i, missing in samples],
            replies=[Reply(sent, t, known(q), known(torque)) for sent, t, q, torque in replies],
            lines=[event.text for event in events if event.name == WORD_TYPED],
            faults=[End(Outcome.ENCODER_LOST, {"text": text}) for text in failures],
            lateness=float(row["late"]),
            unsent=unsent,
        )
        clock.late = ended is not None and "took" in ended.evidence
        output = controller.tick(now, inputs)
        first = int(np.searchsorted(stream["time"], now))
        sent = stream["q"][first:end][: len(output.setpoints)]
        unsent = len(sent) < len(output.setpoints)
        made = output.record._asdict() | {"state": output.state, "q": output.q, "dq": output.dq}
        columns = (*TickRecord._fields, "state", "q", "dq")
        pairs = {name: (row[name], made[name]) for name in columns}
        pairs["setpoints"] = sent, np.reshape(output.setpoints[: len(sent)], sent.shape)
        different = [
            name for name, pair in pairs.items() if not np.array_equal(*pair, equal_nan=True)
        ]
        if different:
            return number, different
    return len(tick), []


def during(table, column, time):
    first, last = (int(np.searchsorted(table[column], time, side)) for side in ("left", "right"))
    return table[first:last]


def known(values):
    return None if np.isnan(values).any() else tuple(values.tolist())
