r"""Causes of a run's end, ranked by their evidence in its log.

**The recoverable set.** The maximum acceleration :math:`u_{max}` turns the diverging angle
:math:`\varphi + \dot\varphi / \mu` back below :math:`(k u_{max} + f) / w_2`; beyond, no command
does. The state is the policy's observation, at which its command takes effect.

**The unexplained rate.** The measurements of encoder and joints are compared with the pendulum's
equation:

.. math:: M(t) = \int d\dot\varphi + k \cos\varphi\, d\dot x - (w_2 \sin\varphi - c \dot\varphi)\,dt

It is constant in an undisturbed run. A push appears as a step. A zero error b of the encoder, or a
base that is tilted by b, appears as a slope of :math:`-w_2 b`.

**The encoder.** Counts that are constant while the pivot accelerates, and counts that jump.

**The outcome in the log.** A rule that names a root cause (a late tick, a contact) ranks high. A
rule that names a symptom (the angle, the track) ranks last.
"""

from enum import StrEnum
from math import cos, degrees, radians, sqrt
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.errors import ArtefactError, RecordingError
from equipoise.identification.refine import read_motion
from equipoise.logs.run_log import RunLog
from equipoise.model.pendulum import PendulumParameters
from equipoise.outcomes import End, Outcome, describe
from equipoise.safety.rules import MAX_COUNT_JUMP, unexplained_turn

Array = npt.NDArray[np.float64]

GRID_STEP: Final = 0.005
"""Sampling period of the unexplained rate [s]."""
FIT_HALF_WIDTH: Final = 0.015
"""Half the window over which a rate is fitted [s]; at least three samples."""
STEP_TIME: Final = 0.08
"""Duration within which the unexplained rate steps in a push [s]."""
BASELINE_HALF_WIDTH: Final = 0.5
"""Half the window of the median with which such a step is compared [s]."""
FINAL_WINDOW: Final = 2.5
"""Window before the end for detecting a push [s]."""
MIN_PUSH: Final = 0.35
"""Minimum step of the unexplained rate in a push [rad/s]: 20 deg/s. Noise and a wrong pendulum
model reach 3 deg/s."""
LARGE_PUSH: Final = 1.2
"""Push that ends a run by itself [rad/s]."""
ZERO_WINDOWS: Final = (0.12, 0.8)
"""Minimum and usual window before the end for estimating the encoder's zero [s]."""
MIN_ZERO_ERROR: Final = radians(0.75)
"""Minimum zero error that is reported [rad]: a referenced zero is good to 0.1 deg, a base is level
to 0.5 deg."""
LARGE_ZERO_ERROR: Final = radians(2.5)
"""Zero error that ends a run by itself [rad]."""
MIN_FROZEN_TIME: Final = 0.06
"""Minimum duration of constant counts that is reported [s]."""
MIN_FROZEN_RATE: Final = 0.2
"""Minimum change of the pendulum's rate by the pivot during constant counts [rad/s]."""
RELEASE_WINDOW: Final = 0.05
"""Duration of the release [s]."""


class RootCause(StrEnum):
    """Cause of an end that no outcome names, found in the measurements."""

    OUTSIDE = "outside the recoverable set"
    """The pendulum was released where no command could hold it."""
    SATURATION = "saturation"
    """The maximum command was not enough."""
    PUSH = "push"
    """An impact on the pendulum."""
    ZERO = "zero error"
    """The encoder's zero is wrong, or shifted, or the base is tilted."""


