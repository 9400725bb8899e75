"""Run of a policy on a rig: connect, pre-flight, questions to the operator, run, rest.

The same sequence serves a real rig in real time (`equipoise.rig.processes`) and an emulated
one in virtual time; arguments carry the differences.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from math import ceil, inf, nan, radians
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Final

import numpy as np
import numpy.typing as npt

from equipoise.control.control_step import ControllerParams, horizon, make_controller_params
from equipoise.control.controller import Controller, FlangeKinematics
from equipoise.control.policy import (
    Policy,
    TabularPolicy,
    TaskPolicy,
    shipped_policy,
    tick_policy,
)
from equipoise.control.ticks import OperatorMessage, TickHandler
from equipoise.errors import EquipoiseError, InputError, LinkError, OutsideError
from equipoise.logs.conditions import RunConditions, RunEnd, named
from equipoise.logs.recorder import CONNECTING, WORD_TYPED, Recorder, push_event
from equipoise.logs.writer import RunWriter
from equipoise.model.actuator import Actuator
from equipoise.model.worlds import PivotFriction, pivot_friction, read_world
from equipoise.outcomes import End, Outcome
from equipoise.printable import printable
from equipoise.rig.checks import (
    check_encoder,
    check_fit,
    check_link,
    check_posture,
    check_speed,
    fitting_actuators,
    max_flange_speed,
)
from equipoise.rig.clocks import DrainingClock
from equipoise.rig.config import RigSettings
from equipoise.rig.connection import Rig, check_addresses, connect, world_of
from equipoise.rig.findings import Finding, require
from equipoise.rig.guarded import GuardedRobot
from equipoise.rig.interfaces import Clock, Operator
from equipoise.rig.loop import Executor, LoopResult, run_loop
from equipoise.rig.phases.balancing import POLICY_TIME_SHARE
from equipoise.rig.phases.context import ArmResponse, Excitation, RunParts
from equipoise.rig.probes import listen, round_trips
from equipoise.rig.run_controller import PHASES, RunController
from equipoise.rig.simulate import simulate_run
from equipoise.safety.rules import T1_SPEED, SafetyParams, make_safety_params
from equipoise.worlds.twin.excitation import excitation

Array = npt.NDArray[np.float64]

MEASURING_TIME: Final = 1.0
"""Length of each measurement of the pre-flight, of round trips and of encoder samples [s]."""
T1_WORLD: Final = "twin:nominal"
"""World of the trials that precede a run in T1."""
T1_TRIALS: Final = 20
"""Number of trials on the twin before a run in T1."""
T1_DURATION: Final = 20.0
"""Length of each of these trials [s]."""
T1_SHARE: Final = 0.9
"""Minimum share of these trials that last [-]."""
MIN_SURVIVAL: Final = 185 / 200
"""Minimum share of the final round's trials that a policy lasts before it runs on a rig [-]."""
EXCITATION_SHARE: Final = 0.5
"""Share of the excitation of `deploy --excite` that a run uses [-]: behind a servo that is 30 ms
slower than assumed, its joints follow within the limit of the following error."""
SPEED_LIMIT: Final = "speed limit"
"""Name of the event with the flange's speed limit."""
PROLOGUE: Final = 600.0
"""Recorded duration of the phases before the balancing [s]."""
QUESTION_POLL_PERIOD: Final = 0.02
"""Polling period of typed input, robot and encoder while a question is open [s]: a quarter of a
stream's requests, and a lost link is noticed within this time plus the driver's timeout."""
WARM_UP_CALLS: Final = 20
"""Number of calls of the policy before the run; their median is compared with the limit."""
DRAIN_PERIOD: Final = 25
"""Number of ticks between two drains of the rings in virtual time."""

CHECKLIST: Final = (
    ("estop", "Is the E-stop in an operator's hand, and was it tested today?"),
    ("fence", "Is the fence closed, with nobody within reach of arm and pendulum?"),
    ("monitoring", "Is the robot's own monitoring of Cartesian and axis speed active?"),
    ("t1", "Has this policy run in T1 before, or is T1 selected now?"),
)
"""Safety questions before a run; the operator types the word to acknowledge each."""
ATTEMPTS: Final = 3
"""Number of times that a question before the run is asked; a mistyped word does not end it."""
STOP: Final = "stop"
"""Word that a signal becomes in the loop's input."""
ALONE: Final = "the operator's process has ended"
"""Word in the loop's input once the parent process has ended."""
DENIALS: Final = ("n", "no", STOP, ALONE)
"""Words that deny a question at once."""


