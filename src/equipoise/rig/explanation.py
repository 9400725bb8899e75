r"""Causes of a run's end, ranked by their evidence in its log.

**The recoverable set** (`equipoise.worlds.reachability`). The maximum acceleration
:math:`u_{max}` turns the diverging angle :math:`\varphi + \dot\varphi / \mu` back below
:math:`(k u_{max} + f) / w_2`; beyond, no command does. The state is the policy's observation, at
which its command takes effect.

**The unexplained rate.** The measurements of encoder and joints are compared with the pendulum's
equation:

.. math:: M(t) = \int d\dot\varphi + k \cos\varphi\, d\dot x - (w_2 \sin\varphi - c \dot\varphi)\,dt

It is constant in an undisturbed run. A push appears as a step. A zero error b of the encoder, or a
base that is tilted by b, appears as a slope of :math:`-w_2 b`.

**The encoder.** Counts that are constant while the pivot accelerates, and counts that jump.

**The cause in the log.** A rule that names a root cause (a late tick, a contact) ranks high. A rule
that names a symptom (the angle, the track) ranks last.
"""

from collections.abc import Mapping
from enum import Enum
from math import cos, degrees
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.control.states import Phase
from equipoise.errors import ArtefactError, RecordingError
from equipoise.identification.refine import read_motion
from equipoise.logs.run_log import BROKEN_OFF, RunLog
from equipoise.logs.runs import LoggedEnding, ending, pendulum_of
from equipoise.model.pendulum import PendulumParameters
from equipoise.rig.run_controller import IDENTIFIED, POLICY
from equipoise.safety.rules import (
    MAX_COUNT_JUMP,
    MAX_STALL,
    TORQUE_SHARE,
    Rule,
    unexplained_turn,
)
from equipoise.worlds.reachability import RecoveryParams, diverging_angle

Array = npt.NDArray[np.float64]

GRID_STEP: Final = 0.005
"""Sampling period of the unexplained rate [s]."""
FIT_HALF_WIDTH: Final = 0.015
"""Half the window over which a rate is fitted [s]; at least three samples."""
STEP_TIME: Final = 0.08
"""Duration within which the unexplained rate steps in a push [s]."""
BASELINE_HALF_WIDTH: Final = 0.5
"""Half the window of the median with which such a step is compared [s]."""
MIN_PUSH: Final = 0.35
"""Minimum step of the unexplained rate in a push [rad/s]: 20 deg/s. Noise and a wrong pendulum
model reach 3 deg/s."""
FINAL_WINDOW: Final = 2.5
"""Window before the end for detecting a push [s]."""
ZERO_WINDOW: Final = 0.8
"""Window before the end for estimating the encoder's zero [s]."""
MIN_ZERO_WINDOW: Final = 0.12
"""Minimum window for estimating the encoder's zero in a shorter run [s]."""
MIN_ZERO_ERROR: Final = np.deg2rad(0.75)
"""Minimum zero error that is reported [rad]: a referenced zero is good to 0.1 deg, a base is level
to 0.5 deg."""
LARGE_ZERO_ERROR: Final = np.deg2rad(2.5)
"""Zero error that ends a run by itself [rad]."""
LARGE_PUSH: Final = 1.2
"""Push that ends a run by itself [rad/s]."""
MIN_FROZEN_TIME: Final = 0.06
"""Minimum duration of constant counts that is reported [s]."""
MIN_FROZEN_RATE: Final = 0.2
"""Minimum change of the pendulum's rate by the pivot during constant counts [rad/s]."""
CONTACT_SHARE: Final = 0.3
"""Minimum share of the allowed external torque that counts as a contact [-]; balancing reaches
0.04 on the twin."""
TORQUE_DELAY: Final = 0.1
"""Window after the end for detecting a contact [s]; torques are measured every 50 ms."""
RELEASE_WINDOW: Final = 0.05
"""Duration of the release [s]."""


