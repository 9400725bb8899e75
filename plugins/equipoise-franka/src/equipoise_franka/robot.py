"""Driver of a Franka Research 3 on the vendor's `pylibfranka`: a `Robot`, and clock of its rig.

The controller sends its state every millisecond, on its own clock, and expects a velocity. Each
state is answered while the loop waits for its clock, from the path between the setpoints
(`equipoise_franka.path`), by a velocity within the limits (`equipoise_franka.velocity`). A motion
stops by itself after 20 packets without an answer, after a reflex, and after a command beyond the
limits. Any such end is final: nothing here recovers from an error, the operator does.

`pylibfranka` waits up to a second for a packet, and holds Python's lock meanwhile. The driver calls
it only once a packet has arrived, at the socket that `pylibfranka` has opened.
"""

import os
import select
import socket
import stat
from collections import deque
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import Any, Final, NoReturn

import numpy as np

from equipoise.arrays import Array
from equipoise.errors import LinkError, OutsideError
from equipoise.rig.interfaces import Reply, checked_setpoint
from equipoise.rig.plugins import Session
from equipoise.safety.rules import FIRST_LIMIT
from equipoise_franka.path import SetpointPath
from equipoise_franka.velocity import GAIN, PERIOD, limited, velocity_limits

JOINTS: Final = 7
"""Number of joints of the arm."""
SILENCE: Final = 0.5
"""Time without a packet after which the link is lost [s]."""
REQUEST_TIMEOUT: Final = 0.1
"""Time without a state, while setpoints come, after which the link is lost [s]; a stall of 70 ms is
bridged."""
POLL_PERIOD: Final = 1e-4
"""Time between two looks for a packet [s]: a late answer counts as a lost packet."""
DRIFT: Final = 1e-4
"""Maximum difference of the two clocks' rates [-]; quartz has 1e-5."""
AT_REST: Final = 1e-3
"""Velocity, and change of it in a cycle, below which a motion may end [rad/s]."""
STOPPING: Final = 1.0
"""Time in which the joints come to rest [s]; from their highest velocity they need 0.6."""
MOVES: Final = 0.01
"""Commanded velocity of a joint at which its angle cannot stay the same [rad/s]."""
MOST_SAME: Final = 20
"""Number of states with equal joints, while they should move, after which the link is given up;
without commands the controller then stops the arm."""
TORQUES: Final = [20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0]
"""External torques at which the controller stops the arm [N m]; those of libfranka's examples."""
FORCES: Final = [20.0, 20.0, 20.0, 25.0, 25.0, 25.0]
"""External forces [N] and torques [N m] on the flange at which it does."""
POINT: Final = [0.0] * 9
"""Inertia of a load that is taken as a mass at a point [kg m^2]."""
RECOVER: Final = "inspect the arm, clear the error in Desk, and activate FCI"
"""Remedy after an error that stopped the arm."""
MODES: Final = {
    "Reflex": f"it was stopped by an error; {RECOVER}",
    "UserStopped": "a user stop is active; release it, and activate FCI in Desk",
    "Guiding": "it is guided by hand; release the guiding buttons",
    "Move": "another program moves it; end that program",
    "Other": "its joints are locked or it is in programming mode; unlock them, and activate FCI "
    "in Desk",
    "AutomaticErrorRecovery": f"it recovers from an error; {RECOVER}",
}
"""Cause and remedy for each mode in which no motion can begin."""
CAUSES: Final = {
    "communication_constraints_violation": "packets were late or lost; use one direct cable and a "
    "real-time kernel, see docs/how-to/real-time.md",
    "reflex": "a force on the arm exceeded its threshold; look for a contact",
    "discontinuity": "the commanded motion jumped; see log explain for stalls of the loop",
    "position_limits": "a joint came to its position limit; move home away from it",
    "velocity": "a joint came to its velocity limit; lower speed_fraction in rig.toml",
    "self_collision": "the arm came near itself; choose another home",
    "tau_j_range": "the load exceeds the arm; check its load in Desk",
    "power_limit": "the arm needs more power than it has; check its load in Desk",
    "user stop": MODES["UserStopped"],
    "safety function": MODES["UserStopped"],
}
"""Cause and remedy by a part of the name of a controller's error, or of what the library says."""