@dataclass(frozen=True)
class RunRequest:
    """Policy, rig and options of a run."""

    policy: TaskPolicy
    """The policy."""
    actuator: Actuator
    """Identified response of the rig's arm."""
    settings: RigSettings
    """Contents of `rig.toml`."""
    robot: str
    """Address of the robot."""
    encoder: str | None
    """Address of the encoder; None where the robot's address includes one."""
    duration: float
    """Length of the balancing [s]."""
    t1: bool = False
    """Whether the speed limit of T1 holds."""
    dry_run: bool = False
    """Whether the run ends before the arm moves."""
    seed: int = 0
    """Seed of an emulated rig."""
    alternatives: tuple[Actuator, ...] = ()
    """Further actuators: with any, the run selects one of all from the move of the self-test."""
    identify: Callable[[Array, Array], Actuator] | None = None
    """Identification of the arm from an excitation before the lift, such as
    `equipoise.identification.actuator.identify_motion`; None without one."""
    anyway: bool = False
    """Whether a policy also runs that does not fit the identified arm."""

    def controller(self, counts_per_rev: int) -> ControllerParams:
        """Return the constants of the control step on the rig.

        Raises:
            ArmError: Home is a singular posture.
            SettingsError: The delay exceeds the controller's history.
        """
        policy, plant = self.policy, self.policy.settings.plant
        return make_controller_params(
            self.settings.described_arm,
            policy.settings,
            self.actuator,
            policy.pendulum.parameters(linearised=plant.linearised),
            h=policy.h,
            counts_per_rev=counts_per_rev,
        )

    def guard(self, counts_per_rev: int, max_speed: float = inf) -> SafetyParams:
        """Return the safety parameters of the rig.

        Args:
            counts_per_rev: Counts per revolution that its encoder reports.
            max_speed: Flange speed limit from the pre-flight [m/s].
        """
        arm = self.settings.described_arm
        return make_safety_params(
            arm,
            reaction=horizon(arm, self.actuator, 0.0),
            u_max=self.policy.u_max,
            h=self.policy.h,
            counts_per_rev=counts_per_rev,
            speed=max_speed,
            margin=radians(self.settings.position_margin_deg),
            speed_share=self.settings.speed_share,
            torque_share=self.settings.torque_share,
        )

    def responses(self, counts_per_rev: int, max_speed: float = inf) -> tuple[ArmResponse, ...]:
        """Return the responses of the arm of which the run selects one; empty without alternatives.

        Args:
            counts_per_rev: Counts per revolution that the rig's encoder reports.
            max_speed: Flange speed limit from the pre-flight [m/s].
        """
        carried = (self.actuator, *self.alternatives) if self.alternatives else ()
        return tuple(self.response(each, counts_per_rev, max_speed) for each in carried)

    def response(self, actuator: Actuator, counts_per_rev: int, max_speed: float) -> ArmResponse:
        """Return the response of the arm with an actuator; further arguments as of `responses`."""
        one = replace(self, actuator=actuator)
        parts = one.controller(counts_per_rev), one.guard(counts_per_rev, max_speed)
        return ArmResponse(actuator, *parts)

    def excitation(self, counts_per_rev: int, max_speed: float = inf) -> Excitation | None:
        """Return the excitation before the lift; None without one. Arguments as of `responses`.

        Raises:
            ArmError: Home is too close to a limit of a joint.
        """
        if self.identify is None:
            return None
        arm = self.settings.described_arm
        free = excitation(arm, period=self.policy.h / 2.0)
        free = arm.home_free + EXCITATION_SHARE * (free - arm.home_free)

        def respond(actuator: Actuator) -> tuple[ArmResponse, str]:
            text = describe_fit(self.policy, actuator)
            if not (fitting_actuators(self.policy, actuator) or self.anyway):
                raise InputError(text)
            return self.response(actuator, counts_per_rev, max_speed), text

        setpoints = np.array([arm.with_held(q) for q in free])
        return Excitation(setpoints, self.identify, respond)

    def parts(
        self,
        policy: Policy,
        clock: Callable[[], float],
        counts_per_rev: int,
        max_speed: float = inf,
    ) -> RunParts:
        """Return the parts of the run controller.

        Args:
            policy: The policy, as it decides tick by tick.
            clock: Clock for its computing time [s].
            counts_per_rev: Counts per revolution that the rig's encoder reports.
            max_speed: Flange speed limit from the pre-flight [m/s].
        """
        return RunParts(
            self.settings.described_arm,
            self.policy.settings.boxes,
            policy,
            self.duration,
            clock,
            self.responses(counts_per_rev, max_speed),
            self.excitation(counts_per_rev, max_speed),
        )

    def conditions(self) -> RunConditions:
        """Return the run conditions for the log.

        Raises:
            SettingsError: The twin is unknown.
        """
        policy, friction = self.policy, self.friction
        plant = policy.settings.plant
        return RunConditions(
            policy=policy.digest,
            policy_name=policy.name,
            world=self.robot,
            arm=self.settings.described_arm,
            pendulum=named(policy.pendulum.parameters(linearised=plant.linearised)),
            pendulum_digest=policy.pendulum.digest,
            friction=friction and friction.model_dump(mode="json"),
            h=policy.h,
            duration=self.duration,
            seed=self.seed,
            actuator=self.actuator.digest,
            alternatives=tuple(each.digest for each in self.alternatives),
            identifies=self.identify is not None,
            anyway=self.anyway,
            counts_per_rev=self.settings.counts_per_rev,
            settings=policy.settings,
            u_max=policy.u_max,
            rig=self.settings.model_dump(mode="json"),
            encoder=self.encoder,
            t1=self.t1,
            dry_run=self.dry_run,
            phases=PHASES,
        )

    def connect(self, **callbacks: Callable[..., None]) -> Rig:
        """Return the rig.

        Args:
            callbacks: `tell` and `attend` of `equipoise.rig.connection.connect`.

        Raises:
            InputError: An address is invalid.
            SettingsError: The twin is unknown.
        """
        return connect(
            self.robot,
            self.encoder,
            self.settings,
            self.policy.pendulum,
            seed=self.seed,
            period=self.policy.h / 2.0,
            **callbacks,
        )

    @property
    def friction(self) -> PivotFriction | None:
        """Dry friction and drag of a twin's pendulum; None on a robot.

        Raises:
            SettingsError: The twin is unknown.
        """
        world = world_of(self.robot)
        if world is None:
            return None
        return pivot_friction(self.policy.pendulum, read_world(world).settings)


