"""The stage of a rehearsal: an emulated rig in virtual time, on which anything can be broken.

The course is the run's own (`equipoise.deployment.rig`), with its loop, heart, guards and drivers;
cabinet, board, arm and operator are emulated. What is sent is taken down as bytes at the link, and
what really moves as the twin knows it, so that a fault is judged by neither the run's own numbers
nor its own words.
"""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from math import inf
from pathlib import Path
from typing import Any, Final, NamedTuple

from equipoise.control.policy import TabularPolicy, shipped_policy
from equipoise.control.ticks import OperatorMessage, TickHandler, TickInputs, TickOutput
from equipoise.deployment.rig import RunRequest, RunResult, run_rig_virtually
from equipoise.devices.clocks import VirtualClock
from equipoise.devices.encoder.sensor import LineEncoder
from equipoise.devices.interfaces import Clock, Transport
from equipoise.devices.kuka.robot import KstRobot
from equipoise.devices.twin.emulated_operator import EmulatedOperator
from equipoise.errors import EquipoiseError
from equipoise.model.sim_configs import pendulum_on, read_world
from equipoise.rigs import DrainingClock, EmulatedRig, Rig, RigSettings, emulated_rig

WORLD: Final = "twin:nominal"
BALANCED: Final = 3.0
"""How long a run of a rehearsal balances if nothing stops it [s]."""
AFTERWARDS: Final = 0.5
"""The twin is watched for so long after a run [s]."""
LOOKS: Final = 2
"""Milliseconds between two looks at the twin."""
START: Final = "start"
"""What happens before anything else."""
LONGEST: Final = 90.0
"""A run that lasts longer than this is stopped by a key [s]: it hangs."""

Setpoint = tuple[float, ...]


class Trigger(NamedTuple):
    """When something goes wrong, counted from when the operator is first told of something."""

    event: str
    """What the operator is told, e.g. `balancing`; or `start`."""
    after: float = 0.0
    """How long after that [s]."""


class ExpectedNotice(NamedTuple):
    """What the operator was told, and when."""

    time: float
    """When [s]."""
    name: str
    """In a word."""
    text: str
    """The sentence."""


class RunObservation(NamedTuple):
    """What the twin did at a moment."""

    time: float
    """When [s]."""
    x: float
    """Displacement of the flange [m]."""
    q: tuple[float, ...]
    """The joints [rad]."""


@dataclass
class Scenario:
    """What a run begins with; a fault may change it."""

    settings: RigSettings = field(default_factory=RigSettings)
    """What `rig.toml` says."""
    policy: TabularPolicy = field(default_factory=shipped_policy)
    """The policy."""
    duration: float = BALANCED
    """How long it shall balance [s]."""
    t1: bool = False
    """Whether T1's speed holds."""
    out: Path | None = None
    """The log."""
    unheard: frozenset[str] = frozenset()
    """Events that the emulated operator does not hear of."""


class TransportTap:
    """The host's end of a link: keeps what is sent, and may spoil what comes."""

    def __init__(self, end: Transport, clock: Clock) -> None:
        """Stand before an end."""
        self._end, self._clock = end, clock
        self.sent: list[tuple[float, bytes]] = []
        """What was sent, and when."""
        self.opened = 0
        """How often a connection was made."""
        self.spoil: Callable[[bytes], bytes] = lambda data: data
        """What becomes of bytes that come."""

    def open(self) -> Transport:
        """Return itself, as a new connection."""
        self.opened += 1
        return self

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self.sent.append((self._clock.now(), data))
        self._end.write(data)

    def read(self) -> bytes:
        """Return what came."""
        return self.spoil(self._end.read())

    def close(self) -> None:
        """Close."""
        self._end.close()


class StallingClock:
    """A clock on which the loop can be held up: a wait that takes longer than it should."""

    def __init__(self, clock: Clock) -> None:
        """Be that clock."""
        self._clock = clock
        self.held_up: list[float] = []
        """By how much the next waits are too long [s]."""

    def now(self) -> float:
        """Return the time [s]."""
        return self._clock.now()

    def wait_until(self, time: float) -> None:
        """Wait, and then too long if that is due."""
        self._clock.wait_until(time)
        if self.held_up:
            self._clock.wait_until(self._clock.now() + self.held_up.pop(0))


class BrokenRunError(EquipoiseError):
    """A run ended with an exception that nobody meant."""


