"""Script of a run on a rig: its phases in their order, one generator each.

A phase yields the setpoints of a tick, and receives what has come until the next one (`Tick`). Its
first setpoints belong to the tick in which the phase before has ended. Motions continue from rest
after a stall of the loop or of the robot's link (`Tick.stalled`); while the link is silent, nothing
is sent and the script waits. A phase that cannot continue raises `PhaseError`. After a stop, from
here or from a safety rule, no phase is resumed: `come_to_rest` takes the place of the script.
"""

from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from math import degrees, isfinite, nan, pi, radians, sqrt
from typing import Any, Final, Never, TypeAlias, TypeVar

import numpy as np

from equipoise.arm.arm import FREE_JOINTS
from equipoise.arrays import Array
from equipoise.control.controller import Controller
from equipoise.control.minimum_jerk import MinimumJerk
from equipoise.control.policy import Policy, TaskPolicy, tick_policy
from equipoise.control.swing_up import SwingUpPolicy, amplitude, make_swing_up, time_limit
from equipoise.control.ticks import OK, OperatorMessage, Sample, TickRecord
from equipoise.errors import InputError
from equipoise.identification.driven_swing import (
    MOVE_DISTANCE,
    MOVE_TIME,
    SWING_TIME,
    SelfTest,
    SelfTestVerdict,
    self_test,
)
from equipoise.model.actuator import Actuator
from equipoise.outcomes import End, Outcome, Phase
from equipoise.printable import printable
from equipoise.rig.readings import ArmReadings, EncoderReadings, TimedJoints
from equipoise.rig.release import ReleaseDetector, ReleaseState
from equipoise.rig.request import RunRequest, judge_response
from equipoise.safety.rules import STOP_DECELERATION, largest_difference
from equipoise.safety.stop import Ramp, ramp, slow_path, stoppable_speeds, way_back
from equipoise.settings import HANGING

T = TypeVar("T")
Job: TypeAlias = Callable[[], Any]
"""Work for another process: a `functools.partial` of a function and its values."""
Submit: TypeAlias = Callable[[Job], Future[Any]]
"""Starts a job."""
Setpoints: TypeAlias = tuple[tuple[float, ...], ...]
"""Setpoints of a tick [rad]: now, and h / 2 later; empty while nothing is to be sent."""

REST_BEFORE: Final = 0.3
"""Observation of the pendulum before the move of a self-test, and of the arm after an excitation
[s]."""
RETURN_TIME: Final = 1.6
"""Duration of the way back from the self-test [s]: twice that of the way out."""
OBSERVED: Final = {Phase.DAMPING, Phase.SWINGING_UP, Phase.BALANCING}
"""Phases in which the observer runs, and a policy commands."""
POLICY_TIME_FRACTION: Final = 0.5
"""Maximum computing time of the policy, as a fraction of a tick [-]: later, the second setpoint,
due after half a tick, would be late too."""
SETTLING_TIME: Final = 0.5
"""Hold after a stop before the servo ends [s]."""
RESTART_ACCELERATION: Final = 0.5 * STOP_DECELERATION
"""Additional acceleration of the flange after a pause of the setpoints, until it has the speed of
before [m/s^2]: with the policy's largest acceleration that of a stop."""


@dataclass
class Tick:
    """Inputs of the script since its last setpoints."""

    now: float = 0.0
    """The time [s]."""
    answer: str | None = None
    """Answer of the operator to the open question."""
    samples: list[Sample] = field(default_factory=list[Sample])
    """Samples of the encoder."""
    sent: list[TimedJoints] = field(default_factory=list[TimedJoints])
    """Setpoints of the tick before, with the times at which they were due."""
    joints: list[TimedJoints] = field(default_factory=list[TimedJoints])
    """Measured joints, with the times of their measurement."""
    stalled: bool = False
    """Whether the arm has come to rest at the last setpoint, because loop or link stood still."""
    away: bool = False
    """Whether a cause of the stop shows that the arm is not at its setpoint."""
    hold_reason: str = ""
    """Reason why the setpoint holds after a stop though the arm is away; empty without one."""


Steps: TypeAlias = Generator[Setpoints, Tick, T]
"""Phase of a run, or a part of one, with the type of its result."""


class PhaseError(Exception):
    """A phase cannot continue, and the run stops."""

    def __init__(self, outcome: Outcome, **evidence: float | str) -> None:
        """Stop with an outcome and its evidence."""
        super().__init__(outcome)
        self.end = End(outcome, evidence)