class CauseName(Enum):
    """Why a run ended."""

    LASTED = "lasted"
    """It lasted to its end."""
    OPERATOR = "operator"
    """The operator stopped it."""
    OUTSIDE = "outside the recoverable set"
    """The pendulum was released where no command could hold it."""
    PUSH = "push"
    """An impact on the pendulum."""
    ZERO = "zero error"
    """The encoder's zero is wrong, or shifted, or the base is tilted."""
    STALE = "stale encoder"
    """Counts were constant or missing."""
    JUMP = "jumping encoder"
    """Counts were lost, or moved faster than a pendulum."""
    POLICY = "policy"
    """The policy raised, exceeded its time limit, or returned no finite number."""
    LATE = "late tick"
    """The loop missed a deadline."""
    SATURATION = "saturation"
    """The maximum command was not enough."""
    JOINT = "joint limit"
    """A command exceeded a joint's limits."""
    TRACK = "track"
    """The flange reached the end of its track, with the pendulum still balanced."""
    ANGLE = "angle"
    """The pendulum fell, without evidence of another cause."""
    CONTACT = "contact"
    """The arm touched an obstacle."""
    NOT_FOLLOWING = "robot not following"
    """The arm did not follow its setpoints."""
    LINK = "link"
    """The robot did not answer."""
    POSTURE = "flange astray"
    """The flange left its line or orientation."""
    SPEED = "flange speed"
    """The flange exceeded its speed limit, of T1 or of a slow link."""
    SELF_TEST = "self-test"
    """The pendulum did not match its model, before it was lifted."""
    UNIDENTIFIED = "arm not identified"
    """The excitation before the lift identified no arm that the policy was trained for."""
    FAULT = "fault"
    """Another fault, named in the log."""
    BUG = "mistake in the program"
    """The program computed an invalid command."""
    EXCITED = "excitation"
    """The arm was excited; no policy ran."""
    BROKEN_OFF = "log broken off"
    """The log ends before the run."""
    UNKNOWN = "unknown"
    """The log names a cause that is unknown to this version."""


ADVICE: Final = {
    CauseName.LASTED: "nothing has to be done",
    CauseName.OPERATOR: "nothing has to be done",
    CauseName.OUTSIDE: "release more gently and more upright, and take the hand straight away",
    CauseName.PUSH: "keep hands, cables and draughts away from the pendulum",
    CauseName.ZERO: "check the encoder's coupling and wires, level the base, and reference again "
    "with the pendulum at rest",
    CauseName.STALE: "check the encoder's cable, power and coupling",
    CauseName.JUMP: "check the encoder's coupling and wiring, and look for interference",
    CauseName.POLICY: "correct the policy as the evidence says, and try it on a virtual rig first "
    "(`equipoise deploy POLICY --robot twin:nominal`)",
    CauseName.LATE: "find with `equipoise rig doctor` what delays this machine",
    CauseName.SATURATION: "train a policy with larger actions, or identify pendulum and actuator "
    "again (`equipoise refine`)",
    CauseName.JOINT: "move home away from the limit, or lower the gains of CLIK",
    CauseName.TRACK: "evaluate the policy on the twin (`equipoise evaluate POLICY --world "
    "twin:nominal`), and train one that stays on the track there",
    CauseName.ANGLE: "identify pendulum and actuator again (`equipoise refine`)",
    CauseName.CONTACT: "find what the arm touched before it moves again",
    CauseName.NOT_FOLLOWING: "check the robot's panel: emergency stop, enabling switch, mode",
    CauseName.LINK: "check cable and network; `equipoise rig doctor` measures round trips",
    CauseName.POSTURE: "check the mounting of base and flange, and the actuator in use",
    CauseName.SPEED: "train with --max-speed, leave T1, or make the link to the robot faster",
    CauseName.SELF_TEST: "follow the advice of the self-test",
    CauseName.UNIDENTIFIED: "train with `equipoise train --actuator` and the actuator file of this "
    "run; without one, run again",
    CauseName.FAULT: "repair what the evidence names, and check the rig with `equipoise rig "
    "doctor` before the next run",
    CauseName.BUG: "keep this log and report it; do not run again before it is understood",
    CauseName.EXCITED: "identify the actuator from this log with `equipoise identify`",
    CauseName.BROKEN_OFF: "find what ended the program before the run: power, memory, a full disk, "
    "a signal",
    CauseName.UNKNOWN: "explain it with the version of Equipoise that wrote the log",
}
"""Advice for each cause."""
_TRAIN_FOR_WORLD: Final = (
    "train for this world's actuator: `equipoise deploy --excite --world WORLD`, `equipoise "
    "identify`, `equipoise train --actuator actuator.json`"
)
IN_SIMULATION: Final = {
    CauseName.OUTSIDE: "start nearer to upright (`evaluation.phi_high`, "
    "`evaluation.phi_dot_high`), or train with larger actions",
    CauseName.ZERO: "train for a zero that is wrong by as much (`equipoise train --set "
    "plant.zero_error=...`), or lower `zero_offset` and `zero_error` of the world",
    CauseName.TRACK: _TRAIN_FOR_WORLD,
    CauseName.ANGLE: _TRAIN_FOR_WORLD,
    CauseName.NOT_FOLLOWING: "identify the actuator of this world (`equipoise deploy --excite "
    "--world WORLD`, `equipoise identify`) and give it with `--actuator`",
    CauseName.POSTURE: "lower the masses of bracket and pendulum in the world, or identify its "
    "actuator and give it with `--actuator`",
    CauseName.SPEED: "train with --max-speed, or remove the speed limit (`t1` of the world, "
    "`--max-speed` of the command)",
}
"""Advice for simulated runs, where it differs."""

