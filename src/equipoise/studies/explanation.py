r"""Explain: why did a run end? Ranked causes with their evidence, from its log alone.

Several things are looked for, each with a measure of its own.

**The recoverable set.** Near upright the falling part of the motion is :math:`\varphi +
\dot\varphi / \sqrt{w_2}`, which grows with :math:`e^{\sqrt{w_2} t}`. The largest acceleration
:math:`u_{max}` turns it back where it is below :math:`k u_{max} / w_2`, and nothing does beyond. It
is taken of the state that the policy saw, which is that at which its command takes effect.

**The unexplained rate.** What encoder and joints measured is held against the pendulum's equation:

.. math:: M(t) = \int d\dot\varphi + k \cos\varphi\, d\dot x - (w_2 \sin\varphi - c \dot\varphi)\,dt

It stays where it is while all is well. A push is a step of it. An encoder that reads too much by b,
or a base that leans, is a slope of :math:`-w_2 b`.

**The encoder.** Counts that stand still while the pivot is accelerated, and counts that jump.

**The cause in the log.** A rule that names what happened (a late tick, a contact) is believed. One
that names how it ended (the angle, the track) is the last in the list: something led there.
"""

from collections.abc import Callable
from enum import Enum
from math import cos, degrees, sqrt
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.control.run_controller import POLICY
from equipoise.control.safety import (
    MAX_COUNT_JUMP,
    MAX_TICK_LATENESS,
    TORQUE_SHARE,
    Rule,
    unexplained,
)
from equipoise.control.states import Phase
from equipoise.errors import ArtefactError, RecordingError
from equipoise.logs.run_log import BROKEN_OFF, RunLog
from equipoise.model.pendulum import PendulumParameters
from equipoise.studies.refinement import read_motion
from equipoise.studies.runs import LoggedEnding, ending, pendulum_of

Array = npt.NDArray[np.float64]

GRID: Final = 0.005
"""The unexplained rate is looked at so often [s]."""
WINDOW: Final = 0.015
"""Half of the time over which a rate is fitted [s]; three samples where they are rarer."""
STEP_TIME: Final = 0.08
"""A push is a step of the unexplained rate within this [s]."""
AROUND: Final = 0.5
"""... against what is usual within this before and after [s]."""
PUSH: Final = 0.35
"""A step of the unexplained rate from which on it is a push [rad/s]: 20 deg/s. Noise and a
misjudged pendulum make 3 deg/s."""
BEFORE_THE_END: Final = 2.5
"""What led to the end happened within this before it [s]."""
ZERO_TIME: Final = 0.8
"""The encoder's zero is judged from so much of the run [s]."""
SHORTEST: Final = 0.12
"""... or so much of it, if it was no longer [s]."""
ZERO: Final = np.deg2rad(0.75)
"""Beyond this the zero is wrong, and more so than the observer knows [rad]: a referenced zero is
good to 0.1 deg, a base is level to 0.5 deg."""
CLEARLY: Final = np.deg2rad(2.5)
"""A zero so wrong ends a run by itself [rad]."""
STRONG: Final = 1.2
"""A push so strong does [rad/s]."""
FROZEN: Final = 0.06
"""Counts that stand still for so long are looked at [s]."""
FROZEN_RATE: Final = 0.2
"""... and are frozen where the pivot should have changed the pendulum's rate by this [rad/s]."""
TOUCHED: Final = 0.3
"""An external torque beyond this share of what the guard allows is a contact; balancing makes 0.04
on the twin."""
AFTER: Final = 0.1
"""Torques are asked for each 50 ms: what stopped a run may be measured so long after [s]."""
AT_RELEASE: Final = 0.05
"""What is outside so soon was so from the beginning [s]."""


