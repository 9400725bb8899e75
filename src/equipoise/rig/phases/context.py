"""What the phases of a run share: its request, its measurements, its motion, its latch."""

from collections.abc import Callable, Sequence
from functools import partial
from math import inf
from typing import TYPE_CHECKING, Any, Final

from equipoise.control.controller import Controller, FlangeKinematics
from equipoise.control.minimum_jerk import Path
from equipoise.control.policy import tick_policy
from equipoise.control.ticks import Job, OperatorMessage, Sample, TickRecord
from equipoise.model.actuator import Actuator
from equipoise.outcomes import End, Phase, describe
from equipoise.rig.phases.readings import ArmReadings, EncoderReadings, SetpointHistory
from equipoise.rig.request import ArmResponse, RunRequest
from equipoise.safety.rules import FROM_MEASURED, STOP_DECELERATION

if TYPE_CHECKING:
    from equipoise.rig.phases.stopping import Stopping

Setpoints = tuple[tuple[float, ...], ...]
"""Setpoints of a tick [rad]: now, and h / 2 later; empty while nothing is to be sent."""

RESTART_ACCELERATION: Final = 0.5 * STOP_DECELERATION
"""Additional acceleration of the flange after a pause of the setpoints, until it has the speed of
before [m/s^2]: with the policy's largest acceleration that of a stop."""
LINK_STALLED: Final = "The robot's link stalled; `equipoise rig doctor` looks for the cause."
"""Warning of a stall of the link."""


class RunPhase:
    """A phase of a run."""

    kind: Phase
    """Name of the phase, in the log."""
    moves: bool = False
    """Whether the arm moves, so that Enter stops, too."""

    def __init__(self, run: "RunContext") -> None:
        """Create a phase of a run; it begins with `enter`."""
        self.run = run
        self.ticks = 0
        """Number of ticks of the phase so far."""

    @property
    def on_track(self) -> bool:
        """Whether the rules of the flange apply."""
        return True

    def enter(self) -> None:
        """Begin the phase: tell the operator, or ask."""

    def tick(self, now: float) -> Setpoints:
        """Return the setpoints of a tick at a time [s]."""
        raise NotImplementedError

    def take_sample(self, sample: Sample) -> None:
        """Use a new sample of the encoder, which the readings hold already."""

    def take_joints(self, time: float, q: Sequence[float]) -> None:
        """Use newly measured joints [rad], and the time of their measurement [s]."""

    def note_sent(self, time: float, q: Sequence[float]) -> None:
        """Use a setpoint [rad] that is sent at a time [s]."""

    def begin_anew(self, missed: int, unsent: bool) -> None:
        """Begin the motion anew from rest at the run's `q`.

        Args:
            missed: Number of missed ticks.
            unsent: Whether a setpoint of the last tick was not sent.
        """

    def wait(self, now: float) -> Setpoints:
        """Send nothing while the link stands still: the arm comes to rest at its last target."""
        self.run.begin_anew(0, 0, LINK_STALLED)
        self.ticks -= 1  # its path waits, too
        return ()