_LOGGED_NAMES: Final[Mapping[CauseName, tuple[str | Rule, ...]]] = {
    CauseName.LASTED: ("lasted",),
    CauseName.EXCITED: ("excited",),
    CauseName.BUG: (Rule.NUMBER, Rule.COUNT),
    CauseName.OPERATOR: ("operator", "dry run"),
    CauseName.SELF_TEST: ("self-test",),
    CauseName.UNIDENTIFIED: (IDENTIFIED,),
    CauseName.LINK: ("link lost", Rule.LINK, Rule.MEASUREMENT_STALE),
    CauseName.NOT_FOLLOWING: (Rule.NOT_FOLLOWING, Rule.FOLLOWING, Rule.FIRST),
    CauseName.CONTACT: (Rule.TORQUE,),
    CauseName.SPEED: (Rule.SPEED,),
    CauseName.POSTURE: (Rule.DRIFT, Rule.TILT),
    CauseName.POLICY: (POLICY,),
    CauseName.LATE: (Rule.TICK,),
    CauseName.STALE: (Rule.ENCODER_STALE,),
    CauseName.JUMP: (Rule.ENCODER_ILLEGAL, Rule.ENCODER_GAP, Rule.ENCODER_JUMP),
    CauseName.ANGLE: (Rule.ANGLE,),
    CauseName.TRACK: (Rule.TRACK,),
    CauseName.JOINT: (
        *("joint limit", Rule.POSITION, Rule.JUMP, Rule.LEAD),
        *(Rule.VELOCITY, Rule.ACCELERATION, Rule.SINGULAR),
    ),
    CauseName.FAULT: ("fault", "error", "unknown"),
    CauseName.BROKEN_OFF: (BROKEN_OFF,),
}
LOGGED_CAUSES: Final = {
    rule.value if isinstance(rule, Rule) else rule: cause
    for cause, rules in _LOGGED_NAMES.items()
    for rule in rules
}
"""Causes by their names in a log."""
SYMPTOMS: Final = frozenset(
    CauseName[name] for name in ("ANGLE", "TRACK", "JOINT", "FAULT", "BROKEN_OFF", "UNKNOWN")
)
"""Causes that name a symptom, not a root cause."""
NOT_ANALYSED: Final = frozenset({CauseName.LASTED, CauseName.OPERATOR, CauseName.EXCITED})
"""Causes after which no detector runs."""
FAULT_KEYWORDS: Final = {
    "jumped from": CauseName.JUMP,
    "began anew": CauseName.JUMP,
    "introduced itself": CauseName.JUMP,
    "sent no line": CauseName.STALE,
    "is gone": CauseName.STALE,
    "ever later": CauseName.STALE,
    "the setpoint of joint": CauseName.JOINT,
}
"""Causes by phrases in the messages of drivers and guard."""


class Evidence(NamedTuple):
    """A possible cause and its evidence."""

    name: CauseName
    """Name of the cause."""
    score: float
    """Strength of the evidence, 0 to 1; the cause with the maximum is the most likely."""
    time: float
    """Time since the release [s]."""
    evidence: str
    """The evidence in a sentence, with its numbers."""
    simulated: bool = False
    """Whether the run was simulated, without rig and operator."""

    @property
    def advice(self) -> str:
        """Advice against this cause."""
        return (IN_SIMULATION if self.simulated else {}).get(self.name) or ADVICE[self.name]