class CauseName(Enum):
    """Why a run ended."""

    LASTED = "lasted"
    """It stood as long as it should."""
    OPERATOR = "operator"
    """Somebody stopped it."""
    OUTSIDE = "outside the recoverable set"
    """The pendulum was let go so far out that no command could hold it."""
    PUSH = "push"
    """Something struck the pendulum."""
    ZERO = "zero error"
    """The encoder's zero is wrong, or became so, or the base leans."""
    STALE = "stale encoder"
    """Counts stood still or did not come."""
    JUMP = "jumping encoder"
    """Counts moved as no pendulum does, or were lost."""
    POLICY = "policy"
    """The policy raised, took too long, or returned no finite number."""
    LATE = "late tick"
    """The loop did not keep its time."""
    SATURATION = "saturation"
    """The largest command was not enough."""
    JOINT = "joint limit"
    """The arm was asked for more than a joint can do."""
    TRACK = "track"
    """The flange came to the end of its track, the pendulum still being held."""
    ANGLE = "angle"
    """The pendulum fell, and nothing says why."""
    CONTACT = "contact"
    """Something touched the arm."""
    NOT_FOLLOWING = "robot not following"
    """The arm did not do what it was told."""
    LINK = "link"
    """The robot did not answer."""
    POSTURE = "flange astray"
    """The flange left its line or orientation."""
    SPEED = "flange speed"
    """The flange was faster than it may be: in T1, or over a slow link."""
    SELF_TEST = "self-test"
    """The pendulum did not answer as the model says, before it was lifted."""
    FAULT = "fault"
    """Something failed, in the words of the log."""
    BUG = "mistake in the program"
    """The program asked for something that makes no sense."""
    EXCITED = "excitation"
    """The arm was moved about home; no policy ran."""
    BROKEN_OFF = "log broken off"
    """The log ends before the run did."""
    UNKNOWN = "unknown"
    """The log names a cause that this version does not know."""


ADVICE: Final = {
    CauseName.LASTED: "nothing has to be done",
    CauseName.OPERATOR: "nothing has to be done",
    CauseName.OUTSIDE: "let go more gently and more upright, and take the hand straight away",
    CauseName.PUSH: "keep hands, cables and draughts away from the pendulum",
    CauseName.ZERO: (
        "look at the encoder's coupling and wires, level the base, and reference again with the "
        "pendulum at rest"
    ),
    CauseName.STALE: "look at the encoder's cable, power and coupling",
    CauseName.JUMP: "look at the encoder's coupling, its wiring and what disturbs it",
    CauseName.POLICY: (
        "correct the policy as the evidence says, and try it on a virtual rig first (`equipoise "
        "deploy POLICY --robot twin:nominal`)"
    ),
    CauseName.LATE: "let `equipoise rig doctor` look for what holds this machine up",
    CauseName.SATURATION: (
        "train a policy with larger actions, or identify pendulum and actuator again (`equipoise "
        "refine`)"
    ),
    CauseName.JOINT: "move home away from the limit, or lower the gains of CLIK",
    CauseName.TRACK: "evaluate the policy on the twin (`equipoise evaluate POLICY --world "
    "twin:nominal`), and train one that stays on the track there",
    CauseName.ANGLE: "identify pendulum and actuator again (`equipoise refine`)",
    CauseName.CONTACT: "find what the arm touched before it moves again",
    CauseName.NOT_FOLLOWING: "look at the robot's panel: emergency stop, enabling switch, mode",
    CauseName.LINK: "look at cable and network; `equipoise rig doctor` measures round trips",
    CauseName.POSTURE: "look at the mounting of base and flange, and at the actuator in use",
    CauseName.SPEED: "train with --max-speed, leave T1, or make the link to the robot faster",
    CauseName.SELF_TEST: "do what the self-test says",
    CauseName.FAULT: (
        "mend what the evidence names, and look at the rig with `equipoise rig doctor` before the "
        "next run"
    ),
    CauseName.BUG: "keep this log and report it; do not run again before it is understood",
    CauseName.EXCITED: "identify the actuator from this log with `equipoise identify`",
    CauseName.BROKEN_OFF: (
        "look for what ended the program before the run: power, memory, a full disk, a signal"
    ),
    CauseName.UNKNOWN: "explain it with the version of Equipoise that wrote the log",
}
"""What to do about each."""
IN_SIMULATION: Final = {
    CauseName.OUTSIDE: (
        "start nearer to upright (`evaluation.phi_high`, `evaluation.phi_dot_high`), or train "
        "with larger actions"
    ),
    CauseName.ZERO: "train for a zero that is wrong by as much (`equipoise train --set "
    "plant.zero_error=...`), or lower `zero_offset` and `zero_error` of the world",
    CauseName.TRACK: "train for this world's actuator: `equipoise deploy --excite --world WORLD`, "
    "`equipoise identify`, `equipoise train --actuator actuator.json --seeds 5`",
    CauseName.ANGLE: "train for this world's actuator: `equipoise deploy --excite --world WORLD`, "
    "`equipoise identify`, `equipoise train --actuator actuator.json --seeds 5`",
    CauseName.NOT_FOLLOWING: (
        "identify the actuator of this world (`equipoise deploy --excite --world WORLD`, "
        "`equipoise identify`) and give it with `--actuator`"
    ),
    CauseName.POSTURE: (
        "lower the masses of bracket and pendulum in the world, or identify its actuator and give"
        " it with `--actuator`"
    ),
    CauseName.SPEED: "train with --max-speed, or leave the speed limit away (`t1` of the world, "
    "`--max-speed` of the command)",
}
"""What to do instead where the run was simulated."""

