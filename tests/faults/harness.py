"""Harness of the faults: an emulated rig in virtual time, into which they are injected.

The run is that of `equipoise.rig.run`, with its loop, controller, safety rules and drivers;
cabinet, board, arm and operator are emulated. The harness records the bytes on the link and the
motion of the twin, so that the verdict does not rely on the run's own numbers and messages.
"""

from dataclasses import dataclass, field
from functools import partial
from math import inf
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

from equipoise import EquipoiseError, TabularPolicy, shipped_policy
from equipoise.control.control_step import SETPOINTS_PER_TICK
from equipoise.identification.actuator import identify_actuator
from equipoise.log.conditions import RunEnd
from equipoise.rig import run
from equipoise.rig.clocks import DrainingClock
from equipoise.rig.config import RigSettings
from equipoise.rig.connection import emulated_rig
from equipoise.rig.plugins import Session
from equipoise.rig.request import RunRequest
from equipoise.rig.run_controller import RunController
from equipoise.robots.encoder.sensor import LineEncoder
from equipoise.robots.kst.robot import KstRobot

WORLD = "twin:nominal"
START = "start"
"""Name of the event before the run."""


class Trigger(NamedTuple):
    """Time of an injection, counted from the first message of a name to the operator."""

    event: str  # such as `balancing`; or `start`
    after: float = 0.0  # [s]


class ReceivedMessage(NamedTuple):
    time: float  # [s]
    name: str
    text: str


class ArmObservation(NamedTuple):
    """Position of the twin's arm at one time."""

    time: float  # [s]
    x: float  # displacement of the flange [m]
    q: tuple[float, ...]  # the joints [rad]


@dataclass
class Scenario:
    """Conditions of a run; a fault may change them."""

    settings: RigSettings = field(default_factory=RigSettings)
    policy: TabularPolicy = field(default_factory=shipped_policy)
    duration: float = 3.0  # of the balancing [s]
    max_speed: float | None = None  # of the flange [m/s]
    identify: bool = False  # whether the arm is excited and identified before the lift
    start: str = "hand"
    runs: int = 1
    out: Path | None = None  # the log
    missed_messages: frozenset[str] = frozenset()  # of the emulated operator


class TransportTap:
    """Host's end of a link that records the bytes sent, and may damage those received."""

    def __init__(self, end, clock):
        self._end, self._clock = end, clock
        self.sent = []  # time and bytes of each write
        self.opened = 0  # connections
        self.damage = lambda data: data  # of received bytes

    def open(self):
        """Return itself, as a new connection."""
        self.opened += 1
        return self

    def write(self, data):
        self.sent.append((self._clock.now(), data))
        self._end.write(data)

    def read(self):
        return self.damage(self._end.read())

    def close(self):
        self._end.close()


class StallingClock:
    """Clock with prolonged waits, which stall the loop."""

    def __init__(self, clock):
        self._clock, self.now = clock, clock.now
        self.stalls = []  # additional durations of the next waits [s]

    def wait_until(self, time):
        self._clock.wait_until(time)
        if self.stalls:
            self._clock.wait_until(self._clock.now() + self.stalls.pop(0))


