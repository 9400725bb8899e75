"""Harness of the faults: an emulated rig in virtual time, into which they are injected.

The run is that of `equipoise.rig.run`, with its loop, controller, safety rules and drivers;
cabinet, board, arm and operator are emulated. The harness records the bytes on the link and the
motion of the twin, so that the verdict does not rely on the run's own numbers and messages.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from math import inf
from pathlib import Path
from typing import Any, Final, NamedTuple

from equipoise.control.control_step import SETPOINTS_PER_TICK
from equipoise.control.policy import TabularPolicy, shipped_policy
from equipoise.control.ticks import OperatorMessage, TickInputs, TickOutput
from equipoise.errors import EquipoiseError
from equipoise.identification.actuator import identify_actuator
from equipoise.logs.conditions import RunEnd
from equipoise.model.worlds import pendulum_on, read_world
from equipoise.rig.clocks import DrainingClock
from equipoise.rig.config import RigSettings
from equipoise.rig.connection import EmulatedRig, emulated_rig
from equipoise.rig.interfaces import Clock, Transport
from equipoise.rig.request import RunRequest
from equipoise.rig.run import run_virtually

WORLD: Final = "twin:nominal"
"""World of all faults."""
ROBOT: Final = "kst"
"""Scheme of the emulated robot; the faults are those of its server and its bytes."""
BALANCE_TIME: Final = 3.0
"""Duration of the balancing in a run in virtual time [s]."""
SETTLING_TIME: Final = 0.5
"""Duration of the observation after a run [s]."""
OBSERVATION_TICKS: Final = 2
"""Time between two observations of the twin [ms]."""
START: Final = "start"
"""Name of the event before the run."""
MAX_RUN_TIME: Final = 90.0
"""Time limit of a run [s]; then a key stops it."""

Setpoint = tuple[float, ...]


class Trigger(NamedTuple):
    """Time of an injection, counted from the first message of a name to the operator."""

    event: str
    """Name of the message, e.g. `balancing`; or `start`."""
    after: float = 0.0
    """Delay after it [s]."""


class ReceivedMessage(NamedTuple):
    """Message that the operator received."""

    time: float
    """Time [s]."""
    name: str
    """Name of the message."""
    text: str
    """Its sentence."""


class ArmObservation(NamedTuple):
    """Position of the twin's arm at one time."""

    time: float
    """Time [s]."""
    x: float
    """Displacement of the flange [m]."""
    q: tuple[float, ...]
    """The joints [rad]."""


@dataclass
class Scenario:
    """Conditions of a run; a fault may change them."""

    settings: RigSettings = field(default_factory=RigSettings)
    """Contents of `rig.toml`."""
    policy: TabularPolicy = field(default_factory=shipped_policy)
    """The policy."""
    duration: float = BALANCE_TIME
    """Time to balance [s]."""
    t1: bool = False
    """Whether the speed limit of T1 holds."""
    identify: bool = False
    """Whether the arm is excited and identified before the lift."""
    out: Path | None = None
    """The log."""
    missed_messages: frozenset[str] = frozenset()
    """Names of messages that the emulated operator misses."""


class TransportTap:
    """Host's end of a link that records the bytes sent, and may damage those received."""

    def __init__(self, end: Transport, clock: Clock) -> None:
        """Tap an end of a link."""
        self._end, self._clock = end, clock
        self.sent: list[tuple[float, bytes]] = []
        """Time and bytes of each write."""
        self.opened = 0
        """Number of connections."""
        self.damage: Callable[[bytes], bytes] = lambda data: data
        """Damages received bytes."""

    def open(self) -> Transport:
        """Return itself, as a new connection."""
        self.opened += 1
        return self

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self.sent.append((self._clock.now(), data))
        self._end.write(data)

    def read(self) -> bytes:
        """Return the bytes received."""
        return self.damage(self._end.read())

    def close(self) -> None:
        """Close."""
        self._end.close()