TELLING: Final = {
    "lasted": CauseName.LASTED,
    "excited": CauseName.EXCITED,
    Rule.NUMBER.value: CauseName.BUG,
    Rule.COUNT.value: CauseName.BUG,
    "operator": CauseName.OPERATOR,
    "dry run": CauseName.OPERATOR,
    "self-test": CauseName.SELF_TEST,
    "link lost": CauseName.LINK,
    Rule.LINK.value: CauseName.LINK,
    Rule.NOT_FOLLOWING.value: CauseName.NOT_FOLLOWING,
    Rule.FOLLOWING.value: CauseName.NOT_FOLLOWING,
    Rule.FIRST.value: CauseName.NOT_FOLLOWING,
    Rule.TORQUE.value: CauseName.CONTACT,
    Rule.SPEED.value: CauseName.SPEED,
    Rule.DRIFT.value: CauseName.POSTURE,
    Rule.TILT.value: CauseName.POSTURE,
    POLICY: CauseName.POLICY,
    Rule.TICK.value: CauseName.LATE,
    Rule.ENCODER_STALE.value: CauseName.STALE,
    Rule.ENCODER_ILLEGAL.value: CauseName.JUMP,
    Rule.ENCODER_GAP.value: CauseName.JUMP,
    Rule.ENCODER_JUMP.value: CauseName.JUMP,
}
"""Causes of a log that name what happened."""
ENDINGS: Final = {
    Rule.ANGLE.value: CauseName.ANGLE,
    Rule.TRACK.value: CauseName.TRACK,
    "joint limit": CauseName.JOINT,
    Rule.POSITION.value: CauseName.JOINT,
    Rule.JUMP.value: CauseName.JOINT,
    Rule.VELOCITY.value: CauseName.JOINT,
    Rule.ACCELERATION.value: CauseName.JOINT,
    Rule.SINGULAR.value: CauseName.JOINT,
    "fault": CauseName.FAULT,
    "error": CauseName.FAULT,
    BROKEN_OFF: CauseName.BROKEN_OFF,
    "unknown": CauseName.FAULT,
}
"""Causes of a log that name how it ended."""
NO_SUSPICION: Final = frozenset({CauseName.LASTED, CauseName.OPERATOR, CauseName.EXCITED})
"""Causes after which nothing is looked for."""
FAULTS: Final = {
    "jumped from": CauseName.JUMP,
    "began anew": CauseName.JUMP,
    "introduced itself": CauseName.JUMP,
    "sent no line": CauseName.STALE,
    "is gone": CauseName.STALE,
    "ever later": CauseName.STALE,
    "the setpoint of joint": CauseName.JOINT,
}
"""What failed, by words of the drivers and the guard."""


