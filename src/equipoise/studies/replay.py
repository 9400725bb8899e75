"""Replay: the measurements of a log go through the controller again, and the same has to come out.

Of a run on a rig all that a tick was told is in its log: counts, replies, words, failures, how late
it was. A fresh `RunController` is told the same at the same times, from the first setpoint to rest.
A log of a run on a twin begins at the release; there the control step alone runs again, on the
counts and joints of its ticks.

On the machine that made the log every bit is the same. Another processor or library rounds
otherwise, and the tolerance says how much of that is allowed: the controller holds a pendulum that
falls, so a difference grows e-fold each 0.12 s until feedback ends it.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from math import isnan, pi
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from equipoise.artefacts import first_fault
from equipoise.control.bound_policy import BoundPolicy
from equipoise.control.control_step import make_controller_params
from equipoise.control.controller import Controller
from equipoise.control.policy import TaskPolicy, tick_policy
from equipoise.control.run_controller import FAILED, LATE, RunController
from equipoise.control.ticks import TickInputs, TickOutput
from equipoise.deployment.rig import RunRequest, logged_speed_limit
from equipoise.devices.interfaces import Reply, Sample
from equipoise.errors import ArtefactError
from equipoise.logs.conditions import IDEAL
from equipoise.logs.recorder import FAILED as DEVICE_FAILED
from equipoise.logs.recorder import WORD_TYPED
from equipoise.logs.run_log import RunLog
from equipoise.model.actuator import Actuator
from equipoise.rigs import RigSettings

Array = npt.NDArray[np.float64]

SELF_TEST: Final = "self-test"
"""Name of the event with a verdict of the self-test, and what a refusal's reason begins with."""
SEEN: Final = (
    "x",
    "x_dot",
    "phi",
    "phi_dot",
    "box",
    "u",
    "estimated_phi",
    "estimated_phi_dot",
    "bias",
)
"""What a tick of a run on a rig says beside state and joints."""


class Difference(NamedTuple):
    """The first place where a replay is not what the log says."""

    tick: int
    """Number of the tick, from zero at the log's first."""
    time: float
    """Its time in the log [s]."""
    what: str
    """The column, e.g. `u`, `state` or `first setpoint`."""
    logged: float
    """What the log says."""
    replayed: float
    """What came out."""


class Replayed(NamedTuple):
    """What came of a replay."""

    ticks: int
    """How many ticks were compared."""
    whole: bool
    """Whether these are all ticks of the run; a log that breaks off has fewer."""
    largest: float
    """Largest difference of any number until the first that is too large [SI]."""
    difference: Difference | None
    """The first that is larger than the tolerance, if any is."""


def replay(
    run: RunLog,
    policy: TaskPolicy,
    actuator: Actuator | None = None,
    *,
    tolerance: float = 0.0,
) -> Replayed:
    """Feed the measurements of a log through the controller again, and compare.

    Args:
        run: The log.
        policy: The policy that ran.
        actuator: What its controller knew of the arm; that of the policy if not given.
        tolerance: Numbers may differ by so much [SI]; none where every bit has to be the same.

    Returns:
        Whether the same came out, and where first it did not.

    Raises:
        ArtefactError: The run was of another policy or actuator; or its log does not hold what the
            controller was told, as that of a run on the ideal model.
    """
    actuator = policy.actuator if actuator is None else actuator
    rows = (_of_twin if run.conditions.simulated else _of_rig)(run, policy, actuator)
    ticks, largest = 0, 0.0
    for time, pairs in rows:
        for what, (logged, replayed) in pairs.items():
            away = _apart(logged, replayed)
            if away > tolerance:
                return Replayed(
                    ticks, not run.damage, largest, Difference(ticks, time, what, logged, replayed)
                )
            largest = max(largest, away)
        ticks += 1
    return Replayed(ticks, not run.damage, largest, None)