class Explanation(NamedTuple):
    """Causes of a run's end."""

    causes: tuple[Evidence, ...]
    """Possible causes, the most likely first; never empty."""
    ending: LoggedEnding
    """End of the run as logged."""
    log: RunLog | None
    """Log of the balancing; None for a run that ended before it."""


class RunTimeline(NamedTuple):
    """Input of the detectors."""

    log: RunLog
    """The balancing."""
    pendulum: PendulumParameters
    """The assumed pendulum."""
    u_max: float
    """Maximum acceleration that the policy commands [m/s^2]."""
    time: Array
    """Times of the unexplained rate [s], shape (m,)."""
    rate: Array
    """The unexplained rate [rad/s], shape (m,)."""


def explain(run: RunLog) -> Explanation:
    """Return the causes of a run's end.

    Args:
        run: Log of the run.
    """
    simulated = run.conditions.simulated
    if simulated and run.end is not None:
        how = LoggedEnding(run.guard or run.cause, _reason(run), None, True)
    else:
        how = ending(run)
    log = run if simulated or _has_balancing(run) else None
    found = [_logged_cause(how, 0.0 if log is None else log.lasted)]
    if log is not None and len(log.time) > 0 and found[0].name not in NOT_ANALYSED:
        timeline = _timeline(run)
        found += [finding for detect in DETECTORS if (finding := detect(timeline)) is not None]
    best: dict[CauseName, Evidence] = {}
    for finding in sorted(found, key=lambda finding: -finding.score):
        best.setdefault(finding.name, finding._replace(simulated=simulated))
    return Explanation(tuple(best.values()), how, log)


def _has_balancing(run: RunLog) -> bool:
    """Return whether a run on a rig reached the balancing, and its counts have a zero."""
    try:
        return len(run.ticks) > 0 and len(run.encoder.time) >= 0
    except ArtefactError:
        return False


def _reason(run: RunLog) -> str:
    """Return the end of a simulated run in a sentence, with the state of its last tick."""
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


def _logged_cause(how: LoggedEnding, lasted: float) -> Evidence:
    """Return the cause that the log names."""
    reason = how.reason or f"the log says: {how.cause}"
    cause = LOGGED_CAUSES.get(how.cause, CauseName.UNKNOWN)
    if cause not in SYMPTOMS:
        return Evidence(cause, 0.95, lasted, reason)
    for keyword, root in FAULT_KEYWORDS.items():
        if keyword in how.reason:
            return Evidence(root, 0.95, lasted, reason)
    return Evidence(cause, 0.2, lasted, reason)


def _timeline(run: RunLog) -> RunTimeline:
    u_max, pendulum = run.conditions.u_max or float(np.abs(run.u).max()), pendulum_of(run)
    try:
        time, rate = _unexplained_rate(run, pendulum)
    except (ArtefactError, RecordingError, ValueError):  # too short, or of an unknown arm
        time = rate = np.zeros(0)
    return RunTimeline(run, pendulum, u_max, time, rate)


def _unexplained_rate(run: RunLog, pendulum: PendulumParameters) -> tuple[Array, Array]:
    """Return M(t) of the module's docstring: times [s] and rates [rad/s], shape (n,) each.

    Raises:
        RecordingError: The run is too short, or its samples exceed its ticks.
    """
    moved = read_motion(run, run.conditions.arm)
    if moved.time[-1] - moved.time[0] > 2.0 * run.lasted + 1.0:
        raise RecordingError("its samples reach far beyond its ticks")
    half = max(FIT_HALF_WIDTH, 1.5 * float(np.median(np.diff(moved.time))))
    time = np.arange(moved.time[0] + half, moved.time[-1] - half, GRID_STEP)
    if len(time) < 3:
        raise RecordingError("the run is too short")
    phi, phi_dot = _local_fits(moved.time, np.unwrap(moved.phi), time, half)
    _, x_dot = _local_fits(moved.time, moved.x, time, half)
    middle = 0.5 * (phi[1:] + phi[:-1])
    falls = pendulum.w2 * np.sin(middle) - pendulum.c * 0.5 * (phi_dot[1:] + phi_dot[:-1])
    steps = np.diff(phi_dot) + pendulum.k * np.cos(middle) * np.diff(x_dot) - falls * GRID_STEP
    return time, np.concatenate(([0.0], np.cumsum(steps)))