class OperatorChannel:
    """Channel to the operators of a run: messages to all of them, and their typed lines."""

    def __init__(
        self,
        operators: Sequence[Operator],
        recorder: Recorder,
        clock: Clock,
        check_links: Callable[[], None],
    ) -> None:
        """Connect operators to a run.

        Args:
            operators: The operators; each may type.
            recorder: Rings for the log.
            clock: Time of the run before it moves.
            check_links: Raises `LinkError` if a device has failed; called while a question is open.
        """
        self._operators, self._recorder, self._clock = operators, recorder, clock
        self._check_links = check_links
        self._pending: list[str] = []

    def notify(self, event: OperatorMessage) -> None:
        """Send a message to all operators."""
        for operator in self._operators:
            operator.notify(event)

    def read_input(self) -> list[str]:
        """Return the pending typed lines, the oldest first."""
        lines, self._pending = self._pending, []
        return lines + [line for operator in self._operators for line in operator.read_input()]

    def tell(self, event: OperatorMessage) -> None:
        """Log a message, and send it to all operators."""
        push_event(self._recorder.event, self._clock.now(), event.name, event.answers, event.text)
        self.notify(event)

    def ask(self, event: OperatorMessage) -> str:
        """Send a question and wait for the answer.

        Returns:
            An expected answer, a denial, or the last of three other words; later lines stay
            pending.

        Raises:
            LinkError: A device has failed.
        """
        self.tell(event)
        for _ in range(ATTEMPTS - 1):
            word = self._read_word()
            if not event.answers or word in (*event.answers, *DENIALS):
                return word
            expected = " or ".join(event.answers)
            self.tell(event._replace(text=f"{word!r} is not {expected}. {event.text}"))
        return self._read_word()

    def _read_word(self) -> str:
        while not (lines := self.read_input()):
            until = self._clock.now() + QUESTION_POLL_PERIOD
            self._check_links()
            self._clock.wait_until(until)
        word, *self._pending = lines
        push_event(self._recorder.event, self._clock.now(), WORD_TYPED, (), word)
        return word.strip().lower()