class Evidence(NamedTuple):
    """A cause that the log speaks for."""

    name: CauseName
    """Which."""
    score: float
    """How much speaks for it, from 0 to 1; the largest is why the run ended."""
    time: float
    """When, since the release [s]."""
    evidence: str
    """The numbers, in a sentence."""
    simulated: bool = False
    """Whether the run was one of `equipoise deploy --world`: no rig, no operator."""

    @property
    def advice(self) -> str:
        """What to do."""
        return (IN_SIMULATION if self.simulated else {}).get(self.name) or ADVICE[self.name]


class Explanation(NamedTuple):
    """Why a run ended."""

    causes: tuple[Evidence, ...]
    """What the log speaks for, the most likely first; never empty."""
    ending: LoggedEnding
    """What the log itself says."""
    log: RunLog | None
    """The balancing; none where the run did not get so far."""


class RunTimeline(NamedTuple):
    """What is looked at."""

    log: RunLog
    """The balancing."""
    pendulum: PendulumParameters
    """The pendulum that is believed in."""
    u_max: float
    """Largest acceleration that the policy commands [m/s^2]."""
    late: Array
    """How late each tick was [s], the one that stopped the run included; none on a twin."""
    time: Array
    """Times at which the unexplained rate is known [s], shape (m,)."""
    rate: Array
    """The unexplained rate [rad/s], shape (m,)."""
    torque_time: Array
    """When external torques were measured, a moment after the stop included [s], shape (p,)."""
    torque: Array
    """By how much each differs from what is usual [N m], shape (p, joints)."""
    torque_limit: Array
    """What the guard allows there [N m], shape (joints,)."""

    @property
    def falling(self) -> Array:
        """Phi + phi_dot / sqrt(w2) as the policy saw it [rad], shape (n,)."""
        return self.log.phi + self.log.phi_dot / sqrt(self.pendulum.w2)

    @property
    def recoverable(self) -> float:
        """How large that may be [rad]."""
        return self.pendulum.k * self.u_max / self.pendulum.w2


def explain(run: RunLog) -> Explanation:
    """Return why a run ended.

    Args:
        run: Its log.
    """
    simulated = run.conditions.simulated
    if simulated and run.end is not None:
        how = LoggedEnding(run.guard or run.cause, _reason(run), None, True)
    else:
        how = ending(run)
    log = run if simulated or _has_balancing(run) else None
    found = [_told(how, 0.0 if log is None else log.lasted)]
    if log is not None and len(log.time) > 0 and found[0].name not in NO_SUSPICION:
        course = _course(run)
        found += [finding for look in LOOKS if (finding := look(course)) is not None]
    best: dict[CauseName, Evidence] = {}
    for finding in sorted(found, key=lambda finding: -finding.score):
        best.setdefault(finding.name, finding._replace(simulated=simulated))
    return Explanation(tuple(best.values()), how, log)


def _has_balancing(run: RunLog) -> bool:
    """Tell whether a run on a rig reached the balancing, and its counts have a zero."""
    try:
        return len(run.ticks) > 0 and len(run.encoder.time) >= 0
    except ArtefactError:
        return False