class Run:
    """State of a run that its phases use: measurements, motion, messages."""

    def __init__(
        self,
        request: RunRequest,
        q: Sequence[float],
        clock: Callable[[], float] = lambda: 0.0,
        submit: Submit | None = None,
    ) -> None:
        """Begin with an arm that rests at the measured joints.

        Args:
            request: The run, with the flange speed limit from the pre-flight.
            q: Measured joints, all of them [rad].
            clock: Clock for the computing time of a policy in Python [s]; the default gives zero.
            submit: Starts a job that takes longer than a tick; None runs it within the tick.

        Raises:
            ArmError: Home is a singular posture.
            SettingsError: The delay exceeds the controller's history.
        """
        # A kernel takes the computer's time, which virtual time does not show.
        self.clock = clock if request.policy.kernel is None else lambda: 0.0
        """Clock for the computing time of the policy [s]."""
        self.submit = submit
        """Starts a job that takes longer than a tick; None in virtual time, where none does."""
        self.request, self.arm = request, request.settings.described_arm
        self.assume(request.actuator)
        self.h = self.params.h
        self.encoder = EncoderReadings(self.params.resolution)
        self.joints = ArmReadings(q, self.safety.limits)
        if (reference := request.reference) is not None:
            self.encoder.zero, self.joints.torque_at_home = reference.zero, reference.torque
        self.phase = Phase.HOMING
        """The phase."""
        self.ticks = 0
        """Number of ticks of the phase so far, without those in which the script waited."""
        self.balanced = 0
        """Number of ticks in which the policy has acted, those that were missed included."""
        self.missed = 0
        """Number of skipped ticks."""
        self.q, self.dq = tuple(q), (0.0,) * len(q)
        """Commanded joints at the end of the tick [rad], and their velocities [rad/s]."""
        self.lost_speed = 0.0
        """Speed of the flange that a pause has taken, not yet returned [m/s]."""
        self.answers: tuple[str, ...] = ()
        """Expected answers to the open question; empty without one."""
        self.messages: list[OperatorMessage] = []
        """Messages of this tick to the operator and to the log."""
        self.record = TickRecord()
        """Record of this tick for the log."""
        self.identified: Actuator | None = None
        """Actuator that the excitation has identified."""
        self.tested: SelfTest | None = None
        """Result of the last self-test."""
        self.upright: float | None = None
        """Duration of the swing-up [s]; None before its end."""
        self.done = False
        """Whether the arm rests after a stop, and the run is over."""

    @property
    def time(self) -> float:
        """Time since the phase began [s]; it stands still while the script waits."""
        return self.ticks * self.h

    def assume(self, actuator: Actuator) -> None:
        """Control with an actuator from now on; the arm rests at home.

        Raises:
            ArmError: Home is a singular posture.
            SettingsError: The delay exceeds the controller's history.
        """
        self.params, self.safety = self.request.parameters(actuator)
        boxes = self.request.policy.settings.boxes
        self.controller = Controller(self.arm, self.params, boxes)

    def enter(self, phase: Phase, name: str, text: str, answers: tuple[str, ...] = ()) -> None:
        """Begin a phase with a message, see `notify`."""
        self.phase, self.ticks, self.answers = phase, 0, ()
        self.notify(name, text, answers)

    # The operator.

    def notify(self, name: str, text: str, answers: tuple[str, ...] = ()) -> None:
        """Send a message to the operator and to the log; with answers it is a question."""
        self.answers = answers or self.answers
        self.messages.append(OperatorMessage(name, text, answers))

    # The arm.

    def still(self) -> Setpoints:
        """Hold the arm."""
        self.dq = (0.0,) * len(self.q)
        return self.q, self.q

    def begin_hanging(self) -> None:
        """Begin to observe a pendulum that hangs or swings, the arm at rest at home."""
        self.controller.begin(self.encoder.phi(), 0.0)
        self.controller.balancing, self.lost_speed = False, 0.0

    def glide(self, path: MinimumJerk, t: float) -> Setpoints:
        """Move the flange along a path on its track, as the policy would, at its time t [s]."""
        v = path.at(t + self.h).dq[0] - path.at(t).dq[0]
        return self.accelerate(v / self.h)

    def accelerate(self, u: float) -> Setpoints:
        """Return the setpoints of the controller for an acceleration of the flange [m/s^2].

        The speed that a pause has taken comes back at `RESTART_ACCELERATION`.
        """
        if self.lost_speed != 0.0:
            most = RESTART_ACCELERATION * self.h
            gained = min(max(self.lost_speed, -most), most)
            self.lost_speed -= gained
            u += gained / self.h
        setpoints = self.controller.command(u)
        self.q, self.dq = setpoints[-1], self.controller.dq
        return setpoints

    def record_decision(self, u: float) -> None:
        """Record the observation of a tick, and the policy's u [m/s^2]."""
        observed, estimate = self.controller.observation, self.controller.estimate
        self.record = TickRecord(*observed, self.controller.box, u, *estimate)

    def work(self, job: Job, hold: Callable[[], Setpoints]) -> Steps[Any]:
        """Hold the arm while a job runs; return its result, or raise its exception."""
        if self.submit is None:
            yield hold()
            return job()
        future = self.submit(job)
        yield hold()
        while not future.done():
            yield hold()
        return future.result()