class StallingClock:
    """Clock with prolonged waits, which stall the loop."""

    def __init__(self, clock: Clock) -> None:
        """Wrap a clock."""
        self._clock = clock
        self.stalls: list[float] = []
        """Additional durations of the next waits [s]."""

    def now(self) -> float:
        """Return the time [s]."""
        return self._clock.now()

    def wait_until(self, time: float) -> None:
        """Wait until a time [s], and longer if a stall is due."""
        self._clock.wait_until(time)
        if self.stalls:
            self._clock.wait_until(self._clock.now() + self.stalls.pop(0))


class FaultHarness:
    """Emulated rig, a run on it, and the record of both."""

    def __init__(
        self,
        scenario: Scenario,
        *faults: tuple[Trigger, Callable[["FaultHarness"], object]],
        words_after_stop: bool = True,
        seed: int = 0,
    ) -> None:
        """Set up the rig.

        Args:
            scenario: Conditions of the run.
            faults: Time and injection of each fault.
            words_after_stop: Whether answers and stops are typed after a stop.
            seed: Seed of the rig.
        """
        self.scenario = scenario
        """Conditions of the run."""
        world = read_world(WORLD)
        pendulum = pendulum_on(scenario.policy.pendulum, world.settings)
        self.parts: EmulatedRig = emulated_rig(
            world, scenario.settings, pendulum, robot=ROBOT, seed=seed
        )
        """Drivers, simulated rig, server, board and links."""
        self.bench, self.board = self.parts.bench, self.parts.sensor.emulator
        """Simulated rig, and emulator of the encoder's board."""
        clock = self.parts.rig.clock
        self.clock = StallingClock(clock)
        """Clock of the run."""
        self.robot_tap = TransportTap(self.parts.robot.link.other, clock)
        """Host's end of the link to the robot."""
        self.encoder_tap = TransportTap(self.parts.sensor.link.other, clock)
        """Host's end of the link to the encoder."""
        self.messages: list[ReceivedMessage] = []
        """Messages that the operator received."""
        self.observations: list[ArmObservation] = []
        """Observations of the twin."""
        self.held_at_start = False
        """Whether the hand held the pendulum when the policy began."""
        self.injected_at: float | None = None
        """Time of the first injection [s]; None before it."""
        self.stopped_at = inf
        """Time of the message that the arm stops [s]."""
        self.change_inputs: Callable[[TickInputs], TickInputs] = lambda inputs: inputs
        """Changes the inputs of the controller."""
        self.change_setpoint: Callable[[Setpoint, float], Setpoint] = lambda q, _: q
        """Changes a setpoint, given the time since the fault [s], which ends at the stop."""
        self.undo: list[Callable[[], Any]] = []
        """Actions that restore the process after the run."""
        self.disk_is_full = False
        """Whether a fault keeps the log from its end; the check of that fault reads the log."""
        self.typed: list[str] = []
        """Lines that are typed next."""
        self._faults, self._words_after_stop = list(faults), words_after_stop
        self._due: list[tuple[float, Callable[[], Any]]] = []
        self._each: list[Callable[[], Any]] = []
        self._ms = 0
        clock.attach(self._work)
        self._notice(START)

    def run(self) -> RunEnd:
        """Run the policy, and return the result; `Outcome.ERROR` for a refused run."""
        scenario, parts = self.scenario, self.parts
        sensor = parts.sensor.driver(self.encoder_tap.open, self.clock)
        rig = parts.rig._replace(
            robot=parts.robot.driver(self.robot_tap.open, DrainingClock(self.clock, sensor)),
            sensor=sensor,
            clock=self.clock,
        )
        rig.operator.ignored = scenario.missed_messages
        known = {name: getattr(scenario, name) for name in ("policy", "settings", "duration", "t1")}
        known |= {"robot": f"{ROBOT}://emulated", "encoder": "serial://emulated"}
        known["identify"] = identify_actuator if scenario.identify else None
        actuator = scenario.policy.actuator
        request = RunRequest(**known, actuator=actuator)
        try:
            wrap = partial(FaultyTickHandler, self)
            outcome = run_virtually(request, scenario.out, self, rig=rig, wrap=wrap)
        except EquipoiseError as error:
            self.messages.append(ReceivedMessage(self.clock.now(), "error", str(error)))
            outcome = RunEnd(evidence={"text": str(error)})
        finally:
            while self.undo:
                self.undo.pop()()
        self.clock.wait_until(self.clock.now() + SETTLING_TIME)
        return outcome

    # Injections.

    def after(self, delay: float, act: Callable[[], Any]) -> None:
        """Call `act` after a delay [s]."""
        self._due.append((self.clock.now() + delay, act))

    def each(self, act: Callable[[float], Any]) -> None:
        """Call `act` each millisecond from now on, with the time since now [s]."""
        begin = self.clock.now()
        self._each.append(lambda: act(self.clock.now() - begin))

    # A second operator: it receives every message and types the input of the fault.

    def notify(self, event: OperatorMessage) -> None:
        """Record a message."""
        if event.name == "balancing":
            self.held_at_start = self.bench.hand.holds
        self.messages.append(ReceivedMessage(self.clock.now(), event.name, event.text))
        self._notice(event.name)
        if event.name == "stopping" and self._words_after_stop:
            # No input may move anything after a stop.
            for delay, word in ((0.05, "y"), (0.1, ""), (0.2, "ok"), (0.3, "stop")):
                self.after(delay, lambda word=word: self.typed.append(word))

    def read_input(self) -> list[str]:
        """Return the typed lines."""
        typed, self.typed = self.typed, []
        return typed

    def _notice(self, name: str) -> None:
        for fault in [each for each in self._faults if each[0].event == name]:
            self._faults.remove(fault)
            trigger, inject = fault
            self.after(trigger.after, partial(self._inject, inject))

    def _inject(self, inject: Callable[["FaultHarness"], object]) -> None:
        if self.injected_at is None:
            self.injected_at = self.clock.now()
        inject(self)

    def _work(self, now: float) -> None:
        due = [act for time, act in self._due if time <= now + 1e-9]
        self._due = [later for later in self._due if later[0] > now + 1e-9]
        for act in (*due, *self._each):
            act()
        self._ms += 1
        if self._ms % OBSERVATION_TICKS == 0:
            q = tuple(self.bench.twin.kernel.bodies.qpos[: self.bench.joints].tolist())
            self.observations.append(ArmObservation(now, float(self.bench.truth().x), q))
        if round(1e3 * now) == round(1e3 * MAX_RUN_TIME):
            self.typed.append("stop")


class FaultyTickHandler:
    """Tick handler with faulty inputs and setpoints."""

    def __init__(self, harness: FaultHarness, handler: Any) -> None:
        self._harness, self._handler = harness, handler

    @property
    def h(self) -> float:
        """Time between ticks [s]."""
        return self._handler.h

    def tick(self, now: float, inputs: TickInputs) -> TickOutput:
        """Run a tick with the faults applied to its inputs and its setpoints."""
        harness = self._harness
        output = self._handler.tick(now, harness.change_inputs(inputs))
        if harness.injected_at is None:
            return output
        step = self.h / SETPOINTS_PER_TICK
        if any(event.name == "stopping" for event in output.events):
            # After the stop the motion is the run's own.
            harness.stopped_at = min(now - step, harness.stopped_at)
        times = (min(now + i * step, harness.stopped_at) for i in range(len(output.setpoints)))
        setpoints = (
            harness.change_setpoint(tuple(q), time - harness.injected_at)
            for q, time in zip(output.setpoints, times, strict=True)
        )
        return output._replace(setpoints=tuple(setpoints))