_NOTHING: Final = "nothing has to be done"
_JOINTS: Final = "move home away from the limit, or lower the gains of CLIK"
_BUG: Final = "keep this log and report it; do not run again before it is understood"
_PANEL: Final = "check the robot's panel: emergency stop, enabling switch, mode"
_MOUNTING: Final = "check the mounting of base and flange, and the actuator in use"
_LINK: Final = "check cable and network; `equipoise rig doctor` measures round trips"
_ENCODER: Final = "check the encoder's cable, power, coupling and wiring"
_REPAIR: Final = "repair what the evidence names, and check the rig with `equipoise rig doctor`"
ADVICE: Final = {
    RootCause.OUTSIDE: "release more gently and more upright, and take the hand straight away",
    RootCause.SATURATION: "train a policy with larger actions, or identify pendulum and actuator "
    "again (`equipoise refine`)",
    RootCause.PUSH: "keep hands, cables and draughts away from the pendulum",
    RootCause.ZERO: "check the encoder's coupling and wires, level the base, and reference again",
    Outcome.LASTED: _NOTHING,
    Outcome.OPERATOR: _NOTHING,
    Outcome.DRY_RUN: _NOTHING,
    Outcome.EXCITED: "identify the actuator from this log with `equipoise identify`",
    Outcome.ANGLE: "identify pendulum and actuator again (`equipoise refine`)",
    Outcome.TRACK: "evaluate the policy on the twin (`equipoise evaluate POLICY --world "
    "twin:nominal`), and train one that stays on the track there",
    Outcome.NUMBER: _BUG,
    Outcome.COUNT: _BUG,
    Outcome.LINK: _LINK,
    Outcome.LINK_LOST: _LINK,
    Outcome.MEASUREMENT_STALE: _LINK,
    Outcome.NOT_FOLLOWING: _PANEL,
    Outcome.FOLLOWING: _PANEL,
    Outcome.FIRST: _PANEL,
    Outcome.TORQUE: "find what the arm touched before it moves again",
    Outcome.SPEED: "train with --set plant.max_speed=0.23, leave T1, or make the link faster",
    Outcome.DRIFT: _MOUNTING,
    Outcome.TILT: _MOUNTING,
    Outcome.TICK: "find with `equipoise rig doctor` what delays this machine",
    Outcome.ENCODER_STALE: _ENCODER,
    Outcome.ENCODER_LOST: _ENCODER,
    Outcome.ENCODER_ILLEGAL: _ENCODER,
    Outcome.ENCODER_GAP: _ENCODER,
    Outcome.ENCODER_JUMP: _ENCODER,
    Outcome.SELF_TEST: "follow the advice of the self-test",
    Outcome.UNIDENTIFIED: "train with `equipoise train --actuator` and the actuator file of this "
    "run; without one, run again",
    Outcome.POLICY: "correct the policy as the evidence says, and try it on a virtual rig first "
    "(`equipoise deploy POLICY --robot twin:nominal`)",
    Outcome.FAULT: _REPAIR,
    Outcome.ERROR: _REPAIR,
    Outcome.BROKEN_OFF: "find what ended the program: power, memory, a full disk, a signal",
}
"""Advice for each cause; of other outcomes `_JOINTS`, since they are limits of the joints."""
SYMPTOMS: Final = frozenset(
    {Outcome.ANGLE, Outcome.TRACK, Outcome.FAULT, Outcome.ERROR, Outcome.BROKEN_OFF}
) | (frozenset(Outcome) - ADVICE.keys())
"""Outcomes that name a symptom, not a root cause."""
NOT_ANALYSED: Final = frozenset({Outcome.LASTED, Outcome.OPERATOR, Outcome.EXCITED})
"""Outcomes after which no detector runs."""


class Finding(NamedTuple):
    """A possible cause and its evidence."""

    cause: Outcome | RootCause
    """The cause."""
    score: float
    """Strength of the evidence, 0 to 1; the cause with the maximum is the most likely."""
    time: float
    """Time since the release [s]."""
    evidence: str
    """The evidence in a sentence, with its numbers."""

    @property
    def advice(self) -> str:
        """Advice against this cause."""
        return ADVICE.get(self.cause, _JOINTS)


class Explanation(NamedTuple):
    """Causes of a run's end."""

    causes: tuple[Finding, ...]
    """Possible causes, the most likely first; never empty."""
    end: End
    """End of the run as logged."""
    log: RunLog | None
    """Log of the balancing; None for a run that ended before it."""


class RunTimeline(NamedTuple):
    """Input of the detectors."""

    log: RunLog
    """The balancing."""
    pendulum: PendulumParameters
    """The assumed pendulum."""
    time: Array
    """Times of the unexplained rate [s], shape (m,)."""
    rate: Array
    """The unexplained rate [rad/s], shape (m,)."""


