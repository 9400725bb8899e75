"""Replay of a run on a rig: the measurements of its log go through the controller again.

The log holds all inputs of a tick: counts, replies, typed lines, failures, lateness. A new
`RunController` receives the same inputs at the same times, from the first setpoint to rest.
"""

from dataclasses import replace
from math import inf

import numpy as np

from equipoise.control.bound_policy import BoundPolicy
<<<<<<< HEAD
from equipoise.control.control_step import make_controller_params
from equipoise.control.controller import Controller
from equipoise.control.policy import TaskPolicy, tick_policy
from equipoise.control.ticks import TickInputs, TickOutput, TickRecord
from equipoise.identification.actuator import identify_actuator
from equipoise.logs.recorder import FAILED as DEVICE_FAILED
from equipoise.logs.recorder import WORD_TYPED
from equipoise.logs.run_log import RunLog
from equipoise.model.actuator import Actuator
from equipoise.model.worlds import IDEAL
=======
from equipoise.control.policy import tick_policy
from equipoise.control.ticks import TickInputs, TickRecord
from equipoise.identification.actuator import identify_actuator
from equipoise.logs.recorder import FAILED, WORD_TYPED
>>>>>>> main
from equipoise.outcomes import End, Outcome
from equipoise.rig.config import RigSettings
from equipoise.rig.interfaces import Reply, Sample
from equipoise.rig.request import RunRequest
from equipoise.rig.run_controller import RunController

JOBS = {"self-test", "actuator", "identified"}
"""Names of events in ticks that receive the result of a job."""
JOBS_FAILED = {Outcome.SELF_TEST, Outcome.UNIDENTIFIED}
"""Ends by a job that failed."""


<<<<<<< HEAD
class Difference(NamedTuple):
    """First difference between a replay and its log."""

    tick: int
    """Number of the tick, from zero."""
    time: float
    """Time of the tick in the log [s]."""
    what: str
    """Name of the column, e.g. `u`, `state` or `first setpoint`."""
    logged: float
    """Value in the log."""
    replayed: float
    """Value of the replay."""


class Replayed(NamedTuple):
    """Result of a replay."""

    ticks: int
    """Number of ticks that were compared."""
    whole: bool
    """Whether these are all ticks of the run; a damaged log has fewer."""
    difference: Difference | None
    """First difference of bits, if any."""


def replay(run: RunLog, policy: TaskPolicy, actuator: Actuator | None = None) -> Replayed:
    """Replay the measurements of a log through the controller, and compare the outputs.

    Args:
        run: The log.
        policy: The policy that ran.
        actuator: The actuator of its controller (default: the policy's).
    """
    carried = policy.actuators if actuator is None else (actuator,)
    rows = (_of_twin if run.conditions.simulated else _of_rig)(run, policy, carried)
    ticks = 0
    for time, pairs in rows:
        for what, (logged, replayed) in pairs.items():
            if logged != replayed and not (isnan(logged) and isnan(replayed)):
                difference = Difference(ticks, time, what, logged, replayed)
                return Replayed(ticks, not run.damage, difference)
        ticks += 1
    return Replayed(ticks, not run.damage, None)


def _with_digest(carried: Sequence[Actuator], digest: str) -> Actuator:
    """Return the actuator of a digest in a log."""
    return {IDEAL if each.kind == "ideal" else each.digest: each for each in carried}[digest]


Pairs = dict[str, tuple[float, float]]
Rows = Iterator[tuple[float, Pairs]]
"""Time of each tick, and logged and replayed value by name."""


# A run on a rig.