class FaultHarness:
    """Emulated rig, a run on it, and the record of both."""

    def __init__(self, scenario, *faults, words_after_stop=True, seed=0):
        """Set up the rig.

        Args:
            scenario: Conditions of the run.
            faults: Pairs of trigger and injection, which is called with this harness.
            words_after_stop: Whether answers and stops are typed after a stop.
            seed: Seed of the rig.
        """
        self.scenario = scenario
        pendulum = scenario.policy.pendulum
        self.rig = emulated_rig(WORLD, scenario.settings, pendulum, robot="kst", seed=seed)
        self.robot, self.sensor = self.rig.emulated
        self.bench, self.board = self.rig.bench, self.sensor.emulator
        clock = self.rig.clock
        self.clock = StallingClock(clock)
        self.robot_tap = TransportTap(self.robot.link.other, clock)
        self.encoder_tap = TransportTap(self.sensor.link.other, clock)
        self.ends = list[RunEnd]()  # of the runs of a series before the last
        self.messages, self.observations = list[ReceivedMessage](), list[ArmObservation]()
        self.held_at_start = False  # whether the hand held the pendulum when the policy began
        self.injected_at = None  # time of the first injection [s]
        self.stopped_at = inf  # time of the message that the arm stops [s]
        self.change_inputs = lambda inputs: inputs  # of the controller
        self.change_setpoint = lambda q, _: q  # given the time since the fault, up to the stop [s]
        self.undo = []  # actions that restore the process after the run
        self.disk_is_full = False  # the check of that fault reads the log
        self.typed = []  # lines that are typed next
        self._faults, self._words_after_stop = list(faults), words_after_stop
        self._due, self._each, self._ms = [], [], 0
        clock.attach(self._work)
        self._notice(START)

    def run(self) -> RunEnd:
        """Run the policy, and return the result; `Outcome.ERROR` for a refused run."""
        scenario = self.scenario
        settings, policy = scenario.settings, scenario.policy
        counts, sign = settings.counts_per_rev, settings.encoder_sign
        sensor = LineEncoder(self.encoder_tap.open, self.clock, counts_per_rev=counts, sign=sign)
        waiting, joints = DrainingClock(self.clock, sensor), self.rig.robot.joints
        robot = KstRobot(self.robot_tap.open, Session(waiting, self.clock), joints=joints)
        rig = self.rig._replace(robot=robot, sensor=sensor, clock=self.clock)
        notify, missed = rig.operator.notify, scenario.missed_messages
        rig.operator.notify = lambda event: event.name in missed or notify(event)
        links = ("kst://emulated", "serial://emulated")
        request = RunRequest(
            policy, policy.actuator, settings, *links, scenario.duration, scenario.max_speed,
            identify=identify_actuator if scenario.identify else None,
            start=scenario.start, runs=scenario.runs,
        )  # fmt: skip
        try:
            with patch.object(run, "RunController", partial(FaultyController, self)):
                ended = self.ends.append
                outcome = run.run_virtually(request, scenario.out, self, rig=rig, ended=ended)
        except EquipoiseError as error:
            self.messages.append(ReceivedMessage(self.clock.now(), "error", str(error)))
            outcome = RunEnd(evidence={"text": str(error)})
        finally:
            while self.undo:
                self.undo.pop()()
        self.clock.wait_until(self.clock.now() + 0.5)
        return outcome

    def after(self, delay, act):
        """Call `act` after a delay [s]."""
        self._due.append((self.clock.now() + delay, act))

    def each(self, act):
        """Call `act` each millisecond from now on, with the time since now [s]."""
        begin = self.clock.now()
        self._each.append(lambda: act(self.clock.now() - begin))

    # A second operator: it receives every message and types the input of the fault.

    def notify(self, event):
        if event.name == "balancing":
            self.held_at_start = self.bench.hand.holds
        self.messages.append(ReceivedMessage(self.clock.now(), event.name, event.text))
        self._notice(event.name)
        if event.name == "stopping" and self._words_after_stop:
            # No input may move anything after a stop.
            for delay, word in ((0.05, "y"), (0.1, ""), (0.2, "ok"), (0.3, "stop")):
                self.after(delay, partial(self.typed.append, word))

    def read_input(self):
        typed, self.typed[:] = list(self.typed), []
        return typed

    def _notice(self, name):
        for fault in [fault for fault in self._faults if fault[0].event == name]:
            self._faults.remove(fault)
            trigger, inject = fault
            self.after(trigger.after, partial(self._inject, inject))

    def _inject(self, inject):
        if self.injected_at is None:
            self.injected_at = self.clock.now()
        inject(self)

    def _work(self, now):
        due = [act for time, act in self._due if time <= now + 1e-9]
        self._due = [later for later in self._due if later[0] > now + 1e-9]
        for act in (*due, *self._each):
            act()
        self._ms += 1
        if self._ms % 2 == 0:
            q = tuple(self.bench.twin.data.qpos[: self.bench.joints].tolist())
            self.observations.append(ArmObservation(now, float(self.bench.twin.truth().x), q))
        if self._ms == 90_000 * self.scenario.runs:  # the longest run
            self.typed.append("stop")


class FaultyController(RunController):
    """Controller of a run with faulty inputs and setpoints."""

    def __init__(self, harness, *args, **options):
        super().__init__(*args, **options)
        self._harness = harness

    def tick(self, now, inputs):
        harness = self._harness
        output = super().tick(now, harness.change_inputs(inputs))
        if harness.injected_at is None:
            return output
        step = self.h / SETPOINTS_PER_TICK
        if any(event.name == "stopping" for event in output.events):
            # After the stop the motion is the run's own.
            harness.stopped_at = min(now - step, harness.stopped_at)
        setpoints = []
        for i, q in enumerate(output.setpoints):
            time = min(now + i * step, harness.stopped_at)
            setpoints.append(harness.change_setpoint(tuple(q), time - harness.injected_at))
        return output._replace(setpoints=tuple(setpoints))