def explain(run: RunLog) -> Explanation:
    """Return the causes of a run's end.

    Args:
        run: Log of the run.
    """
    end, log = run.ending, run if _has_balancing(run) else None
    score = 0.2 if end.outcome in SYMPTOMS else 0.95
    found = [Finding(end.outcome, score, 0.0 if log is None else log.lasted, describe(end))]
    if log is not None and len(log.time) > 0 and end.outcome not in NOT_ANALYSED:
        timeline = _timeline(log)
        found += [finding for detect in DETECTORS if (finding := detect(timeline)) is not None]
    best: dict[str, Finding] = {}
    for finding in sorted(found, key=lambda finding: -finding.score):
        best.setdefault(finding.cause, finding)
    return Explanation(tuple(best.values()), end, log)


def _has_balancing(run: RunLog) -> bool:
    """Return whether a run reached the balancing, and its counts have a zero."""
    try:
        return run.conditions.simulated or (len(run.ticks) > 0 and len(run.encoder.time) >= 0)
    except ArtefactError:
        return False


def _timeline(run: RunLog) -> RunTimeline:
    pendulum = run.conditions.pendulum_parameters
    try:
        time, rate = _unexplained_rate(run, pendulum)
    except (ArtefactError, RecordingError, ValueError):  # too short, or of an unknown arm
        time = rate = np.zeros(0)
    return RunTimeline(run, pendulum, time, rate)


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


def _outside(timeline: RunTimeline) -> Finding | None:
    """Detect the time after which no command could hold the pendulum."""
    log, (w2, k, c, coulomb) = timeline.log, timeline.pendulum[:4]
    u_max = log.conditions.u_max or float(np.abs(log.u).max())
    mu = 0.5 * (sqrt(c**2 + 4.0 * w2) + c)
    diverging, bound = log.phi + log.phi_dot / mu, (k * u_max + coulomb) / w2
    beyond = np.abs(diverging) > bound
    inside = np.flatnonzero(~beyond)
    first = int(inside[-1]) + 1 if len(inside) else 0
    if first == len(beyond):
        return None
    time = float(log.time[first])
    where = (
        f"phi + phi_dot / {mu:.1f} was {degrees(diverging[first]):+.1f} deg at "
        f"{time:.2f} s, and u of {u_max:g} m/s^2 can turn back {degrees(bound):.1f} deg"
    )
    if time <= RELEASE_WINDOW:
        return Finding(RootCause.OUTSIDE, 0.85, time, f"released too far out: {where}")
    before = slice(max(first - 15, 0), first + 1)
    largest = float(np.mean(np.abs(log.u[before]) >= 0.99 * u_max))
    where += f"; the largest command stood for {largest:.0%} of the 0.15 s before"
    return Finding(RootCause.SATURATION, 0.35 + 0.1 * largest, time, where)


def _push(timeline: RunTimeline) -> Finding | None:
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
    return Finding(RootCause.PUSH, 0.5 + 0.32 * min(abs(size) / LARGE_PUSH, 1.0), when, text)


def _zero(timeline: RunTimeline) -> Finding | None:
    """Detect a slope of the unexplained rate."""
    time, rate = timeline.time, timeline.rate
    late = time >= max(time[-1] - ZERO_WINDOWS[1], 0.0) if len(time) else np.zeros(0, bool)
    if late.sum() * GRID_STEP < ZERO_WINDOWS[0]:
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
    return Finding(RootCause.ZERO, score, timeline.log.lasted, text)


def _frozen(timeline: RunTimeline) -> Finding | None:
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
    return Finding(Outcome.ENCODER_STALE, 0.9, since, text)


def _jump(timeline: RunTimeline) -> Finding | None:
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
    return Finding(Outcome.ENCODER_JUMP, 0.92, when, text)


DETECTORS: Final = (_outside, _push, _zero, _frozen, _jump)
"""Detectors of causes in the balancing."""