def script(run: Run) -> Steps[End]:
    """Run all phases, and return the end of a run whose pendulum has survived.

    The first setpoints are those before the first tick, which the servo holds already.

    Args:
        run: The run.

    Raises:
        ArmError: Home is too close to a limit of a joint for the excitation.
        PhaseError: A phase cannot continue.
    """
    policy, motion = tick_policy(run.request.policy), run.request.excitation()
    yield from home(run)
    if run.request.reference is None:
        yield from confirm(run)
        yield from take_zero(run)
    else:
        yield from check_zero(run)
    if run.request.identify is not None:
        yield from excite(run, motion, run.request.identify)
    if run.request.start == HANGING:
        yield from swing_up(run)
    else:
        yield from lift(run)
    return (yield from balance(run, policy))


def home(run: Run) -> Steps[None]:
    """Move to home, inside the servo stream."""
    path = slow_path(run.q, run.arm.home, run.safety.limits)
    text = f"Moving to home, {path.duration:.1f} s. Press any key to stop, at any time."
    run.enter(Phase.HOMING, "homing", text)
    yield run.still()
    while run.time < path.duration:
        first = path.at(run.time + 0.5 * run.h)
        run.q, run.dq = path.at(run.time + run.h)
        tick = yield first.q, run.q
        if tick.stalled:
            path, run.ticks = slow_path(run.q, run.arm.home, run.safety.limits), 0


def confirm(run: Run) -> Steps[None]:
    """Hold the arm at home until the operator confirms."""
    question = "Is this home, the spindle level, the track free on both sides? y or n"
    run.enter(Phase.AT_HOME, "home", question, ("y", "n"))
    run.controller.begin(0.0, 0.0)
    run.q = run.arm.home
    answer = None
    while answer is None:
        answer = (yield run.still()).answer
    if answer == "n":
        raise PhaseError(Outcome.OPERATOR, typed="n")


def take_zero(run: Run) -> Steps[None]:
    """Reference the pendulum, until a self-test confirms its zero."""
    while True:
        yield from reference(run)
        test = yield from swing_test(run)
        if test.verdict is SelfTestVerdict.PASSED:
            run.encoder.zero += test.zero / run.params.resolution
            return


def check_zero(run: Run) -> Steps[None]:
    """Damp the pendulum, and check its zero against the reference, which stays."""
    while not run.encoder.samples:
        yield run.still()
    run.begin_hanging()
    run.q = run.arm.home
    yield from damp(run)
    while abs(v := run.controller.x_dot) > 1e-6:  # [m/s]
        yield run.accelerate(-min(max(v / run.h, -1.0), 1.0))  # [m/s^2]
    test = yield from swing_test(run)
    if test.verdict is not SelfTestVerdict.PASSED:
        raise PhaseError(Outcome.SELF_TEST, text=test.reason)