def _reason(run: RunLog) -> str:
    """Return how a simulated run ended, with the numbers of its last tick."""
    if run.cause == "lasted" or len(run.time) == 0:
        return ""
    who = f"the guard {run.guard!r} ended the run" if run.guard else f"it ended by {run.cause!r}"
    state = (
        f"at {run.lasted:.2f} s: x {run.x[-1]:+.3f} m (limit {paper.X_LIMIT:g}), x_dot "
        f"{run.x_dot[-1]:+.2f} m/s, phi {degrees(run.estimated_phi[-1]):+.1f} deg (limit "
        f"{paper.PHI_LIMIT_DEG:g})"
    )
    limits = np.array([joint.velocity for joint in run.conditions.arm.joints])
    shares = np.abs(run.dq[-1]) / limits
    joint = int(np.argmax(shares))
    return f"{who} {state}; joint {joint + 1} moved at {shares[joint]:.0%} of its velocity limit"


def _told(how: LoggedEnding, lasted: float) -> Evidence:
    """Return what the log itself says."""
    reason = how.reason or f"the log says: {how.cause}"
    if how.cause in TELLING:
        return Evidence(TELLING[how.cause], 0.95, lasted, reason)
    for words, name in FAULTS.items():
        if words in how.reason:
            return Evidence(name, 0.95, lasted, reason)
    return Evidence(ENDINGS.get(how.cause, CauseName.UNKNOWN), 0.2, lasted, reason)


def _course(run: RunLog) -> RunTimeline:
    u_max = run.conditions.u_max or float(np.abs(run.u).max())
    late, torques = np.zeros(0), (np.zeros(0), np.zeros((0, 1)), np.ones(1))
    if not run.conditions.simulated:
        ticks = run.phase_ticks(Phase.BALANCING)
        # The tick that stops the run counts: its lateness may be why.
        late = run.tables["tick"]["late"][ticks[0] : ticks[-1] + 2]
        torques = _torques(run)
    pendulum = pendulum_of(run)
    nothing = np.zeros(0)
    try:
        time, rate = _unexplained_rate(run, pendulum)
    except (ArtefactError, RecordingError, ValueError):  # too short, or of an unknown arm
        time, rate = nothing, nothing
    return RunTimeline(run, pendulum, u_max, late, time, rate, *torques)


def _torques(run: RunLog) -> tuple[Array, Array, Array]:
    """Return times [s], external torques beyond the usual [N m], and what the guard allows."""
    reply, tick = run.tables["reply"], run.tables["tick"]["time"]
    ticks = run.phase_ticks(Phase.BALANCING)
    began, last = tick[ticks[0]], tick[ticks[-1]] + AFTER
    reply = reply[np.isfinite(reply["torque"]).all(axis=1)]
    reply = reply[(reply["time"] >= began) & (reply["time"] <= last)]
    limit = [TORQUE_SHARE * joint.torque for joint in run.conditions.arm.joints]
    if len(reply) == 0:
        return np.zeros(0), np.zeros((0, len(limit))), np.array(limit)
    usual = np.median(reply["torque"], axis=0)
    return reply["time"] - began, reply["torque"] - usual, np.array(limit)


def _unexplained_rate(run: RunLog, pendulum: PendulumParameters) -> tuple[Array, Array]:
    """Return M(t) of the module's docstring: times [s] and rates [rad/s], shape (n,) each."""
    moved = read_motion(run, run.conditions.arm)
    if moved.time[-1] - moved.time[0] > 2.0 * run.lasted + 1.0:
        raise RecordingError("its samples reach far beyond its ticks")
    half = max(WINDOW, 1.5 * float(np.median(np.diff(moved.time))))
    time = np.arange(moved.time[0] + half, moved.time[-1] - half, GRID)
    if len(time) < 3:
        raise RecordingError("the run is too short")
    phi, phi_dot = _lines(moved.time, np.unwrap(moved.phi), time, half)
    _, x_dot = _lines(moved.time, moved.x, time, half)
    middle = 0.5 * (phi[1:] + phi[:-1])
    falls = pendulum.w2 * np.sin(middle) - pendulum.c * 0.5 * (phi_dot[1:] + phi_dot[:-1])
    steps = np.diff(phi_dot) + pendulum.k * np.cos(middle) * np.diff(x_dot) - falls * GRID
    return time, np.concatenate(([0.0], np.cumsum(steps)))


