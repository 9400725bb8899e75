r"""Causes of a run's end, ranked by their evidence in its log.

**The recoverable set.** The maximum acceleration :math:`u_{max}` turns the diverging angle
:math:`\varphi + \dot\varphi / \mu` back below :math:`(k u_{max} + f) / w_2`; beyond, no command
does. The state is the policy's observation, at which its command takes effect.

**The unexplained rate.** The measurements of encoder and joints are compared with the pendulum's
equation:

.. math:: M(t) = \int d\dot\varphi + k \cos\varphi\, d\dot x - (w_2 \sin\varphi - c \dot\varphi)\,dt

It is constant in an undisturbed run. A push appears as a step. A zero error b of the encoder, or a
base that is tilted by b, appears as a slope of :math:`-w_2 b`.

**The delay.** The measured flange follows the integral of u after a delay. If the controller
predicts over a time that is shorter by T, each command meets a lean that has grown by
:math:`e^{\lambda T}`.

**The outcome in the log.** A rule that names a root cause (a late tick, a contact) ranks high. A
rule that names a symptom (the angle, the track) ranks last, and so does a late device where the
computer was late itself.
"""

from collections.abc import Iterator
from contextlib import suppress
from math import degrees, exp, radians
from typing import Final, NamedTuple

import numpy as np

from equipoise.arrays import Array
from equipoise.errors import ArtefactError, RecordingError
from equipoise.identification.refine import ModelMotion, read_motion
from equipoise.log.run_log import RunLog
from equipoise.outcomes import SYMPTOMS, EndCause, Outcome, describe
from equipoise.rig.checks import STALL
from equipoise.rig.script import RESTART_ACCELERATION
from equipoise.simulation.reachability import diverging_angle, fall_rate, recoverable_angle

GRID_STEP: Final = 0.005
"""Sampling period of the unexplained rate and of the delay [s]."""
LATE: Final = 2.5
"""Duration of the last part of a run, in which pushes and the delay are sought [s]."""
SPAN: Final = 0.1
"""Half width of the second difference of x that shows the delay [s]: a shorter one passes the noise
of the joints, a longer one the lag at steady speed, which is longer than that of a change."""


class RootCause(EndCause):
    """Cause of an end that no outcome names, found in the measurements."""

    OUTSIDE = (
        "outside the recoverable set",
        "release more gently and more upright, and take the hand straight away",
    )
    """The pendulum was released where no command could hold it."""
    SATURATION = "saturation", Outcome.ANGLE.advice
    """The maximum command was not enough."""
    PUSH = "push", "keep hands, cables and draughts away from the pendulum"
    """An impact on the pendulum."""
    ZERO = (
        "zero error",
        "check the encoder's coupling and wires, level the base, and reference again",
    )
    """The encoder's zero is wrong, or shifted, or the base is tilted."""
    DELAY = (
        "unpredicted delay",
        "identify the arm (`equipoise deploy --excite`), and train with this --actuator and "
        "controller.predict",
    )
    """The arm follows later than the controller predicts."""
    PAUSE = "pause of the setpoints", Outcome.TICK.advice
    """The arm stopped while it moved, because the computer or the link stood still."""
    BUSY = "busy computer", Outcome.TICK.advice
    """The loop was late, too."""


DELAYS: Final = (
    *(Outcome.LINK, Outcome.LINK_LOST, Outcome.MEASUREMENT_STALE),
    *(Outcome.ENCODER_STALE, Outcome.ENCODER_LOST, Outcome.ENCODER_GAP),
)
"""Outcomes that name a late device."""


class Cause(NamedTuple):
    """A possible cause of a run's end, and its evidence."""

    cause: Outcome | RootCause
    """The cause."""
    score: float
    """Strength of the evidence, 0 to 1; the cause with the maximum is the most likely."""
    time: float | None
    """Time since the release [s]; None for a run that ended before it."""
    evidence: str
    """The evidence in a sentence, with its numbers."""


def explain(run: RunLog) -> list[Cause]:
    """Return the possible causes of a run's end, the most likely first; never empty.

    Args:
        run: Log of the run.
    """
    end, balanced = run.ending, run.conditions.simulated
    with suppress(ArtefactError):  # the encoder's angles need the zero of the balancing
        balanced = balanced or (len(run.ticks) > 0 and len(run.encoder.time) >= 0)
    time = run.survival if balanced else None
    causes = list(_busy(run, time)) if end.outcome in DELAYS else []
    score = 0.2 if causes or end.outcome in SYMPTOMS else 0.95
    causes.append(Cause(end.outcome, score, time, describe(end)))
    regular = end.outcome in (Outcome.SURVIVED, Outcome.OPERATOR, Outcome.EXCITED)
    if balanced and len(run.time) > 0 and not regular:
        causes += root_causes(run)
    return sorted(causes, key=lambda cause: -cause.score)