def reference(run: Run) -> Steps[None]:
    """Take the count of the hanging pendulum, once it is still and the operator confirms."""
    text = "Let the pendulum hang freely, and steady it with a finger."
    run.enter(Phase.REFERENCING, "hang", text)
    run.encoder.zero = nan
    since = newest = 0.0
    low = high = total = number = 0
    pressed = False
    while True:
        tick = yield run.still()
        for sample in tick.samples:
            pressed = pressed or sample.pressed
            low, high = min(low, sample.counts), max(high, sample.counts)
            if number == 0 or high - low > 1:
                since, total, number = sample.time, 0, 0
                low = high = sample.counts
            newest, total, number = sample.time, total + sample.counts, number + 1
        if not newest - since >= 2.0:  # [s]
            run.answers, pressed = (), False
        elif not run.answers:
            text = "The pendulum hangs still. Take your hand away, then press its button or Enter."
            run.notify("reference", text, (OK,))
        elif pressed or tick.answer == OK:
            run.encoder.zero = total / number
            run.joints.reference_torques()
            return


def swing_test(run: Run) -> Steps[SelfTest]:
    """Move the flange by 40 mm, judge the swing of the pendulum, and return home.

    Returns:
        A result that is passed, or says that the pendulum does not hang where it was referenced.
    """
    text = "Self-test: the arm moves by 40 mm. Keep your hands off."
    run.enter(Phase.SELF_TEST, "swing", text)
    result = yield from _swing_out(run, 1.0)
    for direction in (-1.0, 1.0, -1.0):  # until the zero's interval is small
        if result.verdict is SelfTestVerdict.REPEAT:
            result = yield from _swing_out(run, direction)
    if result.verdict not in (SelfTestVerdict.PASSED, SelfTestVerdict.ZERO):
        raise PhaseError(Outcome.SELF_TEST, text=result.reason)
    at_home = False
    while not at_home:  # a stall costs a part of the way
        path, begin = MinimumJerk((run.controller.x,), (0.0,), RETURN_TIME), run.time + run.h
        t = -run.h
        while t < RETURN_TIME + REST_BEFORE:
            yield run.glide(path, t)
            t = run.time - begin
        # As an error of the first setpoint, 20 um is an acceleration of 1 m/s^2.
        at_home = abs(run.controller.x) <= 2e-5
    run.tested = result
    return result


def _swing_out(run: Run, direction: float) -> Steps[SelfTest]:
    """Move the flange, record the pendulum's answer, and judge it."""
    x, begin = run.controller.x, run.time + REST_BEFORE
    path = MinimumJerk((x,), (x + direction * MOVE_DISTANCE,), MOVE_TIME)
    encoder, pivot = list[tuple[float, float]](), list[tuple[float, float]]()

    def record(tick: Tick) -> None:
        encoder.extend((sample.time, sample.counts) for sample in tick.samples)
        pivot.extend((time, run.controller.pose(q).x) for time, q in tick.joints)

    record((yield run.still()))
    while (t := run.time - begin) < MOVE_TIME + SWING_TIME:
        record((yield run.glide(path, t)))
    time, counts = np.array(encoder).reshape(-1, 2).T.copy()
    angle = (counts - run.encoder.hanging()) * run.params.resolution
    moved = np.array(pivot).reshape(-1, 2).T.copy()
    job = partial(self_test, time, angle, *moved, run.params.pendulum)
    try:
        result: SelfTest = yield from run.work(job, partial(run.accelerate, 0.0))
    except Exception as error:  # the arm comes to rest, whatever failed
        raise PhaseError(Outcome.SELF_TEST, text=f"the self-test failed ({error})") from error
    run.notify("self-test", f"Self-test: {result.reason}.")
    return result


def excite(run: Run, motion: Array, identify: Callable[[Array, Array], Actuator]) -> Steps[None]:
    """Move every joint about home, the pendulum hanging, and control with the arm identified.

    Args:
        run: The run.
        motion: All joints [rad], h / 2 apart, shape (m, joints).
        identify: Identification, as of `RunRequest.identify`.
    """
    seconds = 0.5 * run.h * len(motion)
    text = f"Excitation: every joint moves about home for {seconds:.0f} s. Keep away."
    run.enter(Phase.EXCITING, "excitation", text)
    sent, measured = list[TimedJoints](), list[TimedJoints]()
    row, setpoints = 0, run.still()
    while 0.5 * run.h * (row - len(motion)) <= REST_BEFORE:
        tick = yield setpoints
        if tick.stalled:
            text = "the computer or the robot's link stalled during the excitation; run again"
            raise PhaseError(Outcome.UNIDENTIFIED, text=text)
        sent += tick.sent
        measured += tick.joints
        row, setpoints = 2 * run.ticks, run.still()
        if row < len(motion):
            first, second = (tuple(q) for q in motion[row - 1 : row + 1].tolist())
            speeds = (motion[row] - motion[row - 1]) / (0.5 * run.h)
            run.q, run.dq, setpoints = second, tuple(speeds.tolist()), (first, second)
    run.notify("notice", "The arm is identified; this takes some seconds.")
    try:
        motions = _free_joints(run, sent), _free_joints(run, measured)
        job = partial(_identify, identify, run.request.policy, *motions)
        actuator, response, fits = yield from run.work(job, run.still)
        run.identified = actuator
        if not fits:
            remedy = "train with equipoise train --actuator and the actuator of this run"
            raise InputError(f"the arm's response: {response}; {remedy}")
        run.assume(actuator)
    except Exception as error:  # the arm comes to rest, whatever failed
        raise PhaseError(Outcome.UNIDENTIFIED, text=printable(str(error))) from error
    run.notify("identified", f"The arm's response: {response}.")