def _lines(time: Array, values: Array, at: Array, half: float) -> tuple[Array, Array]:
    """Return value and slope of the lines fitted to what lies within `half` of each place."""
    low, high = np.searchsorted(time, at - half), np.searchsorted(time, at + half, side="right")
    sums = [
        np.concatenate(([0.0], np.cumsum(part)))
        for part in (np.ones_like(time), time, values, time * time, time * values)
    ]
    n, t, y, tt, ty = (total[high] - total[low] for total in sums)
    slope = (n * ty - t * y) / (n * tt - t * t)
    return (y - slope * t) / n + slope * at, slope


# What is looked for.


def _outside(course: RunTimeline) -> Evidence | None:
    """The release, or a later moment, from which on no command could hold the pendulum."""
    log, bound = course.log, course.recoverable
    beyond = np.abs(course.falling) > bound
    inside = np.flatnonzero(~beyond)
    first = int(inside[-1]) + 1 if len(inside) else 0
    if first == len(beyond):
        return None
    time = float(log.time[first])
    where = (
        f"phi + phi_dot/sqrt(w2) was {degrees(course.falling[first]):+.1f} deg at "
        f"{time:.2f} s, and u of {course.u_max:g} m/s^2 can turn back {degrees(bound):.1f} deg"
    )
    if time <= AT_RELEASE:
        return Evidence(CauseName.OUTSIDE, 0.85, time, f"let go too far out: {where}")
    before = slice(max(first - 15, 0), first + 1)
    largest = float(np.mean(np.abs(log.u[before]) >= 0.99 * course.u_max))
    return Evidence(
        CauseName.SATURATION,
        0.35 + 0.1 * largest,
        time,
        f"{where}; the largest command stood for {largest:.0%} of the 0.15 s before",
    )


