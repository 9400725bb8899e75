"""Verdict on the end of a fault's run, from the bytes sent and from the motion of the twin.

`check_run` holds for every run, whatever fails in it; `judge` adds the required end of one fault.

Of the run itself only the cause that it names is used: setpoints are read from the bytes on the
link, limits come from the arm, and rest is judged by the twin's joints.
"""

from bisect import bisect_left
from itertools import pairwise
from math import inf, isfinite
from typing import NamedTuple

import numpy as np

from equipoise import EquipoiseError, RunLog, paper
from equipoise.outcomes import Outcome
from equipoise.rig.series import LEADS_ON, run_path
from equipoise.safety.rules import POSITION_MARGIN, STOP_DECELERATION
from tests.faults.harness import ArmObservation, FaultHarness, ReceivedMessage, Scenario

MAX_NOTICE = 0.100
"""Maximum time from the fault to the warning that software cannot stop the robot [s]."""
REST_TOLERANCE = 0.01
"""Maximum motion of a joint of an arm at rest, within 0.3 s [rad]. A pendulum that swings out moves
the twin's arm by half of this."""
ROUNDING = 1e-6
"""Tolerance of setpoints, for their rounding on the link [rad]."""
MAX_HOLD_STEP = 5e-5
"""Maximum step of a setpoint that holds the arm [rad]: 0.01 rad/s."""
REST_DISTANCE = 2e-4
"""Distance that a ramp still covers once its steps are those of a held arm [rad]."""
CONTINUING = {
    "homing", "home", "hang", "reference", "damping", "swing", "swing-up", "lift", "armed",
    "balancing",
}  # fmt: skip
"""Names of messages that must not follow a stop."""
PERIOD = paper.STEP / 2.0
"""Time between two setpoints [s]."""


class Sent(NamedTuple):
    """Setpoint on the link."""

    time: float  # [s]
    q: tuple[float, ...]  # joints [rad]


class Part(NamedTuple):
    """What one run of a series has sent, said and moved."""

    messages: list[ReceivedMessage]
    sent: list[Sent]
    observations: list[ArmObservation]


def parts_of(harness):
    """Return the parts of a series, which begin with each way home."""
    begins = [m.time for m in harness.messages if m.name == "homing"][1:]
    rows = harness.messages, setpoints_of(harness.robot_tap.sent), harness.observations
    return [
        Part(*([row for row in kind if begin <= row.time < end] for kind in rows))
        for begin, end in pairwise((-inf, *begins, inf))
    ]


def setpoints_of(lines):
    """Return the setpoints in the sent lines, given with their times."""
    sent = []
    for time, line in lines:
        command, *fields = line.decode().strip().rstrip("_").split("_")
        if command.startswith("jp"):
            sent.append(Sent(time, tuple(map(float, fields))))
    return sent


def check_limits(arm, sent):
    """Return the problems of setpoints: number, finiteness, position, step."""
    problems, before = [], None
    for time, q in sent:
        if len(q) != len(arm.joints) or not all(map(isfinite, q)):
            problems.append(f"at {time:.3f} s {q} was sent")
            continue
        for i, joint in enumerate(arm.joints):
            margin = POSITION_MARGIN - ROUNDING
            if not joint.lower + margin <= q[i] <= joint.upper - margin:
                problems.append(f"at {time:.3f} s {joint.name} was sent to {q[i]:.4f} rad")
            most = joint.velocity * PERIOD * (1.0 + ROUNDING) + 1e-9
            if before is not None and abs(q[i] - before[i]) > most:
                problems.append(f"at {time:.3f} s {joint.name} was sent {q[i] - before[i]:.4f} rad")
        before = q
    return problems[:3]