def _identify(
    identify: Callable[[Array, Array], Actuator], policy: TaskPolicy, sent: Array, measured: Array
) -> tuple[Actuator, str, bool]:
    """Return the identified actuator, and the judgement of the policy with it."""
    actuator = identify(sent, measured)
    return actuator, *judge_response(policy, actuator)


def _free_joints(run: Run, rows: list[TimedJoints]) -> Array:
    """Return times [s] and free joints [rad] in an array, shape (m, 7), each time once."""
    free = [(time, *run.arm.without_held(q)) for time, q in rows]
    motion = np.array(free).reshape(-1, 1 + FREE_JOINTS)
    return motion[np.unique(motion[:, 0], return_index=True)[1]]


def lift(run: Run) -> Steps[None]:
    """Hold the arm until the operator has lifted and released the pendulum."""
    text = "Lift the pendulum until it stands upright, and hold it there."
    run.enter(Phase.LIFTING, "lift", text)
    detector = ReleaseDetector(run.params.pendulum)
    nudge = round(5.0 / run.h)  # every 5 s
    while True:
        tick = yield run.still()
        for sample in tick.samples:
            detector.feed(sample.time, run.encoder.angle(sample.counts))
        if detector.state is ReleaseState.RELEASED:
            run.controller.begin(*run.encoder.falling(tick.now, run.params.pendulum.w2))
            run.lost_speed = 0.0
            return
        armed = detector.state is ReleaseState.ARMED
        if armed and run.phase is Phase.LIFTING:
            run.enter(Phase.ARMED, "armed", "\aArmed. Let go.")
        elif run.phase is Phase.ARMED and not armed:
            text = "You are still holding the pendulum. Hold it upright again."
            run.enter(Phase.LIFTING, "disarmed", text)
        elif armed and run.ticks % nudge == nudge - 1:
            run.notify("nudge", "Let go. If it stands by itself, nudge it.")


def swing_up(run: Run) -> Steps[None]:
    """Swing the hanging pendulum up until the policy can balance it.

    A swing-up that takes too long is damped, and begins again.
    """
    policy, limit = _swinging(run), time_limit(run.params.pendulum)
    run.begin_hanging()
    took = 0.0
    for attempt in range(3):
        again = "again" if attempt else f"for {limit:.0f} s at most"
        run.enter(Phase.SWINGING_UP, "swing-up", f"Swinging up, {again}. Press any key to stop.")
        while run.time < limit:
            u = _decide(run, policy, first=run.ticks == 0)
            if policy.balancing:
                run.controller.balancing = True
                run.upright = took + run.time
                return
            yield run.accelerate(u)
        took += run.time
        yield from damp(run)
        took += run.time
    raise PhaseError(Outcome.NOT_UPRIGHT, value=limit)


def damp(run: Run) -> Steps[None]:
    """Take the swing from the pendulum with the flange, until it nearly hangs."""
    policy, pendulum = _swinging(run, hang=True), run.params.pendulum
    run.enter(Phase.DAMPING, "damping", "Damping the pendulum. Press any key to stop.")
    period, last = 2.0 * pi / sqrt(pendulum.w2), 0.0
    while run.time - last < period:
        swing = amplitude(pendulum, *run.controller.observation[2:])
        last = run.time if swing > radians(5.0) else last  # the self-test needs no smaller one
        if run.time > time_limit(pendulum):
            text = f"the pendulum still swings by {degrees(swing):.0f} deg"
            raise PhaseError(Outcome.SELF_TEST, text=f"{text} after {run.time:.0f} s of damping")
        yield run.accelerate(_decide(run, policy, first=run.ticks == 0))