def root_causes(run: RunLog) -> list[Cause]:
    """Return the root causes that the measurements of a balancing show."""
    causes = [*_outside(run), *_pause(run)]
    # A run that is too short, or of an unknown arm, has no unexplained rate.
    with suppress(ArtefactError, RecordingError, ValueError):
        moved = read_motion(run, run.conditions.arm)
        causes += _delay(run, moved)
        time, rate = unexplained_rate(run, moved)
        causes += [*_push(run, time, rate), *_zero(run, time, rate)]
    return causes


def unexplained_rate(run: RunLog, moved: ModelMotion) -> tuple[Array, Array]:
    """Return M(t) of the module's docstring: times [s] and rates [rad/s], shape (n,) each.

    Args:
        run: Log of the run.
        moved: Its measured motion.

    Raises:
        RecordingError: The run is too short, or its samples exceed its ticks.
    """
    pendulum = run.conditions.pendulum
    if moved.time[-1] - moved.time[0] > 2.0 * run.survival + 1.0:
        raise RecordingError("its samples reach far beyond its ticks")
    # A rate is fitted over at least three samples.
    half = max(0.015, 1.5 * float(np.median(np.diff(moved.time))))
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


def _u_max(log: RunLog) -> float:
    """Return the policy's maximum u [m/s^2]; where it is unknown, that of the run."""
    return log.conditions.u_max or float(np.abs(log.ticks.u).max())


def _busy(log: RunLog, time: float | None) -> Iterator[Cause]:
    """Detect that the computer was late itself."""
    h = log.conditions.h
    late = np.nan_to_num(log.tables["tick"]["late"][-round(LATE / h) :])
    missed = late[late > 0.5 * h]  # of a run on a rig, see `missed_ticks`
    if missed.sum() > STALL:
        text = f"the loop missed {len(missed)} of the last {len(late)} ticks, "
        yield Cause(RootCause.BUSY, 0.95, time, f"{text}by up to {1e3 * missed.max():.0f} ms")


def _outside(log: RunLog) -> Iterator[Cause]:
    """Detect the time after which no command could hold the pendulum."""
    pendulum = log.conditions.pendulum
    u_max = _u_max(log)
    diverging = diverging_angle(log.ticks.phi, log.ticks.phi_dot, pendulum)
    bound, mu = recoverable_angle(pendulum, u_max), fall_rate(pendulum) + pendulum.c
    beyond = np.abs(diverging) > bound
    inside = np.flatnonzero(~beyond)
    first = int(inside[-1]) + 1 if len(inside) else 0
    if first == len(beyond):
        return
    time = float(log.time[first])
    where = (
        f"phi + phi_dot / {mu:.1f} was {degrees(diverging[first]):+.1f} deg at "
        f"{time:.2f} s, and u of {u_max:g} m/s^2 can turn back {degrees(bound):.1f} deg"
    )
    if time <= 0.05:  # [s]: the duration of the release
        yield Cause(RootCause.OUTSIDE, 0.85, time, f"released too far out: {where}")
    else:
        yield Cause(RootCause.SATURATION, 0.4, time, where)


def _delay(log: RunLog, moved: ModelMotion) -> Iterator[Cause]:
    """Detect a delay of the flange that is longer than the controller's prediction.

    At the flange's delay T in the last part of the run, the second differences of the measured x
    and of the integral of u fit best; an arm that does not follow u has none.
    """
    h, end = log.conditions.h, float(moved.time[-1])
    time = np.arange(max(end - LATE, float(moved.time[0])), end - SPAN, GRID_STEP)
    if len(time) < 30:
        return
    v = np.cumsum(np.append(0.0, h * log.ticks.u))
    x = np.cumsum(np.append(0.0, 0.5 * h * (v[1:] + v[:-1])))
    commanded = np.append(log.time, log.time[-1] + h)
    measured = _second_difference(time, moved.time, moved.x)
    delays = np.arange(0.0, 0.15, 0.001)
    left = [np.std(measured - _second_difference(time - T, commanded, x)) for T in delays]
    best = int(np.argmin(left))
    # By the trapezoidal rule, the predicted change of phi is the mean rate times the horizon.
    rate = 0.5 * (log.ticks.phi_dot + log.ticks.estimated_phi_dot)
    horizon = float(rate @ (log.ticks.phi - log.ticks.estimated_phi) / (rate @ rate))
    # A prediction from the identified actuator is 5 ms too long at least (`controller.margin`).
    rest = float(delays[best]) - horizon
    if left[best] < 0.5 * np.std(measured) and rest > 0.002:
        text = (
            f"the flange followed u after {1e3 * delays[best]:.0f} ms, and the controller "
            f"predicted {1e3 * horizon:.0f} ms; in the other {1e3 * rest:.0f} ms a lean grows by "
            f"{exp(fall_rate(log.conditions.pendulum) * rest) - 1.0:.0%}"
        )
        # With 20 ms a table falls within seconds; without a push such a run may show one up to 0.6.
        yield Cause(RootCause.DELAY, 0.6 + 0.2 * min(rest / 0.02, 1.0), log.survival, text)