def _apart(a: float, b: float) -> float:
    if a == b or (isnan(a) and isnan(b)):
        return 0.0
    away = abs(a - b)
    return np.inf if isnan(away) else away


def _check(digest: str, expected: str, what: str) -> None:
    if digest != expected:
        raise ArtefactError(
            f"the run was with the {what} {expected[:19]}..., given is {digest[:19]}...; "
            f"give the {what} that ran"
        )


Pairs = Mapping[str, tuple[float, float]]
Rows = Iterator[tuple[float, Pairs]]
"""Time of each tick, and by name what the log says and what came out."""


# A run on a rig.


def _of_rig(run: RunLog, policy: TaskPolicy, actuator: Actuator) -> Rows:
    told, tables = run.conditions, run.tables
    _check(policy.digest, told.policy, "policy")
    _check(policy.pendulum.digest, told.pendulum_digest, "pendulum")
    _check(actuator.digest, told.actuator, "actuator")
    if isinstance(policy, BoundPolicy):
        policy = replace(policy, settings=told.settings)
    request = RunRequest(
        policy=policy,
        actuator=actuator,
        settings=_rig_settings(run),
        robot=told.world,
        encoder=told.encoder,
        duration=told.duration,
        t1=told.t1,
        dry_run=False,
        seed=told.seed,
    )
    counts_per_rev = request.settings.counts_per_rev
    tick, reply = tables["tick"], tables["reply"]
    began = reply[np.isnan(reply["sent"])]
    if len(tick) == 0 or len(began) == 0:
        raise ArtefactError("nothing moved in this run; there is nothing to replay")
    clock = _PolicyClock()
    pilot = RunController(
        request.settings.described_arm,
        request.controller(counts_per_rev),
        tick_policy(policy),
        request.guard(counts_per_rev, logged_speed_limit((e.name, e.text) for e in run.events)),
        began["q"][0].tolist(),
        duration=request.duration,
        clock=clock,
    )
    return _through(run, pilot, clock)


class _PolicyClock:
    """The clock of the policy's computing time: each call takes none, or far too long."""

    def __init__(self) -> None:
        self.late = False
        self._now = 0.0

    def __call__(self) -> float:
        """Return the time [s]."""
        self._now += 1.0 if self.late else 0.0
        return self._now


def _rig_settings(run: RunLog) -> RigSettings:
    try:
        settings = RigSettings.model_validate(run.conditions.rig)
        return settings.with_arm(run.conditions.arm)
    except ValidationError as error:
        raise ArtefactError(
            f"the log has invalid settings of the rig: {first_fault(error).what}; run it again"
        ) from None


def _through(run: RunLog, pilot: RunController, clock: _PolicyClock) -> Rows:
    """Yield the logged and the replayed values of each tick."""
    tables = run.tables
    tick, stream, encoder, reply = (tables[n] for n in ("tick", "stream", "encoder", "reply"))
    reply = reply[np.isfinite(reply["sent"])]
    result: Any = None
    working = None
    for row in tick:
        now = float(row["time"])
        told = {event.name: event.text for event in run.events if event.time == now}
        if working is not None and _judged(told):
            try:
                result = working()
            except Exception as error:  # as the loop does: the pilot stops on it
                result = error
            working = None
        inputs = TickInputs(
            samples=[
                Sample(
                    float(s["time"]),
                    int(s["counts"]),
                    bool(s["pressed"]),
                    bool(s["illegal"]),
                    int(s["missing"]),
                )
                for s in _at(encoder, "received", now)
            ],
            replies=[
                Reply(float(r["sent"]), float(r["time"]), _known(r["q"]), _known(r["torque"]))
                for r in _at(reply, "taken", now)
            ],
            words=[e.text for e in run.events if e.time == now and e.name == WORD_TYPED],
            faults=[e.text for e in run.events if e.time == now and e.name == DEVICE_FAILED],
            lateness=float(row["late"]),
            result=result,
        )
        result = None
        clock.late = told.get("stopping", "").startswith(f"{FAILED}: {LATE}")
        output = pilot.tick(now, inputs)
        working = output.job or working
        first = int(np.searchsorted(stream["time"], now))
        sent = stream["q"][first : first + len(output.setpoints)].tolist()
        yield now, _pairs(row, sent, output)