def run_on_rig(
    request: RunRequest,
    rig: Rig,
    operators: Sequence[Operator],
    recorder: Recorder,
    *,
    measures: Callable[[], Sequence[Finding]] = tuple,
    executor: Executor | None = None,
    idle: Callable[[], None] = lambda: None,
    wrap: Callable[[TickHandler], TickHandler] = lambda handler: handler,
    supervise: Callable[[Policy, float], Policy] = lambda policy, _: policy,
) -> RunEnd:
    """Connect a rig, run a policy on it, bring the arm to rest, and disconnect the rig.

    Args:
        request: The run.
        rig: The rig, not connected yet.
        operators: Operators; each receives the messages and may type.
        recorder: Rings for the log.
        measures: Applies the real-time settings of this process, and returns their results.
        executor: Executor of long jobs (default: inline).
        idle: Called in each tick, e.g. to drain the rings.
        wrap: Wraps the tick handler; tests inject faults there.
        supervise: Wraps a policy without a kernel with a limit of its computing time [s].

    Raises:
        InputError: The policy does not fit the rig.
        OutsideError: A device fails.
    """
    period = request.policy.h / 2.0
    robot = GuardedRobot(rig.robot, request.guard(request.settings.counts_per_rev).limits, period)

    def check_links() -> None:
        """Request the joints, and drop the encoder's samples; each raises where its link failed."""
        robot.measured()
        rig.sensor.samples()

    waiting = DrainingClock(rig.clock, rig.sensor)
    operator = OperatorChannel(operators, recorder, waiting, check_links)
    tell = operator.tell
    try:
        tell(OperatorMessage(CONNECTING, f"Connecting to {request.robot}."))
        rig.sensor.connect()
        robot.connect()
        results, max_speed = preflight(request, rig, measures())
        for result in results:
            columns = (result.name, result.status, result.text, result.remedy)
            tell(OperatorMessage("finding", "\t".join(map(printable, columns))))
        require(check_fit(request.policy, request.actuator, request.settings))
        require(results, OutsideError)
        if max_speed < inf:
            text = f"{max_speed!r} m/s: the run stops when the flange reaches this speed."
            tell(OperatorMessage(SPEED_LIMIT, text))
        tell(OperatorMessage("notice", rig.plugin.failure))
        for word, question in CHECKLIST:
            said = operator.ask(OperatorMessage("checklist", f"{question} Type {word}.", (word,)))
            if said != word:
                return _unmoved(Outcome.OPERATOR, typed=printable(said))
        if request.dry_run:
            check_links()  # the answers may have been typed ahead
            return _unmoved(Outcome.DRY_RUN)
        question = "The arm will move to home at a tenth of its speed. Stand clear. Move? y or n"
        if (said := operator.ask(OperatorMessage("move", question, ("y", "n")))) != "y":
            return _unmoved(Outcome.OPERATOR, typed=printable(said))
        counts_per_rev = rig.sensor.counts_per_rev
        policy, kernel = tick_policy(request.policy), request.policy.kernel
        if kernel is None:
            policy = supervise(policy, POLICY_TIME_SHARE * request.policy.h)
        rig.sensor.samples()
        robot.start()
        began = rig.clock.now()
        recorder.reply.push(began, nan, robot.started_at, recorder.unknown, began)
        controller = RunController(
            request.parts(
                policy,
                rig.clock.now if kernel is None else lambda: 0.0,  # it takes the computer's time
                counts_per_rev,
                max_speed,
            ),
            request.response(request.actuator, counts_per_rev, max_speed),
            robot.started_at,
        )
        ending = run_loop(
            robot,
            rig.sensor,
            rig.clock,
            wrap(controller),
            recorder,
            operator,
            max_duration=PROLOGUE + request.duration,
            executor=executor,
            idle=idle,
        )
        if ending.stoppable:
            try:
                robot.stop()
            except LinkError as error:
                fault = End(Outcome.LINK_LOST, {"text": str(error)})
                ending = ending._replace(fault=fault, stoppable=False)
        return run_end(controller, ending)
    finally:
        robot.close()
        rig.sensor.close()