def _second_difference(at: Array, time: Array, x: Array) -> Array:
    """Return x(t + SPAN) - 2 x(t) + x(t - SPAN) of samples, constant beyond them [m]."""
    later, now, earlier = (np.interp(at + shift, time, x) for shift in (SPAN, 0.0, -SPAN))
    return later - 2.0 * now + earlier


def _pause(log: RunLog) -> Iterator[Cause]:
    """Detect the largest speed that the flange lost at once in the last part."""
    lost = np.append(0.0, -np.diff(log.ticks.x_dot))
    lost[log.time < log.survival - LATE] = 0.0
    i = int(np.argmax(np.abs(lost)))
    u_max = _u_max(log)
    if abs(lost[i]) < 1.2 * (u_max + RESTART_ACCELERATION) * log.conditions.h:  # of a command
        return
    when, size = float(log.time[i]), float(log.conditions.pendulum.k * lost[i])
    text = (
        f"at {when:.2f} s no setpoints came, and the flange stopped from {abs(lost[i]):.2f} m/s, "
        f"which changes the pendulum's rate by {degrees(size):+.0f} deg/s"
    )
    yield Cause(RootCause.PAUSE, _impact(size), when, text)


def _impact(size: float) -> float:
    """Return the score of a sudden change of phi_dot [rad/s]; 1.2 end a run by themselves."""
    return 0.5 + 0.32 * min(abs(size) / 1.2, 1.0)


def _push(log: RunLog, time: Array, rate: Array) -> Iterator[Cause]:
    """Detect the largest step of the unexplained rate in the last part."""
    duration = 0.08  # [s]: of a push
    wide = round(duration / GRID_STEP)
    if len(time) <= wide + 2:
        return
    steps = rate[wide:] - rate[:-wide]
    middle = time[wide // 2 : wide // 2 + len(steps)]
    late = middle >= log.survival - LATE
    unusual = np.where(late, steps - np.median(steps), 0.0)
    i = int(np.argmax(np.abs(unusual)))
    size, when = float(unusual[i]), float(middle[i])
    if abs(size) < 0.35:  # [rad/s]: noise and a wrong pendulum model reach 0.05
        return
    text = (
        f"at {when:.2f} s the pendulum's rate changed by {degrees(size):+.0f} deg/s within "
        f"{1e3 * duration:.0f} ms, more than gravity and the flange explain"
    )
    yield Cause(RootCause.PUSH, _impact(size), when, text)


def _zero(log: RunLog, time: Array, rate: Array) -> Iterator[Cause]:
    """Detect a slope of the unexplained rate in the last 0.8 s."""
    last = rate[time >= max(time[-1] - 0.8, 0.0)]
    seconds = len(last) * GRID_STEP
    if seconds < 0.12:
        return
    # The median of all slopes over a quarter of the window is robust to a step, which is a push.
    quarter = max(len(last) // 4, 1)
    slopes = (last[quarter:] - last[:-quarter]) / (quarter * GRID_STEP)
    error = -float(np.median(slopes)) / log.conditions.pendulum.w2
    # A referenced zero is good to 0.1 deg, a base is level to 0.5 deg; 2.5 deg end a run.
    if abs(error) < radians(0.75):
        return
    score = 0.5 + 0.35 * min(abs(error) / radians(2.5), 1.0)
    text = (
        f"over the last {seconds:.1f} s the encoder read {degrees(error):+.1f} deg from upright "
        f"while gravity pulled as upright (the observer's estimate: "
        f"{degrees(float(log.ticks.bias[-1])):+.1f} deg)"
    )
    yield Cause(RootCause.ZERO, score, log.survival, text)