class FaultHarness:
    """An emulated rig, a run on it, and what is seen of both."""

    def __init__(
        self, scene: Scenario, moment: Trigger, inject: Callable[["FaultHarness"], None]
    ) -> None:
        """Set the stage.

        Args:
            scene: What the run begins with.
            moment: When something goes wrong.
            inject: Makes it go wrong.
        """
        self.scene = scene
        """What the run begins with."""
        world = read_world(WORLD)
        pendulum = pendulum_on(scene.policy.pendulum, world.settings)
        self.parts: EmulatedRig = emulated_rig(world, scene.settings, pendulum)
        """Bench, cabinet, board and links."""
        clock = self.parts.rig.clock
        self.clock = StallingClock(clock)
        """The run's."""
        self.robot_wire = TransportTap(self.parts.robot_link.other, clock)
        """The host's end of the link to the robot."""
        self.encoder_wire = TransportTap(self.parts.encoder_link.other, clock)
        """... and to the encoder."""
        self.told: list[ExpectedNotice] = []
        """What the operator was told."""
        self.looks: list[RunObservation] = []
        """What the twin did."""
        self.held_at_start = False
        """Whether the hand still held the pendulum when the policy began."""
        self.broken_at: float | None = None
        """When it went wrong [s]; none where it did not."""
        self.stopped_at = inf
        """When the operator was told that the arm stops [s]."""
        self.change_inputs: Callable[[TickInputs], TickInputs] = lambda inputs: inputs
        """What becomes of what the heart is given."""
        self.change_setpoint: Callable[[Setpoint, float], Setpoint] = lambda q, _: q
        """What becomes of a setpoint, so long after the fault [s]; time stops at the stop."""
        self.undo: list[Callable[[], Any]] = []
        """What has to be put right after the run."""
        self.typed: list[str] = []
        """What somebody types."""
        self._moment, self._inject = moment, inject
        self._due: list[tuple[float, Callable[[], Any]]] = []
        self._each: list[Callable[[float], Any]] = []
        self._ms = 0
        if isinstance(clock, VirtualClock):
            clock.attach(self._work)
        self._notice(START)

    def run(self) -> RunResult | EquipoiseError:
        """Run the policy, and return what came of it."""
        scene, parts = self.scene, self.parts
        sensor = LineEncoder(
            self.encoder_wire.open,
            self.clock,
            counts_per_rev=scene.settings.counts_per_rev,
            sign=scene.settings.encoder_sign,
        )
        robot = KstRobot(self.robot_wire.open, DrainingClock(self.clock, sensor))
        if isinstance(operator := parts.rig.operator, EmulatedOperator):
            operator.ignored = scene.unheard
        rig = Rig(robot, sensor, self.clock, operator)
        request = RunRequest(
            policy=scene.policy,
            actuator=scene.policy.actuator,
            settings=scene.settings,
            robot="kst://emulated",
            encoder="serial://emulated",
            duration=scene.duration,
            t1=scene.t1,
            dry_run=False,
            seed=0,
        )
        try:
            outcome = run_rig_virtually(
                request, rig, scene.out, self, around=lambda heart: FaultyTickHandler(heart, self)
            )
        except EquipoiseError as error:
            self.told.append(ExpectedNotice(self.clock.now(), "error", str(error)))
            outcome = error
        except Exception as error:  # a defect of the run, which is what a rehearsal looks for
            outcome = BrokenRunError(f"the run broke with {type(error).__name__}: {error}")
        finally:
            while self.undo:
                self.undo.pop()()
        self.clock.wait_until(self.clock.now() + AFTERWARDS)
        return outcome

    # What may be done to it.

    def after(self, delay: float, act: Callable[[], Any]) -> None:
        """Do something later [s]."""
        self._due.append((self.clock.now() + delay, act))

    def each(self, act: Callable[[float], Any]) -> None:
        """Do something in each millisecond from now on; it is given the time since now [s]."""
        begin = self.clock.now()
        self._each.append(lambda now: act(now - begin))

    # The operator's part: it hears all, and types what it is given to type.

    def notify(self, event: OperatorMessage) -> None:
        """Take note of an event."""
        if event.name == "balancing":
            self.held_at_start = self.parts.bench.hand.holds
        self.told.append(ExpectedNotice(self.clock.now(), event.name, event.text))
        self._notice(event.name)
        if event.name == "stopping":
            # Whatever is typed then shall move nothing any more.
            for delay, word in ((0.05, "y"), (0.1, ""), (0.2, "ok"), (0.3, "stop")):
                self.after(delay, lambda word=word: self.typed.append(word))

    def read_input(self) -> list[str]:
        """Return what is typed."""
        typed, self.typed = self.typed, []
        return typed

    def _notice(self, name: str) -> None:
        if name == self._moment.event and self.broken_at is None:
            self._moment = self._moment._replace(event="")
            self.after(self._moment.after, self._break)

    def _break(self) -> None:
        self.broken_at = self.clock.now()
        self._inject(self)

    def _work(self, now: float) -> None:
        due = [act for time, act in self._due if time <= now + 1e-9]
        self._due = [later for later in self._due if later[0] > now + 1e-9]
        for act in (*due, *(lambda each=each: each(now) for each in self._each)):
            act()
        self._ms += 1
        if self._ms % LOOKS == 0:
            bench = self.parts.bench
            q = tuple(bench.twin.kernel.bodies.qpos[: bench.joints].tolist())
            self.looks.append(RunObservation(now, float(bench.truth().x), q))
        if round(1e3 * now) == round(1e3 * LONGEST):
            self.typed.append("stop")


class FaultyTickHandler:
    """A heart whose inputs and setpoints change on their way, once it is broken."""

    def __init__(self, heart: TickHandler, stage: FaultHarness) -> None:
        self._heart, self._stage = heart, stage

    @property
    def h(self) -> float:
        """Time between ticks [s]."""
        return self._heart.h

    def tick(self, now: float, inputs: TickInputs) -> TickOutput:
        """Decide, with the faults of the scenario applied to inputs and output."""
        stage = self._stage
        output = self._heart.tick(now, stage.change_inputs(inputs))
        if stage.broken_at is None:
            return output
        step = self.h / len(output.setpoints)
        if any(event.name == "stopping" for event in output.events):
            # From here on their motion is the run's own.
            stage.stopped_at = min(now - step, stage.stopped_at)
        setpoints = tuple(
            stage.change_setpoint(
                tuple(q), min(now + place * step, stage.stopped_at) - stage.broken_at
            )
            for place, q in enumerate(output.setpoints)
        )
        return output._replace(setpoints=setpoints)


@contextmanager
def instead(owner: Any, name: str, value: Any) -> Generator[None]:
    """Let an attribute be another one for a while."""
    before = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)


def on(scene: Scenario, **changes: Any) -> Scenario:
    """Return a scene with some of it changed."""
    return replace(scene, **changes)