def _push(course: RunTimeline) -> Evidence | None:
    """The largest step of the unexplained rate."""
    time, rate = course.time, course.rate
    wide, around = round(STEP_TIME / GRID), round(AROUND / GRID)
    if len(time) <= wide + 2:
        return None
    steps = rate[wide:] - rate[:-wide]
    middle = time[wide // 2 : wide // 2 + len(steps)]
    usual = np.array(
        [np.median(steps[max(i - around, 0) : i + around + 1]) for i in range(len(steps))]
    )
    late = middle >= course.log.lasted - BEFORE_THE_END
    unusual = np.where(late, np.abs(steps - usual), 0.0)
    i = int(np.argmax(unusual))
    if unusual[i] < PUSH:
        return None
    size = float(steps[i] - usual[i])
    return Evidence(
        CauseName.PUSH,
        0.5 + 0.32 * min(abs(size) / STRONG, 1.0),
        float(middle[i]),
        f"at {middle[i]:.2f} s the pendulum's rate changed by {degrees(size):+.0f} deg/s within "
        f"{1e3 * STEP_TIME:.0f} ms, beyond what gravity and the flange explain",
    )


def _zero(course: RunTimeline) -> Evidence | None:
    """The slope of the unexplained rate, and what the observer knows of it."""
    time, rate = course.time, course.rate
    end = course.log.lasted
    late = time >= max(time[-1] - ZERO_TIME, 0.0) if len(time) else np.zeros(0, bool)
    if late.sum() * GRID < SHORTEST:
        return None
    # Steps are pushes: the middle of all slopes over a quarter of the time does not see one.
    quarter = max(int(late.sum()) // 4, 1)
    slopes = (rate[late][quarter:] - rate[late][:-quarter]) / (quarter * GRID)
    error = -float(np.median(slopes)) / course.pendulum.w2
    known = float(course.log.bias[-1])
    if abs(error) < ZERO:
        return None
    return Evidence(
        CauseName.ZERO,
        0.5 + 0.35 * min(abs(error) / CLEARLY, 1.0),
        end,
        f"over the last {late.sum() * GRID:.1f} s the encoder read {degrees(error):+.1f} deg from "
        f"upright while gravity pulled as upright (the observer knew of {degrees(known):+.1f} deg)",
    )


def _frozen(course: RunTimeline) -> Evidence | None:
    """Counts that stood still to the end while the pivot was accelerated."""
    encoder, log = course.log.encoder, course.log
    if len(encoder.time) < 3:
        return None
    changes = np.flatnonzero(np.diff(encoder.counts))
    since = float(encoder.time[changes[-1] + 1]) if len(changes) else float(encoder.time[0])
    lasted = float(encoder.time[-1]) - since
    ticks = log.time >= since
    if lasted < FROZEN or ticks.sum() < 2:
        return None
    # x_dot as the policy saw it is ahead of the arm: what was commanded is in it.
    turned = course.pendulum.k * cos(log.phi[-1]) * float(np.ptp(log.x_dot[ticks]))
    if turned < FROZEN_RATE:
        return None
    return Evidence(
        CauseName.STALE,
        0.9,
        since,
        f"from {since:.2f} s the count stood at {int(encoder.counts[-1])} for "
        f"{1e3 * lasted:.0f} ms, while the flange should have turned the pendulum by "
        f"{degrees(turned):.0f} deg/s",
    )


def _jump(course: RunTimeline) -> Evidence | None:
    """The largest step of the counts that no pendulum makes."""
    encoder, per_rev = course.log.encoder, course.log.conditions.counts_per_rev
    if per_rev is None or len(encoder.time) < 3:
        return None
    time, resolution = encoder.time.tolist(), 2.0 * np.pi / per_rev
    counts = encoder.counts.tolist()
    worst, when = 0.0, 0.0
    for i in range(2, len(time)):
        if time[i] > time[i - 1] > time[i - 2]:
            size = unexplained(tuple(time[i - 2 : i + 1]), tuple(counts[i - 2 : i + 1]), resolution)
            worst, when = max((worst, when), (size, time[i]))
    if worst <= MAX_COUNT_JUMP:
        return None
    return Evidence(
        CauseName.JUMP,
        0.92,
        when,
        f"at {when:.3f} s the count jumped by {degrees(worst):.1f} deg more than a pendulum moves",
    )


def _late(course: RunTimeline) -> Evidence | None:
    """The latest tick."""
    if course.late.max(initial=0.0) <= MAX_TICK_LATENESS:
        return None
    i = int(np.argmax(course.late))
    when = i * course.log.conditions.h
    # Above what a rule says: replies that nobody fetched in time are overdue, too.
    return Evidence(
        CauseName.LATE,
        0.97,
        when,
        f"the tick at {when:.2f} s was {1e3 * course.late[i]:.0f} ms late",
    )


def _contact(course: RunTimeline) -> Evidence | None:
    """The largest external torque."""
    shares = np.abs(course.torque) / course.torque_limit
    if shares.max(initial=0.0) < TOUCHED:
        return None
    i, joint = np.unravel_index(int(np.argmax(shares)), shares.shape)
    when, torque = float(course.torque_time[i]), float(course.torque[i, joint])
    # Above a rule that names where the arm was moved to by it.
    return Evidence(
        CauseName.CONTACT,
        0.96 if shares[i, joint] >= 1.0 else 0.8,
        when,
        f"at {when:.2f} s the external torque at joint {joint + 1} was {torque:+.1f} N m from what "
        f"is usual; the guard allows {course.torque_limit[joint]:.1f} N m",
    )


LOOKS: Final[tuple[Callable[[RunTimeline], Evidence | None], ...]] = (
    _outside,
    _push,
    _zero,
    _frozen,
    _jump,
    _late,
    _contact,
)
"""What is looked for in the balancing."""