def check_stop(arm, sent, stop):
    """Return the problems of the setpoints after a stop [s].

    Each is slower than the one before, down to rest; after that none leaves the reach of the ramp.
    """
    q = np.array([setpoint.q for setpoint in sent])
    steps = np.abs(np.diff(q, axis=0)).max(axis=1)
    times = np.array([setpoint.time for setpoint in sent[1:]])
    after = np.flatnonzero(times >= stop - 1e-9)
    if not len(after):
        rests = len(steps) == 0 or steps[-1] <= MAX_HOLD_STEP
        return [] if rests else ["no setpoint was sent after the stop"]
    problems, first = [], int(after[0])
    if times[first] > stop + paper.STEP + 1e-9:
        problems.append(f"the first setpoint of the stop came {times[first] - stop:.3f} s after it")
    before = steps[first - 1] if first else 0.0
    # On the way back to the measured posture a tenth of the joints' velocities is allowed.
    slow = (0.1 + ROUNDING) * PERIOD * np.array([joint.velocity for joint in arm.joints])
    reach = ramp_reach(arm, q[first], q[max(first - 1, 0)])
    resting = False
    for k in after:
        if resting:
            if np.any(np.abs(q[k + 1] - q[k]) > slow):
                problems.append(f"at {times[k]:.3f} s the resting arm was sent away, too fast")
                break
            if np.any(np.abs(q[k + 1] - q[first]) > reach):
                problems.append(f"at {times[k]:.3f} s a setpoint left the reach of the ramp")
                break
        elif steps[k] > max(before - ROUNDING, MAX_HOLD_STEP):
            problems.append(f"at {times[k]:.3f} s a setpoint was no slower than the one before")
            break
        if not resting and steps[k] <= MAX_HOLD_STEP:
            resting, reach = True, np.maximum(reach, np.abs(q[k + 1] - q[first]) + REST_DISTANCE)
        before = steps[k]
    if steps[-1] > MAX_HOLD_STEP:
        problems.append("the last setpoint still moves the arm")
    # 4 m/s^2 bring the fastest flange to rest in v / 4.
    duration = times[int(after[np.argmax(steps[after] <= MAX_HOLD_STEP)])] - stop
    if duration > paper.X_LIMIT * 10.0 / STOP_DECELERATION:
        problems.append(f"the stop took {duration:.2f} s")
    return problems


def ramp_reach(arm, q, before):
    """Return the distance that a ramp to rest covers in each joint [rad], shape (joints,).

    `q` is the last setpoint before the stop [rad], `before` the one before that.
    """
    dq = (q - before) / PERIOD
    twist = arm.kinematics(arm.without_held(q.tolist()), arm.without_held(dq.tolist())).twist
    # The flange takes v / 4 m/s^2, a joint its speed over its acceleration; the slowest decides.
    lasts = float(np.linalg.norm(twist[:3])) / STOP_DECELERATION
    for joint, speed in zip(arm.joints, np.abs(dq).tolist(), strict=True):
        lasts = max(lasts, speed / joint.acceleration)
    return 0.5 * lasts * np.abs(dq) + REST_DISTANCE


def check_run(harness, outcome):
    """Return the problems that no run or series may have, whatever fails in it."""
    *before, last = parts_of(harness)
    problems = _on_track(harness) + _log_problems(harness, outcome)
    for part, end in zip(before, harness.ends, strict=False):
        if end.outcome not in LEADS_ON:
            problems.append(f"a run followed {end.outcome}")
        problems += _check_part(harness, part, end)
    if outcome.outcome is Outcome.ERROR and len(harness.ends) > len(before):
        return problems + _at_rest(last)  # between two runs
    return problems + _check_part(harness, last, outcome)


def _check_part(harness, part, outcome):
    arm = harness.scenario.settings.described_arm
    messages, sent, _ = part
    problems = check_limits(arm, sent)
    if outcome.outcome is Outcome.ERROR:
        moved = [f"{len(sent)} setpoints were sent"] if sent else []
        return [*problems, *moved, *_at_rest(part)]
    stop = stop_time(part)
    if stop == inf:
        return [*problems, "the operator received no message of the stop"]
    if outcome.stoppable:
        problems += check_stop(arm, sent, stop) if sent else []
    elif not any(map(_warns, messages)):
        problems.append("no message says that software cannot stop the robot")
    if any(m.name in CONTINUING for m in messages if m.time > stop + 1e-9):
        problems.append("the run went on after its stop")
    ended = [time for time, line in harness.robot_tap.sent if line.startswith(b"stopDirectServo")]
    ended = [time for time in ended if time > stop]
    if ended and sent and sent[-1].time > ended[0]:
        problems.append("a setpoint was sent after the servo had ended")
    return problems + _moved_on(arm, part, stop) + _at_rest(part)