class FrankaRobot:
    """Driver of an FR3; see the module."""

    joints = JOINTS

    def __init__(self, host: str, session: Session) -> None:
        """Create the driver; nothing is opened before `connect`.

        Args:
            host: Name or number of the controller.
            session: Its clocks, and the load on the flange; without one that of Desk stays in
                force.
        """
        self._host, self._session = host, session
        self._clock = session.clock
        self._library: Any = None
        self._robot: Any = None
        self._control: Any = None
        self._packets = self._commands = -1
        self._streams = False
        self._failure = ""
        self._sent: deque[float] = deque()
        self._replies: list[Reply] = []
        self._offset = np.inf
        self._time, self._elapsed = 0.0, PERIOD

    # The clock.

    def now(self) -> float:
        """Return the time [s]."""
        return self._session.loop_clock.now()

    def wait_until(self, time: float) -> None:
        """Answer the controller's states until a time [s].

        Raises:
            LinkError: The link is down, or the robot has stopped, or it was not at rest where it
                was measured at the start.
        """
        while self._streams and (moment := self._next_request(time)) is not None:
            away = np.abs(np.subtract(self._state.q, self._path.end)).max()
            if not self._path.started and not away <= FIRST_LIMIT:  # NaN fails, too
                self._fail(
                    f"was measured {away:.2g} rad from its posture at the start, "
                    f"expected at most {FIRST_LIMIT:g} rad: a reply is wrong, or the arm moves"
                )
            self._follow(self._path.at(moment))
            received = self._requested = self.now()
            q, torques = tuple(self._state.q), tuple(self._state.tau_ext_hat_filtered)
            while self._sent and self._sent[0] <= moment:
                self._replies.append(Reply(self._sent.popleft(), received, q, torques))
        self._session.loop_clock.wait_until(time)

    # The robot.

    def connect(self) -> None:
        """Connect to the controller, and check that it accepts motions.

        Raises:
            LinkError: There is no controller, or it accepts no motions.
            OutsideError: `pylibfranka` is not installed.
        """
        if self._robot is not None or self._failure:
            raise LinkError("this connection was used; make another one")
        try:
            self._library = import_module("pylibfranka")
        except ImportError as error:
            raise OutsideError(f"{error}; an FR3 needs a computer with Linux") from None
        before = _sockets()
        # Without a real-time kernel, too: the diagnosis measures what this machine can do.
        ignored = self._library.RealtimeConfig.kIgnore
        scheduling = os.sched_getscheduler(0), os.sched_getparam(0)
        try:
            with self._final_errors():
                self._robot = self._library.Robot(self._host, ignored)
        finally:  # libfranka gives this thread the highest priority of the machine
            os.sched_setscheduler(0, *scheduling)
        opened = {kind: number for number, kind in _sockets() - before}
        self._packets, self._commands = opened[socket.SOCK_DGRAM], opened[socket.SOCK_STREAM]
        self.measured()

    def measured(self) -> Array:
        """Return the measured joints [rad], shape (7,), while no servo runs.

        Raises:
            LinkError: The controller is silent, or accepts no motions.
        """
        self._check_link()
        if self._streams:
            raise LinkError("a servo runs; stop it before you measure")
        return np.array(self._idle_state().q)

    def start(self) -> Array:
        """Start the velocity servo, at rest; the motion begins with the first state.

        A motion without commands ends after 20 ms, and the caller may have more to prepare.

        Returns:
            The joints where it is held [rad], shape (7,). The states have to agree until the
            first setpoint: a single one may be wrong.

        Raises:
            LinkError: The controller accepts no motions.
        """
        held_at = self.measured()
        with self._final_errors():
            self._robot.set_collision_behavior(TORQUES, TORQUES, FORCES, FORCES)
            if self._session.load is not None:
                self._robot.set_load(*self._session.load, POINT)
        self._idle_state()
        self._clock, self._same = self._session.loop_clock, 0
        self._velocity = self._acceleration = np.zeros(JOINTS)
        self._desired = held_at
        self._before: Array | None = None
        self._state: Any = None
        self._path = SetpointPath(held_at, self._session.period)
        self._sent.clear()
        self._replies.clear()
        self._requested, self._streams = self.now(), True  # time of the last state [s]
        return held_at

    def send(self, q: Sequence[float] | Array) -> None:
        """Add a setpoint of all joints to the path.

        Args:
            q: The joints [rad], shape (7,).

        Raises:
            LinkError: No servo runs, or the robot is silent.
            InputError: The setpoint is not seven finite numbers; it was not added.
        """
        setpoint = checked_setpoint(q, JOINTS)
        self._check_link()
        if not self._streams:
            raise LinkError("the servo does not run; start it first")
        now = self.now()
        if now - self._requested > REQUEST_TIMEOUT:
            self._fail(f"has requested nothing for {1e3 * REQUEST_TIMEOUT:g} ms")
        self._path.add(setpoint, now)
        self._sent.append(now)

    def replies(self) -> list[Reply]:
        """Return the replies since the last call, the oldest first.

        A reply has the joints of the first state after its setpoint.
        """
        replies, self._replies = self._replies, []
        return replies

    def stop(self) -> None:
        """Bring the joints to rest, and end the motion; without a servo, do nothing.

        Raises:
            LinkError: The motion was stopped otherwise.
        """
        self._check_link()
        if not self._streams:
            return
        self._streams, self._clock = False, self._session.clock
        end, rests = self._clock.now() + STOPPING, False
        while not rests:
            if self._next_request(self._clock.now() + SILENCE) is None:
                self._fail(f"sent nothing for {SILENCE:g} s")
            if self._clock.now() > end:
                self._fail(f"does not rest within {STOPPING:g} s; press the emergency stop")
            changes = self._velocity, PERIOD * self._acceleration
            rests = bool(np.abs(changes).max() < AT_REST)
            self._command(np.zeros(JOINTS), finished=rests)
        self._control = None

    def close(self) -> None:
        """Disconnect; the controller stops a motion that runs."""
        self._streams = False
        if self._robot is not None:
            self._failure = self._failure or "the connection was closed"
            # libfranka would end a motion first, and wait for a silent controller without end.
            with suppress(OSError), socket.socket(fileno=os.dup(self._commands)) as commands:
                commands.shutdown(socket.SHUT_RDWR)
        self._control = self._robot = None

    # The motion.

    def _next_request(self, until: float) -> float | None:
        """Wait for the next state of the controller; return its time, None at a time [s]."""
        self._check_link()
        if self._control is None:
            if self._next_state(until) is None:
                return None
            mode = self._library.ControllerMode.JointImpedance
            with self._final_errors():
                self._control = self._robot.start_joint_velocity_control(mode)
        if not self._has_packet(until):
            return None
        with self._final_errors():
            state, _ = self._control.readOnce()
        now, time = self._clock.now(), float(state.time.to_sec())
        if self._state is not None:
            self._elapsed, velocity = time - self._time, np.array(state.dq_d)
            if not (self._elapsed > 0.0 and np.isfinite(velocity).all()):
                self._fail(
                    f"reports {velocity.round(3).tolist()} rad/s, {self._elapsed:g} s after its "
                    "last state, expected finite numbers and a later time; restart the controller"
                )
            moves = np.abs(velocity).max() > MOVES
            self._same = self._same + 1 if moves and state.q == self._state.q else 0
            if self._same >= MOST_SAME:
                self._fail(f"reports the same joints {MOST_SAME} times; restart the controller")
            self._acceleration = (velocity - self._velocity) / self._elapsed
            self._velocity = velocity
            # More accurate than the reported q_d, which has 32 bits.
            before = velocity - 0.5 * (self._elapsed - PERIOD) * self._acceleration
            self._desired = self._desired + self._elapsed * before
        self._state, self._time = state, time
        # The controller's clock paces the path evenly; packets are late by different times.
        self._offset = min(self._offset + DRIFT * self._elapsed, now - time)
        return time + self._offset

    def _follow(self, q: Array) -> None:
        """Command the velocity that leads to a point of the path [rad], shape (7,)."""
        if self._before is None:  # the path begins where the controller holds the joints
            self._before = self._desired = q
        error = self._before - self._desired
        self._command((q - self._before) / self._elapsed + GAIN * error)
        self._before = q

    def _command(self, v: Array, *, finished: bool = False) -> None:
        bounds = velocity_limits(self._desired)
        v = limited(v, self._velocity, self._acceleration, bounds)
        command = self._library.JointVelocities(v.tolist())
        command.motion_finished = finished
        with self._final_errors():
            self._control.writeOnce(command)

    def _idle_state(self) -> Any:
        """Return the next state while no motion runs, and check that one can begin."""
        if (state := self._next_state(self._clock.now() + SILENCE)) is None:
            self._fail(f"sent nothing for {SILENCE:g} s; check its cable and its power")
        mode, errors = state.robot_mode.name, str(state.current_errors)
        if mode != "Idle" or errors != "[]":
            cause = MODES.get(mode, f"it reports an error; {RECOVER}")
            named = "" if errors == "[]" else f" ({errors}: {_cause(errors)})"
            self._fail(f"accepts no motion: {cause}{named}")
        return state

    def _next_state(self, until: float) -> Any:
        """Return the next state while no motion runs; None without one at a time [s]."""
        with self._final_errors():
            if self._has_packet(self._clock.now()):
                self._robot.read_once()  # the newest of the past
            return self._robot.read_once() if self._has_packet(until) else None

    def _has_packet(self, until: float) -> bool:
        """Wait for a packet until a time [s], and return whether there is one."""
        while not select.select([self._packets], [], [], 0.0)[0]:
            if (now := self._clock.now()) >= until:
                return False
            self._clock.wait_until(min(now + POLL_PERIOD, until))
        return True

    def _check_link(self) -> None:
        if self._failure:
            raise LinkError(self._failure)
        if self._robot is None:
            raise LinkError("the robot is not connected; connect first")

    @contextmanager
    def _final_errors(self) -> Generator[None]:
        """Give up the link for good on an error of `pylibfranka`."""
        try:
            yield
        except RuntimeError as error:
            message = str(error).removeprefix("libfranka: ")
            errors = message.partition("[")[2]
            remedy = (
                RECOVER if errors else "check its power and its cable, and activate FCI in Desk"
            )
            self._fail(f"reports {message!r}; {_cause(errors or message, remedy)}", error)

    def _fail(self, why: str, error: Exception | None = None) -> NoReturn:
        """Give up the link for good."""
        self._failure = f"the FR3 {self._host} {why}"
        raise LinkError(self._failure) from error


def _cause(errors: str, otherwise: str = RECOVER) -> str:
    """Return the cause and remedy of the controller's errors."""
    errors = errors.lower()
    return next((cause for name, cause in CAUSES.items() if name in errors), otherwise)


def _sockets() -> set[tuple[int, int]]:
    """Return the numbers and the kinds of this process's open sockets."""
    sockets = set[tuple[int, int]]()
    for name in os.listdir("/proc/self/fd"):
        with suppress(OSError):
            number = int(name)
            if stat.S_ISSOCK(os.fstat(number).st_mode):
                with socket.socket(fileno=os.dup(number)) as opened:
                    sockets.add((number, opened.type))
    return sockets