def preflight(
    request: RunRequest, rig: Rig, measures: Sequence[Finding] = ()
) -> tuple[list[Finding], float]:
    """Check a connected rig and a policy against each other; nothing moves.

    A bad result refuses the run; a warning goes into the log.

    Args:
        request: The run.
        rig: The rig.
        measures: Results of the real-time settings.

    Returns:
        Result of each check, and flange speed at which the run stops [m/s] (default: inf).

    Raises:
        LinkError: Robot or encoder does not answer.
    """
    policy, settings = request.policy, request.settings
    draining = DrainingClock(rig.clock, rig.sensor)
    trips = round_trips(rig.robot, draining, MEASURING_TIME)
    rule = rig.plugin.flange_speed
    max_speed = max_flange_speed(settings.described_arm, trips, request.t1, rule)
    posture = check_posture(rig.robot.measured(), settings)
    reading = listen(rig.sensor, rig.clock, MEASURING_TIME)
    results = [
        *check_fit(policy, request.actuator, settings),
        *check_link(trips),
        *check_speed(policy, max_speed),
        posture,
        *check_encoder(reading, settings),
        *measures,
    ]
    return results, max_speed


def check_request(request: RunRequest) -> None:
    """Validate a request without its rig; the pre-flight checks the rest.

    Raises:
        InputError: Addresses, policy, actuator and `rig.toml` do not fit each other.
        SettingsError: The twin is unknown.
    """
    check_addresses(request.robot, request.encoder)
    require(check_fit(request.policy, request.actuator, request.settings))


def describe_fit(policy: TaskPolicy, actuator: Actuator) -> str:
    """Return a sentence: an identified actuator, and the policies that fit it.

    Args:
        policy: The policy of the run.
        actuator: The identified actuator.
    """
    text, fits = f"The arm: {actuator.intervals}.", fitting_actuators(policy, actuator)
    if fits:
        return f"{text} It fits actuator {fits[0] + 1} of the policy's {len(policy.actuators)}."
    cure = "train one with equipoise train --actuator and the actuator of this run"
    if fitting_actuators(shipped_policy(), actuator):
        cure = "the shipped policy fits"
    return f"{text} It fits none of the actuators of {policy.name}; {cure}."


def require_survival(policy: TaskPolicy) -> None:
    """Refuse a table that lasted too few trials of the final round of its training.

    Raises:
        InputError: Fewer than `MIN_SURVIVAL` of them lasted.
    """
    final = policy.final_round if isinstance(policy, TabularPolicy) else None
    if final is None or final[0] >= MIN_SURVIVAL * final[1]:
        return
    survived, trials = final
    raise InputError(
        f"the policy lasted {survived:,} of {trials:,} trials in the final round of its training, "
        f"expected at least {MIN_SURVIVAL:.1%}; train more learners with equipoise train "
        "--learners, or run it with --anyway"
    )


def warm_up(request: RunRequest) -> None:
    """Run and time all code of a tick, to compile and load it before the stream starts.

    Raises:
        ArmError: Home is a singular posture.
        SettingsError: The delay exceeds the controller's history.
        InputError: The policy raises, returns no finite number, or takes too long.
    """
    settings, policy = request.settings, tick_policy(request.policy)
    arm, params = settings.described_arm, request.controller(settings.counts_per_rev)
    controller, took = Controller(arm, params, request.policy.settings.boxes), list[float]()
    policy.reset()
    for _ in range(WARM_UP_CALLS):
        controller.observe(0.0, 0.0, arm.home, 0.0)
        began = perf_counter()
        u = controller.decide(policy)
        took.append(perf_counter() - began)
        controller.command(u)
    FlangeKinematics(arm, params).pose(arm.home)
    typical, limit = median(took), POLICY_TIME_SHARE * request.policy.h
    if typical > limit:
        raise InputError(
            f"{request.policy.name} takes {1e3 * typical:.1f} ms, expected at most "
            f"{1e3 * limit:.1f} ms; make it faster"
        )