def stop_time(part):
    """Return the time of the first message of a run's end [s]; inf without one."""
    ends = ("stopping", "fault", "error")
    return next((m.time for m in part.messages if m.name in ends and m.text), inf)


def problems_of(fault, scenario=None):
    """Run a fault in a scenario; return the differences of its end from the required one."""
    scenario, injection = fault.scenario(scenario or Scenario()), (fault.trigger, fault.inject)
    harness = FaultHarness(scenario, injection, words_after_stop=fault.words_after_stop)
    outcome = harness.run()
    return [*judge(harness, outcome, fault), *fault.check(harness)]


def judge(harness, outcome, fault):
    """Return the differences between the end of a run and that which its fault requires."""
    messages, problems = harness.messages, check_run(harness, outcome)
    if outcome.outcome not in fault.ends:
        problems.append(f"it ended with {outcome.outcome} ({outcome.reason})")
    if harness.injected_at is None:
        return [*problems, "the run ended before the fault was injected"]
    if fault.says and not any(fault.says in message.text for message in messages):
        problems.append(f"no message contains {fault.says!r}")
    if outcome.outcome is Outcome.ERROR:
        return problems
    if harness.held_at_start and not fault.held_at_start:
        problems.append("the policy began while the hand held the pendulum")
    stop = stop_time(parts_of(harness)[-1])
    if stop - harness.injected_at > fault.within + 1e-9:
        problems.append(f"it stopped {stop - harness.injected_at:.3f} s after the fault")
    if outcome.stoppable is not fault.stoppable:
        problems.append(f"software can{'' if outcome.stoppable else 'not'} stop the robot")
    if not fault.stoppable:
        late = next((m.time for m in messages if _warns(m)), stop) - harness.injected_at
        if late > MAX_NOTICE + 1e-9:
            problems.append(f"the operator was warned after {1e3 * late:.0f} ms")
    return problems


def _warns(message):
    """Return whether a message says that software cannot stop the robot."""
    text = message.text
    return "software" in text and ("E-stop" in text or "emergency stop" in text)


def _moved_on(arm, part, stop):
    """Return the problem of a joint that moves further after a stop [s] than the ramp."""
    sent = part.sent
    k = bisect_left([setpoint.time for setpoint in sent], stop - 1e-9)
    later = [arm.q for arm in part.observations if arm.time >= stop]
    if k < 2 or not later:
        return []
    before, last = sent[k - 2].q, sent[k - 1].q
    q, speed = np.array(last), np.abs(np.subtract(last, before)) / PERIOD
    # The arm may lag by 60 ms; a push or the pendulum moves a joint by 0.02 rad behind its servo.
    most = ramp_reach(arm, q, np.array(before)) + 0.06 * speed + 0.02
    moved = np.abs(np.array(later) - later[0]).max(axis=0)
    i = int(np.argmax(moved - most))
    far = f"{arm.joints[i].name} moved by {moved[i]:.3f} rad after the stop, its ramp {most[i]:.3f}"
    return [far] if moved[i] > most[i] else []


def _log_problems(harness, outcome):
    if harness.scenario.out is None or harness.disk_is_full:
        return []
    problems, runs = [], harness.scenario.runs
    # Where a link has failed between two runs, the next one has no log.
    logs = len(harness.ends) + (outcome.outcome is not Outcome.ERROR)
    for number in range(1, logs + 1):
        try:
            end = RunLog.load(run_path(harness.scenario.out, number, runs)).end
        except EquipoiseError as error:
            problems.append(f"the log cannot be read: {error}")
        else:
            problems += [] if end else ["the log has no end"]
    return problems


def _on_track(harness):
    home = next((m.time for m in harness.messages if m.name == "home"), inf)
    x = max((abs(arm.x) for arm in harness.observations if arm.time >= home), default=0.0)
    return [f"the flange was {x:.4f} m from home"] if x >= paper.X_LIMIT else []


def _at_rest(part):
    end = part.observations[-1].time
    return check_still([arm.q for arm in part.observations if arm.time > end - 0.3])


def check_still(postures):
    """Return the problem of an arm that moves, from its postures [rad] at the end of a run."""
    moved = float(np.ptp(np.array(postures), axis=0).max())
    return [f"at the end a joint moves by {moved:.3f} rad"] if moved > REST_TOLERANCE else []
