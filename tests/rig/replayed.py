"""Test of determinism: the measurements of a log go through the controller again.

The outputs are compared with those of the log.

The log of a run on a rig holds all inputs of a tick: counts, replies, typed lines, failures,
lateness. A new `RunController` receives the same inputs at the same times, from the first setpoint
to rest. The log of a run on a twin begins at the release; there only the control step runs again,
on the counts and joints of its ticks. On the machine that made the log every bit is the same.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from math import inf, isnan, pi
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.control.bound_policy import BoundPolicy
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
from equipoise.outcomes import End, Outcome
from equipoise.rig.config import RigSettings
from equipoise.rig.interfaces import Reply, Sample
from equipoise.rig.request import RunRequest
from equipoise.rig.run_controller import RunController

Array = npt.NDArray[np.float64]

JOBS: Final = {"self-test", "actuator", "identified"}
"""Names of events in ticks that receive the result of a job."""
JOBS_FAILED: Final = {Outcome.SELF_TEST, Outcome.UNIDENTIFIED}
"""Ends by a job that failed."""


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
    """Clock of the policy's computing time: a call takes no time, or exceeds its limit."""

    def __init__(self) -> None:
        self.late = False
        self._now = 0.0

    def __call__(self) -> float:
        """Return the time [s]."""
        self._now += 1.0 if self.late else 0.0
        return self._now


def _run_ticks(run: RunLog, controller: RunController, clock: _PolicyClock) -> Rows:
    """Yield the logged and the replayed values of each tick."""
    tables = run.tables
    tick, stream, encoder, reply = (tables[n] for n in ("tick", "stream", "encoder", "reply"))
    reply = reply[np.isfinite(reply["sent"])]
    result: Any = None
    working = None
    ends = [*np.searchsorted(stream["time"], tick["time"][1:]).tolist(), len(stream)]
    unsent = 0
    for row, end in zip(tick, ends, strict=True):
        now = float(row["time"])
        events = [event for event in run.events if event.time == now]
        names = {event.name for event in events}
        ended = run.end if "stopping" in names else None
        # The tick of a verdict, or of a selected actuator, receives the result of its job.
        judged = JOBS & names or (ended is not None and ended.outcome in JOBS_FAILED)
        if working is not None and judged:
            try:
                result = working()
            except Exception as error:  # the run controller stops on it
                result = error
            working = None
        samples = _at(encoder, "received", now)[list(Sample._fields)].tolist()
        replies = _at(reply, "taken", now)[["sent", "time", "q", "torque"]].tolist()
        inputs = TickInputs(
            samples=[Sample(t, n, bool(p), bool(i), missing) for t, n, p, i, missing in samples],
            replies=[Reply(sent, t, _known(q), _known(torque)) for sent, t, q, torque in replies],
            lines=[event.text for event in events if event.name == WORD_TYPED],
            faults=[
                End(Outcome.ENCODER_LOST, {"text": event.text})
                for event in events
                if event.name == DEVICE_FAILED
            ],
            lateness=float(row["late"]),
            result=result,
            unsent=unsent,
        )
        result = None
        clock.late = ended is not None and "took" in ended.evidence
        output = controller.tick(now, inputs)
        working = output.job or working
        first = int(np.searchsorted(stream["time"], now))
        sent = stream["q"][first:end][: len(output.setpoints)].tolist()
        unsent = len(output.setpoints) - len(sent)
        yield now, _pairs(row, sent, output)


def _at(table: npt.NDArray[Any], column: str, time: float) -> npt.NDArray[Any]:
    first, last = (int(np.searchsorted(table[column], time, side)) for side in ("left", "right"))
    return table[first:last]


def _known(values: Array) -> tuple[float, ...] | None:
    return None if np.isnan(values).any() else tuple(values.tolist())


def _of_joints(name: str, logged: Iterable[float], made: Iterable[float]) -> Pairs:
    both = zip(logged, made, strict=True)
    return {f"{name} of joint {i}": pair for i, pair in enumerate(both, start=1)}


def _of_setpoints(logged: Iterable[Sequence[float]], made: Iterable[Sequence[float]]) -> Pairs:
    pairs: dict[str, tuple[float, float]] = {}
    for name, *setpoints in zip(("first", "second"), logged, made, strict=False):
        pairs |= _of_joints(f"{name} setpoint", *setpoints)
    return pairs


def _pairs(row: Any, sent: list[list[float]], output: TickOutput) -> Pairs:
    pairs = {"state": (float(row["state"]), float(output.state))}
    pairs |= {
        name: (float(row[name]), float(getattr(output.record, name))) for name in TickRecord._fields
    }
    for name in ("q", "dq"):
        pairs |= _of_joints(name, row[name].tolist(), getattr(output, name))
    return pairs | _of_setpoints(sent, output.setpoints)


# A run on a twin, from the release.


def _of_twin(run: RunLog, policy: TaskPolicy, carried: Sequence[Actuator]) -> Rows:
    conditions = run.conditions
    per_rev = conditions.counts_per_rev
    actuator = _with_digest(carried, conditions.actuator)
    params = make_controller_params(
        policy.arm,
        conditions.settings,
        actuator,
        policy.pendulum.parameters(linearised=conditions.settings.plant.linearised),
        h=conditions.h,
        counts_per_rev=per_rev,
    )
    controller = Controller(policy.arm, params, policy.settings.boxes)
    return _control_steps(run, policy, controller, params.resolution)


def _control_steps(
    run: RunLog, policy: TaskPolicy, controller: Controller, resolution: float
) -> Rows:
    """Yield the logged and the replayed values of each tick's control step."""
    phi_dot = run.conditions.start[3]
    stamp, counts = run.encoder.time, run.encoder.counts
    controller.begin(pi - counts[0] * resolution - stamp[0] * phi_dot, phi_dot)
    acting = tick_policy(policy)
    acting.reset()
    for i, time in enumerate(run.time.tolist()):
        if i > 0:
            age, reply_age = time - float(stamp[i]), time - float(run.replies.time[i])
            controller.observe(float(counts[i]), age, run.replies.q[i].tolist(), reply_age)
        u, box = controller.decide(acting), controller.box
        observation, estimate = controller.observation, controller.estimate
        setpoints = controller.command(u)
        made = (*observation, float(box), u, estimate.phi, estimate.phi_dot, estimate.bias)
        logged = (float(run.ticks[name][i]) for name in TickRecord._fields)
        pairs = dict(zip(TickRecord._fields, zip(logged, made, strict=True), strict=True))
        first = len(setpoints) * i
        sent = run.stream.q[first : first + len(setpoints)].tolist()
        yield time, pairs | _of_setpoints(sent, setpoints)