def _local_fits(time: Array, values: Array, at: Array, half: float) -> tuple[Array, Array]:
    """Return values and slopes at `at` of lines fitted to the samples within `half` of each."""
    low, high = np.searchsorted(time, at - half), np.searchsorted(time, at + half, side="right")
    sums = [
        np.concatenate(([0.0], np.cumsum(part)))
        for part in (np.ones_like(time), time, values, time * time, time * values)
    ]
    n, t, y, tt, ty = (total[high] - total[low] for total in sums)
    slope = (n * ty - t * y) / (n * tt - t * t)
    return (y - slope * t) / n + slope * at, slope


# Detectors.


def _outside(timeline: RunTimeline) -> Evidence | None:
    """Detect the time after which no command could hold the pendulum."""
    log, pendulum = timeline.log, timeline.pendulum
    params = RecoveryParams(pendulum, delay=0.0, u_max=timeline.u_max)
    diverging = diverging_angle(log.phi, log.phi_dot, pendulum)
    bound = params.largest
    beyond = np.abs(diverging) > bound
    inside = np.flatnonzero(~beyond)
    first = int(inside[-1]) + 1 if len(inside) else 0
    if first == len(beyond):
        return None
    time = float(log.time[first])
    where = (
        f"phi + phi_dot / {params.fade:.1f} was {degrees(diverging[first]):+.1f} deg at "
        f"{time:.2f} s, and u of {timeline.u_max:g} m/s^2 can turn back {degrees(bound):.1f} deg"
    )
    if time <= RELEASE_WINDOW:
        return Evidence(CauseName.OUTSIDE, 0.85, time, f"released too far out: {where}")
    before = slice(max(first - 15, 0), first + 1)
    largest = float(np.mean(np.abs(log.u[before]) >= 0.99 * timeline.u_max))
    where += f"; the largest command stood for {largest:.0%} of the 0.15 s before"
    return Evidence(CauseName.SATURATION, 0.35 + 0.1 * largest, time, where)