def _of_rig(run: RunLog, policy: TaskPolicy, carried: Sequence[Actuator]) -> Rows:
    conditions, tables = run.conditions, run.tables
    digests = (conditions.actuator, *conditions.alternatives)
    actuator, *others = (_with_digest(carried, digest) for digest in digests)
    if isinstance(policy, BoundPolicy):
        policy = replace(policy, settings=conditions.settings)
    known = {name: getattr(conditions, name) for name in ("encoder", "duration", "t1", "seed")}
    settings = RigSettings.model_validate(conditions.rig)
    vars(settings)["described_arm"] = conditions.arm  # the URDF that it names may be elsewhere
    known |= {"robot": conditions.world, "alternatives": tuple(others)}
    known |= {"identify": identify_actuator if conditions.identifies else None}
    known["anyway"] = conditions.anyway
    request = RunRequest(policy, actuator, settings, dry_run=False, **known)
    counts_per_rev = settings.counts_per_rev
    reply = tables["reply"]
    began = reply[np.isnan(reply["sent"])]
    clock = _PolicyClock()
    limit = None if run.end is None else run.end.max_speed
    max_speed = inf if limit is None else limit
    controller = RunController(
        request.parts(tick_policy(policy), clock, counts_per_rev, max_speed),
        request.response(actuator, counts_per_rev, max_speed),
        began["q"][0].tolist(),
    )
    return _run_ticks(run, controller, clock)


class _PolicyClock:
=======
class PolicyClock:
>>>>>>> main
    """Clock of the policy's computing time: a call takes no time, or exceeds its limit."""

    late, now = False, 0.0

    def __call__(self):
        self.now += 1.0 if self.late else 0.0
        return self.now


def replay(run, policy):
    """Return the number of equal ticks, and the names of what differs first; empty for nothing."""
    conditions, reply = run.conditions, run.tables["reply"]
    carried = {each.digest: each for each in policy.actuators}
    actuator, *others = (
        carried[digest] for digest in (conditions.actuator, *conditions.alternatives)
    )
    if isinstance(policy, BoundPolicy):
        policy = replace(policy, settings=conditions.settings)
    request = RunRequest(
        policy,
        actuator,
        RigSettings.model_validate(conditions.rig),
        conditions.world,
        conditions.encoder,
        conditions.duration,
        alternatives=tuple(others),
        identify=identify_actuator if conditions.identifies else None,
    )
    limit = None if run.end is None else run.end.max_speed
    clock, rest = PolicyClock(), (conditions.counts_per_rev, inf if limit is None else limit)
    controller = RunController(
        request.parts(tick_policy(policy), clock, *rest),
        request.response(actuator, *rest),
        reply[np.isnan(reply["sent"])]["q"][0].tolist(),
    )
    return compared(run, controller, clock)


def compared(run, controller, clock):
    """Give a controller the inputs of each tick, and compare its outputs with the log."""
    tick, stream, encoder, reply = (
        run.tables[name] for name in ("tick", "stream", "encoder", "reply")
    )
    reply = reply[np.isfinite(reply["sent"])]
    result = job = None
    ends = [*np.searchsorted(stream["time"], tick["time"][1:]).tolist(), len(stream)]
    unsent = 0
    for number, (row, end) in enumerate(zip(tick, ends, strict=True)):
        now = float(row["time"])
        events = [event for event in run.events if event.time == now]
        names = {event.name for event in events}
        ended = run.end if "stopping" in names else None
        # The tick of a verdict, or of a selected actuator, receives the result of its job.
        if job is not None and (JOBS & names or (ended and ended.outcome in JOBS_FAILED)):
            try:
                result, job = job(), None
            except Exception as error:  # the run controller stops on it
                result, job = error, None
        samples = during(encoder, "received", now)[list(Sample._fields)].tolist()
        replies = during(reply, "taken", now)[["sent", "time", "q", "torque"]].tolist()
        inputs = TickInputs(
            samples=[Sample(t, n, bool(p), bool(i), missing) for t, n, p, i, missing in samples],
            replies=[Reply(sent, t, known(q), known(torque)) for sent, t, q, torque in replies],
            lines=[event.text for event in events if event.name == WORD_TYPED],
            faults=[
                End(Outcome.ENCODER_LOST, {"text": event.text})
                for event in events
                if event.name == FAILED
            ],
            lateness=float(row["late"]),
            result=result,
            unsent=unsent,
        )
        result = None
        clock.late = ended is not None and "took" in ended.evidence
        output = controller.tick(now, inputs)
        job = output.job or job
        first = int(np.searchsorted(stream["time"], now))
        sent = stream["q"][first:end][: len(output.setpoints)]
        unsent = len(output.setpoints) - len(sent)
        made = output.record._asdict() | {"state": output.state, "q": output.q, "dq": output.dq}
        pairs = {
            name: (row[name], made[name]) for name in (*TickRecord._fields, "state", "q", "dq")
        }
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