def _unmoved(outcome: Outcome, **evidence: float | str) -> RunEnd:
    return RunEnd(outcome=outcome, evidence=evidence, lasted=0.0)


def run_end(controller: RunController, ending: LoopResult) -> RunEnd:
    """Return the end of a run from the states of its controller and its loop."""
    end = controller.end or End(Outcome.FAULT, {"text": "the run ended without a cause"})
    if ending.fault is not None:
        outcome = ending.fault.outcome if ending.stoppable else Outcome.LINK_LOST
        end = ending.fault._replace(outcome=outcome)
    timing = ending.timing
    return RunEnd(
        outcome=end.outcome,
        evidence=dict(end.evidence),
        lasted=controller.lasted,
        stoppable=ending.stoppable,
        zero=controller.zero,
        identified=controller.identified,
        missed=timing.missed,
        late=timing.percentiles(timing.late),
        compute=timing.percentiles(timing.compute),
    )


def run_virtually(
    request: RunRequest,
    out: Path | None,
    operator: Operator | None = None,
    *,
    rig: Rig | None = None,
    wrap: Callable[[TickHandler], TickHandler] = lambda handler: handler,
) -> RunEnd:
    """Run on an emulated rig in this process, in virtual time.

    Args:
        request: The run; its robot is `twin:...`.
        out: Path of the log; None writes no log.
        operator: Operator besides the emulated one.
        rig: The rig, such as one with faults (default: that of the robot's address).
        wrap: Wraps the tick handler, see `run_on_rig`.

    Raises:
        InputError: The policy does not fit the rig.
        OutsideError: The log cannot be written.
    """
    rig = request.connect() if rig is None else rig
    recorder = Recorder(rig.robot.joints)
    writer = out and RunWriter(out, request.conditions(), rig.clock.now())
    ticks = count(1)

    def idle() -> None:
        if next(ticks) % DRAIN_PERIOD:
            return
        if writer is not None:
            writer.drain(recorder)
        else:
            recorder.take()

    operators = [one for one in (rig.operator, operator) if one is not None]
    end = RunEnd()
    try:
        end = run_on_rig(request, rig, operators, recorder, idle=idle, wrap=wrap)
        return end
    except EquipoiseError as error:
        end = RunEnd(evidence={"text": str(error)})
        raise
    finally:
        if writer is not None:
            writer.drain(recorder)
            writer.finish(rig.clock.now(), end)
            if writer.problem is not None:
                warning = OperatorMessage("warning", f"the log is incomplete: {writer.problem}")
                for one in operators:
                    one.notify(warning)


def rehearse_t1(
    request: RunRequest, *, trials: int = T1_TRIALS, duration: float = T1_DURATION
) -> None:
    """Run trials of a policy on the twin under the speed limit of T1, before a run on a robot.

    Args:
        request: The run.
        trials: Number of trials.
        duration: Length of each [s].

    Raises:
        InputError: The policy does not fit the rig, or too few trials last.
    """
    check_request(request)
    nominal = read_world(T1_WORLD)
    in_t1 = nominal.settings.model_copy(
        update={"t1": True, "counts_per_rev": request.settings.counts_per_rev}
    )
    ended = Counter[Outcome]()
    for seed in range(trials):
        run = simulate_run(
            request.policy,
            world=nominal._replace(settings=in_t1),
            actuator=None if request.alternatives else request.actuator,
            seed=seed,
            duration=duration,
        )
        ended[run.outcome] += 1
    least = ceil(T1_SHARE * trials)
    if ended[Outcome.LASTED] < least:
        others = ", ".join(f"{each} {n}" for each, n in ended.items() if each != Outcome.LASTED)
        raise InputError(
            f"on the twin in T1 this policy lasts {duration:g} s in {ended[Outcome.LASTED]} of "
            f"{trials} trials, expected {least} (ended by: {others}); train one for "
            f"this limit: equipoise train --set plant.max_speed={T1_SPEED:g}"
        )