def _swinging(run: Run, *, hang: bool = False) -> SwingUpPolicy:
    """Return the policy that swings the pendulum up, or lets it hang."""
    kernel = run.request.policy.kernel
    assert kernel is not None  # noqa: S101 - `check_start` has refused other policies
    law = make_swing_up(run.params, run.safety.speed)
    return SwingUpPolicy(kernel, law._replace(damps=hang))


def balance(run: Run, policy: Policy) -> Steps[End]:
    """Command the policy's accelerations for the duration of the request; return the end."""
    run.enter(Phase.BALANCING, "balancing", "Balancing. Press any key to stop.")
    begin, duration = run.balanced, run.request.duration
    while (run.balanced - begin) * run.h < duration - 0.5 * run.h:
        yield run.accelerate(_decide(run, policy, first=run.balanced == begin))
        if run.controller.limit_exceeded:
            raise PhaseError(Outcome.JOINT_LIMIT)
    return End(Outcome.SURVIVED, {"duration": duration})


def _decide(run: Run, policy: Policy, *, first: bool) -> float:
    """Return and record the policy's u [m/s^2]; stop where the policy fails."""
    u, failure, began = nan, "", run.clock()
    try:
        if first:
            policy.reset()
        u = run.controller.decide(policy)
        if not isfinite(u):
            failure = f"it returned {u}"
    except BaseException as error:  # not even a request to exit may end the loop
        failure = printable(str(error)) or type(error).__name__
    evidence: dict[str, float] = {}
    took, limit = run.clock() - began, POLICY_TIME_FRACTION * run.h
    if not failure and took > limit:
        failure = f"it took {1e3 * took:.1f} ms, expected at most {1e3 * limit:.1f} ms"
        evidence = {"took": took, "limit": limit}
    run.record_decision(0.0 if failure else u)
    if failure:
        raise PhaseError(Outcome.POLICY, text=failure, **evidence)
    return u


def come_to_rest(run: Run, sent: Sequence[TimedJoints], *, on_track: bool) -> Steps[Never]:
    """Bring the arm to rest after a stop: the ramp, at most one way back, a hold.

    As of `script`, the first setpoints are those before the first tick.

    Args:
        run: The run.
        sent: The last setpoints sent; the ramp begins at the newest.
        on_track: Whether the flange moves along its track, and limits the deceleration.
    """
    yield ()
    before_stop = np.array([q for _, q in sent])
    (_, before), (_, last) = sent[-2], sent[-1]
    speed = abs(run.controller.x_dot) if on_track else 0.0
    q, dq = run.q, stoppable_speeds(run.dq, last, before, 0.5 * run.h)
    stop = ramp(q, dq, speed, run.safety.limits)
    motion: Ramp | MinimumJerk = stop
    t, went_back = 0.0, False
    while True:
        first = motion.at(t + 0.5 * run.h)
        t += run.h
        q, dq = run.q, run.dq = motion.at(t)
        run.done = t - motion.duration > SETTLING_TIME
        tick = yield first.q, q
        if tick.stalled and t < motion.duration:  # the arm rests at the last setpoint sent
            q, dq = run.q, run.dq
            motion, t = ramp(q, dq, 0.0, run.safety.limits), 0.0
        if t < motion.duration:
            if isinstance(motion, MinimumJerk) and tick.hold_reason:
                motion, t = ramp(q, dq, 0.0, run.safety.limits), 0.0
                run.notify("warning", f"The target holds: {tick.hold_reason}.")
        elif tick.away and not went_back:
            went_back = True
            reason = tick.hold_reason
            if doubt := run.joints.plausibility.doubt(run.joints.q, before_stop):
                reason = f"the measurement is not plausible ({doubt})"
            distance, joint = largest_difference(run.joints.q, q)
            place = f"Joint {joint} is measured {distance:.3g} rad from its target"
            if reason:
                text = f"{place}, which holds: {reason}. Look at the arm."
            else:
                motion, t = way_back(stop, q, run.joints.q, run.safety.limits), 0.0
                moved, _ = largest_difference(motion.start, motion.end)
                text = f"{place}, which goes back by {moved:.3f} rad. Any key ends this."
            run.notify("warning", text)