class RunContext:
    """State that the phases of a run share; the run controller sets its first phases."""

    phase: RunPhase
    """The phase."""
    stopping: "Stopping"
    """Phase after a stop."""
    before: RunPhase
    """Phase before the stop."""

    def __init__(
        self,
        request: RunRequest,
        q: Sequence[float],
        *,
        counts_per_rev: int,
        max_speed: float = inf,
        clock: Callable[[], float] = lambda: 0.0,
    ) -> None:
        """Begin with an arm that rests at the measured joints.

        Args:
            request: The run.
            q: Measured joints, all of them [rad].
            counts_per_rev: Counts per revolution that the rig's encoder reports.
            max_speed: Flange speed limit from the pre-flight [m/s].
            clock: Clock for the computing time of a policy in Python [s]; the default gives zero.

        Raises:
            ArmError: Home is too close to a limit of a joint for the excitation.
        """
        self.request, self.arm = request, request.settings.described_arm
        self.policy = tick_policy(request.policy)
        # A kernel takes the computer's time, which virtual time does not show.
        self.clock = clock if request.policy.kernel is None else lambda: 0.0
        self.respond = partial(request.response, counts_per_rev=counts_per_rev, max_speed=max_speed)
        """Returns what follows from an actuator on this rig."""
        self.response = response = self.respond(request.actuator)
        self.excitation = request.excitation()
        """Motion before the lift that identifies the arm, as of `RunRequest.excitation`."""
        self.controller = Controller(self.arm, response.params, request.policy.settings.boxes)
        """Control step with the response in use."""
        self.h, self.flange = response.params.h, FlangeKinematics(self.arm, response.params)
        self.encoder = EncoderReadings(response.params.resolution)
        self.joints = ArmReadings(q, response.safety.limits)
        self.sent = SetpointHistory(q)
        self.q, self.dq = tuple(q), (0.0,) * len(q)
        """Commanded joints at the end of the tick [rad], and their velocities [rad/s]."""
        self.lost_speed = 0.0
        """Speed of the flange that a pause has taken, not yet given back [m/s]."""
        self.record = TickRecord()
        self.events: list[OperatorMessage] = []
        self.answers: tuple[str, ...] = ()
        """Answers that the phase expects now."""
        self.answer: str | None = None
        """The answer of this tick."""
        self.pressed = False
        """Whether the pendulum's button was pressed since the phase began, or since it asked."""
        self.result: Any = None
        """Result of the job, in the tick in which it comes."""
        self.job: Job | None = None
        """Job that begins with this tick."""
        self.end: End | None = None
        """Cause of the latched stop, the first one."""
        self.from_measured = False
        """Whether any cause so far shows that the arm is not at its setpoint."""
        self.forbidden = ""
        """Why the target must not go back in this tick; empty for no reason."""
        self.key_after_stop = False
        """Whether anything was typed after the stop."""
        self.began: float | None = None
        """Time at which the policy began to act [s]."""
        self.ended: float | None = None
        """Time at which it ended [s]."""
        self.identified: Actuator | None = None
        """Actuator that the excitation has identified."""
        self._warnings = set[str]()

    def notify(self, name: str, text: str) -> None:
        """Send a message to the operator and to the log."""
        self.events.append(OperatorMessage(name, text))

    def warn_once(self, text: str) -> None:
        """Send a warning, the first time only."""
        if text not in self._warnings:
            self._warnings.add(text)
            self.notify("warning", text)

    def ask(self, name: str, text: str, answers: tuple[str, ...]) -> None:
        """Ask the operator."""
        self.answers, self.answer = answers, None
        self.events.append(OperatorMessage(name, text, answers))

    def go(self, phase: RunPhase) -> None:
        """Begin another phase.

        Raises:
            RuntimeError: The run has stopped; the guard then brings the arm to rest.
        """
        if self.end is not None:
            raise RuntimeError(f"{phase.kind.value} may not follow a stop")
        self._begin(phase)
        phase.enter()

    def stop(self, end: End) -> None:
        """Latch a stop; the ramp begins with this tick's setpoints."""
        self.from_measured = self.from_measured or end.outcome in FROM_MEASURED
        if self.end is not None:
            return
        self.end = end
        if self.began is not None:
            self.ended = self.began + self.phase.ticks * self.h
        self.before = self.phase
        self._begin(self.stopping)
        self.notify("stopping", describe(end))

    def _begin(self, phase: RunPhase) -> None:
        self.phase, self.answers, self.pressed = phase, (), False

    def stop_and_rest(self, end: End, now: float) -> Setpoints:
        """Latch a stop; return the first setpoints of the ramp."""
        self.stop(end)
        return self.phase.tick(now)

    def begin_anew(self, missed: int, unsent: int, warning: str) -> None:
        """Begin the motion of the phase anew from the last setpoint sent, where the arm rests.

        Args:
            missed: Number of missed ticks.
            unsent: Number of setpoints of the last tick that were not sent.
            warning: Message on what stood still, sent once.
        """
        moved, at_rest = any(self.dq), (0.0,) * len(self.q)
        self.q, self.dq = self.sent.begin_anew(unsent), at_rest
        self.phase.begin_anew(missed, unsent > 0)
        if moved:
            self.warn_once(warning)

    def assume(self, response: ArmResponse) -> None:
        """Assume a response of the arm from now on; the arm rests at home."""
        self.response = response
        self.controller = Controller(self.arm, response.params, self.request.policy.settings.boxes)

    def observe(self, now: float) -> None:
        """Pass the measurements of this tick to the observer."""
        encoder, joints, h = self.encoder, self.joints, self.h
        if not encoder.samples or encoder.zero is None:
            return
        age = now - encoder.samples[-1].time
        counts = encoder.samples[-1].counts - encoder.zero if age <= h else None
        q, reply_age = (joints.q if joints.fresh else None), now - joints.time
        self.controller.observe(
            counts, age, q, reply_age, lambda back: encoder.before(now - back, h)
        )

    # Motion.

    def still(self) -> Setpoints:
        """Hold the arm."""
        self.dq = (0.0,) * len(self.q)
        return self.q, self.q

    def along(self, path: Path, begin: float) -> Setpoints:
        """Return the next setpoints on a path of all joints, at a time since its begin [s]."""
        first, second = path.at(begin + 0.5 * self.h), path.at(begin + self.h)
        self.q, self.dq = second.q, second.dq
        return first.q, second.q

    def glide(self, path: Path, t: float) -> Setpoints:
        """Move the flange along a path on its track, as the policy would."""
        v = path.at(t + self.h).dq[0] - path.at(t).dq[0]
        return self.command(v / self.h)

    def command(self, u: float) -> Setpoints:
        """Return the setpoints of the controller for an acceleration of the flange [m/s^2].

        The speed that a pause has taken comes back at `RESTART_ACCELERATION`.
        """
        if self.lost_speed != 0.0:
            most = RESTART_ACCELERATION * self.h
            gained = min(max(self.lost_speed, -most), most)
            self.lost_speed -= gained
            u += gained / self.h
        setpoints = self.controller.command(u)
        self.q, self.dq = self.controller.q, self.controller.dq
        return setpoints

    def rest_on_track(self, missed: int, unsent: bool) -> None:
        """Begin a motion on the track anew from rest; arguments as of `RunPhase.begin_anew`."""
        self.lost_speed += self.controller.x_dot
        self.controller.rest(self.q, missed, unsent)