def _push(timeline: RunTimeline) -> Evidence | None:
    """Detect the largest step of the unexplained rate."""
    time, rate = timeline.time, timeline.rate
    wide, half = round(STEP_TIME / GRID_STEP), round(BASELINE_HALF_WIDTH / GRID_STEP)
    if len(time) <= wide + 2:
        return None
    steps = rate[wide:] - rate[:-wide]
    middle = time[wide // 2 : wide // 2 + len(steps)]
    windows = (steps[max(i - half, 0) : i + half + 1] for i in range(len(steps)))
    usual = np.array([np.median(window) for window in windows])
    late = middle >= timeline.log.lasted - FINAL_WINDOW
    unusual = np.where(late, np.abs(steps - usual), 0.0)
    i = int(np.argmax(unusual))
    if unusual[i] < MIN_PUSH:
        return None
    size, when = float(steps[i] - usual[i]), float(middle[i])
    text = (
        f"at {when:.2f} s the pendulum's rate changed by {degrees(size):+.0f} deg/s within "
        f"{1e3 * STEP_TIME:.0f} ms, more than gravity and the flange explain"
    )
    return Evidence(CauseName.PUSH, 0.5 + 0.32 * min(abs(size) / LARGE_PUSH, 1.0), when, text)


def _zero(timeline: RunTimeline) -> Evidence | None:
    """Detect a slope of the unexplained rate."""
    time, rate = timeline.time, timeline.rate
    late = time >= max(time[-1] - ZERO_WINDOW, 0.0) if len(time) else np.zeros(0, bool)
    if late.sum() * GRID_STEP < MIN_ZERO_WINDOW:
        return None
    # The median of all slopes over a quarter of the window is robust to a step, which is a push.
    quarter = max(int(late.sum()) // 4, 1)
    slopes = (rate[late][quarter:] - rate[late][:-quarter]) / (quarter * GRID_STEP)
    error = -float(np.median(slopes)) / timeline.pendulum.w2
    if abs(error) < MIN_ZERO_ERROR:
        return None
    score = 0.5 + 0.35 * min(abs(error) / LARGE_ZERO_ERROR, 1.0)
    text = (
        f"over the last {late.sum() * GRID_STEP:.1f} s the encoder read {degrees(error):+.1f} deg "
        "from upright while gravity pulled as upright (the observer's estimate: "
        f"{degrees(float(timeline.log.bias[-1])):+.1f} deg)"
    )
    return Evidence(CauseName.ZERO, score, timeline.log.lasted, text)


def _frozen(timeline: RunTimeline) -> Evidence | None:
    """Detect counts that were constant to the end while the pivot accelerated."""
    encoder, log = timeline.log.encoder, timeline.log
    if len(encoder.time) < 3:
        return None
    changes = np.flatnonzero(np.diff(encoder.counts))
    since = float(encoder.time[changes[-1] + 1]) if len(changes) else float(encoder.time[0])
    lasted = float(encoder.time[-1]) - since
    ticks = log.time >= since
    if lasted < MIN_FROZEN_TIME or ticks.sum() < 2:
        return None
    # The observed x_dot is ahead of the arm: it includes the pending commands.
    turned = timeline.pendulum.k * cos(log.phi[-1]) * float(np.ptp(log.x_dot[ticks]))
    if turned < MIN_FROZEN_RATE:
        return None
    text = (
        f"from {since:.2f} s the count stood at {encoder.counts[-1]} for {1e3 * lasted:.0f} ms, "
        f"while the flange should have turned the pendulum by {degrees(turned):.0f} deg/s"
    )
    return Evidence(CauseName.STALE, 0.9, since, text)


def _jump(timeline: RunTimeline) -> Evidence | None:
    """Detect the largest step of the counts beyond a pendulum's motion."""
    encoder, per_rev = timeline.log.encoder, timeline.log.conditions.counts_per_rev
    if per_rev is None or len(encoder.time) < 3:
        return None
    time, counts, resolution = encoder.time.tolist(), encoder.counts.tolist(), 2.0 * np.pi / per_rev
    worst, when = 0.0, 0.0
    for i in range(2, len(time)):
        if time[i] > time[i - 1] > time[i - 2]:
            size = unexplained_turn(time[i - 2 : i + 1], counts[i - 2 : i + 1], resolution)
            worst, when = max((worst, when), (size, time[i]))
    if worst <= MAX_COUNT_JUMP:
        return None
    text = (
        f"at {when:.3f} s the count jumped by {degrees(worst):.1f} deg more than a pendulum moves"
    )
    return Evidence(CauseName.JUMP, 0.92, when, text)


def _late(timeline: RunTimeline) -> Evidence | None:
    """Detect the latest tick."""
    log = timeline.log
    if log.conditions.simulated:
        return None
    ticks = log.phase_ticks(Phase.BALANCING)
    # The tick after the balancing may stop the run by its lateness.
    late = log.tables["tick"]["late"][ticks[0] : ticks[-1] + 2]
    i = int(np.argmax(late))
    if late[i] <= MAX_STALL:
        return None
    when = i * log.conditions.h
    # This ranks above a rule's cause: after a late tick, replies are overdue too.
    found = f"the tick at {when:.2f} s was {1e3 * late[i]:.0f} ms late"
    return Evidence(CauseName.LATE, 0.97, when, found)


def _contact(timeline: RunTimeline) -> Evidence | None:
    """Detect the largest external torque, from its median."""
    log, reply = timeline.log, timeline.log.tables["reply"]
    if log.conditions.simulated:
        return None
    began, last = log.tables["tick"]["time"][log.phase_ticks(Phase.BALANCING)[[0, -1]]]
    reply = reply[np.isfinite(reply["torque"]).all(axis=1)]
    reply = reply[(reply["time"] >= began) & (reply["time"] <= last + TORQUE_DELAY)]
    if len(reply) == 0:
        return None
    limit = np.array([TORQUE_SHARE * joint.torque for joint in log.conditions.arm.joints])
    torques = reply["torque"] - np.median(reply["torque"], axis=0)
    shares = np.abs(torques) / limit
    i, joint = np.unravel_index(int(np.argmax(shares)), shares.shape)
    if shares[i, joint] < CONTACT_SHARE:
        return None
    when, score = float(reply["time"][i] - began), 0.96 if shares[i, joint] >= 1.0 else 0.8
    text = (
        f"at {when:.2f} s the external torque at joint {joint + 1} was {torques[i, joint]:+.1f} "
        f"N m from its median; the limit is {limit[joint]:.1f} N m"
    )
    # This ranks above a rule that names the resulting motion of the arm.
    return Evidence(CauseName.CONTACT, score, when, text)


DETECTORS: Final = (_outside, _push, _zero, _frozen, _jump, _late, _contact)
"""Detectors of causes in the balancing."""