def _judged(told: Mapping[str, str]) -> bool:
    """Return whether events of a tick say that it was told a verdict of the self-test."""
    return SELF_TEST in told or told.get("stopping", "").startswith("the self-test failed")


def _at(table: npt.NDArray[Any], column: str, time: float) -> npt.NDArray[Any]:
    first, last = (int(np.searchsorted(table[column], time, side)) for side in ("left", "right"))
    return table[first:last]


def _known(values: Array) -> tuple[float, ...] | None:
    return None if np.isnan(values).any() else tuple(values.tolist())


def _pairs(row: Any, sent: list[list[float]], output: TickOutput) -> dict[str, tuple[float, float]]:
    pairs = {"state": (float(row["state"]), float(output.state))}
    pairs |= {name: (float(row[name]), float(getattr(output.record, name))) for name in SEEN}
    joints = [("q", row["q"].tolist(), output.q), ("dq", row["dq"].tolist(), output.dq)]
    for name, setpoint, made in zip(("first", "second"), sent, output.setpoints, strict=False):
        joints.append((f"{name} setpoint", setpoint, made))
    for name, logged, made in joints:
        both = zip(logged, made, strict=True)
        pairs |= {f"{name} of joint {i}": pair for i, pair in enumerate(both, start=1)}
    return pairs


# A run on a twin, from the release.


def _of_twin(run: RunLog, policy: TaskPolicy, actuator: Actuator) -> Rows:
    told = run.conditions
    ticks = len(run.time)
    rows = len(run.encoder.time)
    if not ticks or told.counts_per_rev is None or (rows < ticks if run.damage else rows != ticks):
        raise ArtefactError(
            f"the log of a run in the world {told.world} does not hold what its controller was "
            "told, since there it knows the state; replay a run on a twin or a rig"
        )
    _check(policy.digest, told.policy, "policy")
    _check(IDEAL if actuator.kind == "ideal" else actuator.digest, told.actuator, "actuator")
    controller = make_controller_params(
        policy.arm,
        told.settings,
        actuator,
        policy.pendulum.parameters(linearised=told.settings.plant.linearised),
        h=told.h,
        counts_per_rev=told.counts_per_rev,
    )
    return _control_steps(run, policy, Controller(policy.arm, controller), controller.resolution)


def _control_steps(run: RunLog, policy: TaskPolicy, lane: Controller, resolution: float) -> Rows:
    """Yield what the log says of each tick and what the control step makes of its measurements."""
    phi_dot = run.start[3]
    stamp, counts = run.encoder
    lane.begin(pi - counts[0] * resolution - stamp[0] * phi_dot, phi_dot)
    acting = tick_policy(policy)
    acting.reset()
    for i, time in enumerate(run.time.tolist()):
        if i > 0:
            lane.observe(
                float(counts[i]),
                time - float(stamp[i]),
                run.replies.q[i].tolist(),
                time - float(run.replies.time[i]),
            )
        u, box = lane.decide(acting), lane.box
        seen, estimate = lane.observation, lane.estimate
        setpoints = lane.command(u)
        made = (*seen, float(box), u, estimate.phi, estimate.phi_dot, estimate.bias)
        pairs = {
            name: (float(getattr(run, name)[i]), value)
            for name, value in zip(SEEN, made, strict=True)
        }
        both = (*zip(("first", "second"), setpoints, strict=True),)
        for place, (name, q) in enumerate(both):
            logged = run.stream.q[len(setpoints) * i + place].tolist()
            for joint, pair in enumerate(zip(logged, q, strict=True), start=1):
                pairs[f"{name} setpoint of joint {joint}"] = pair
        yield time, pairs
