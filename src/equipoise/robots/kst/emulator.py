"""Emulator of a cabinet with its KST server: joint servo and motions, with the server's faults.

The server (`KstServer`) serves a link in memory or on a TCP port (`KstCabinet`). As in the real
one, two threads share one string. The *reader* receives each line, and handles targets,
`getJointsPositions`, stop and end itself. Any other line waits in that string for the *main*
thread, which ignores it while a servo or a motion runs. Hence:

- A servo is acknowledged before it exists; its target is then overwritten with the measured joints.
- A point-to-point motion is acknowledged twice, at its start and at its end. It keeps its own goal:
  targets in between are acknowledged, and nothing stops it.
- A command for the main thread that arrives while a servo runs is not answered, and the next line
  erases it; so does the end of a motion. An unknown command is never answered.
- A motion that the controller cannot plan is acknowledged, then refused: `nak`.
- A number that Java cannot parse (`nan`; but `NaN` becomes the target) kills the reader: all later
  lines are ignored, stop and end included, and the servo continues.
- Fewer than seven joints change the first ones only; further ones are ignored.
- The client is not supervised: if it vanishes, the servo continues, and no other client is ever
  served.

Not modelled, and not answered: everything but joints and their torques (poses, forces, tools, pins,
Cartesian, impedance and velocity servos), and motions that end at a torque (`doPTP!`). The server
does not end when no client connects for 60 s.
"""

import socket
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Final

from equipoise.control.minimum_jerk import path_within
from equipoise.errors import InputError, LinkError, OutsideError
from equipoise.rig.interfaces import Transport
from equipoise.rig.simulated_rig import Bodies, SimulatedRig
from equipoise.rig.transports import SocketTransport
from equipoise.robots.kst import codec
from equipoise.simulation.twin.simulated_arm import SimulatedArm

HOST: Final = "127.0.0.1"
"""Address of the emulated cabinet: this machine."""
DONE: Final = b"done\n"
"""Acknowledgement of the server."""
NAK: Final = b"nak\n"
"""Reply of the server after an error in its main thread."""
PLANNING_TIME: Final = 0.1
"""Time from the acknowledgement of a motion until it starts or is refused [s]. Assumed. A client
that receives both replies in one segment waits for the second without end."""
SETTLING_TIME: Final = 0.35
"""Time from the end of a motion's path until its second acknowledgement [s]: the emulated arm
follows by the law of the servo, which takes this for the last milliradian."""
READER: Final = (
    *("jp_", "jpJP_", "jpExT_", "jpMT_"),  # targets
    *(codec.GET_JOINTS, codec.STOP_SERVO, "blueOn", "blueOff"),
)
"""Starts of the lines that the reader answers."""


class KstServer:
    """An emulated KST server for one client; advance it once a millisecond, after the arm."""

    def __init__(self, body: SimulatedArm, link: Transport) -> None:
        """Begin with a connected client, the arm at rest and no servo.

        Args:
            body: The arm; lines have a field for each of its joints.
            link: Link to the client.
        """
        self.ended = False
        """Whether the server's program has ended; it closes the connection then."""
        self.deserted = False
        """Whether the client left without an `end`; no other is ever served."""
        self._farewell = False
        self._body, self._link, self._target = body, link, [0.0] * len(body.arm.joints)
        self._measure = body.measured  # of the servo, which no fault of a reply reaches
        self._rest, self._reads = b"", True
        self._now = self._speed = 0.0
        self._waiting = ""
        self._requested = self._runs = False  # the servo
        self._main = self._run_main()

    def advance(self, now: float) -> None:
        """Run the server's threads until a time [s]."""
        self._now = now
        try:
            self._receive(self._link.read())
        except LinkError:  # the servo continues to its last target
            self.deserted, self._reads = True, False
        next(self._main, None)

    def _say(self, segment: bytes) -> None:
        with suppress(LinkError):
            self._link.write(segment)

    # The reader's thread.

    def _receive(self, data: bytes) -> None:
        try:
            lines, self._rest = codec.split_lines(self._rest + data)
            for line in lines:
                if self._reads:
                    self._read(line.decode("latin-1"))
        except (InputError, LinkError):
            self._reads = False

    def _read(self, command: str) -> None:
        """Obey a line.

        Raises:
            InputError: The line kills the reader.
        """
        self._waiting = ""
        if command.startswith("end"):
            self._requested = self._reads = False
            self._farewell = True
        elif command.startswith(READER):
            if command.startswith("jp"):
                self._read_target(command)
            elif command.startswith(codec.STOP_SERVO):
                self._requested = False
            self._say(self._answer(command))
        else:
            self._waiting = command

    def _answer(self, command: str) -> bytes:
        if command.startswith(("jpJP_", codec.GET_JOINTS)):
            return codec.numbers_reply(self._body.measured())
        if command.startswith(("jpExT_", "Torques_ext_J")):
            return codec.numbers_reply(self._body.torques(external=True))
        if command.startswith(("jpMT_", "Torques_m_J")):
            return codec.numbers_reply(self._body.torques(external=False))
        return DONE

    def _read_target(self, command: str) -> None:
        fields = [field for field in command.split("_") if field]
        try:
            for i, field in enumerate(fields[1 : len(self._target) + 1]):
                self._target[i] = codec.java_double(field)
        finally:  # the servo follows the numbers read before the reader died
            if self._runs:
                self._body.target(tuple(self._target))

    # The main thread; each `yield` waits for the next `advance`.

    def _run_main(self) -> Iterator[None]:
        while not self._farewell:
            command, self._waiting = self._waiting, ""
            try:
                if command.startswith("Torques_"):
                    self._say(self._answer(command))
                elif command.startswith(codec.START_SERVO):
                    yield from self._serve()
                elif command.startswith("doPTPinJS"):
                    yield from self._move()
                elif command.startswith("jRelVel"):  # fraction of the speed limits, for motions
                    self._speed = codec.java_double("".join(command.split("_")[1:2]))
                    self._say(DONE)
            except InputError:
                self._say(NAK)
            yield
        self.ended = True

    def _sleep(self, duration: float) -> Iterator[None]:
        until = self._now + duration - 1e-9  # [s]: rounding
        while self._now < until:
            yield

    def _serve(self) -> Iterator[None]:
        """Run a servo, which begins and ends "a few milliseconds" after its acknowledgements."""
        self._requested = True
        self._say(DONE)
        yield from self._sleep(5e-3)
        self._runs = True
        self._body.servo(True)
        self._target[:] = self._measure()
        self._body.target(tuple(self._target))
        while self._requested:
            yield
        yield from self._sleep(3e-3)
        self._body.servo(False)
        self._runs = False

    def _move(self) -> Iterator[None]:
        """Move to the target along a minimum-jerk path, at the set speed."""
        body, joints, goal = self._body, self._body.arm.joints, tuple(self._target)
        self._say(DONE)
        yield from self._sleep(PLANNING_TIME)
        within = all(a.lower <= q <= a.upper for a, q in zip(joints, goal, strict=True))
        if body.stopped or not within or not 0.0 < self._speed <= 1.0:
            raise InputError("the controller cannot plan this motion")
        speeds = [self._speed * joint.velocity for joint in joints]
        path = path_within(body.measured(), goal, speeds, [joint.acceleration for joint in joints])
        start = self._now
        body.servo(True)
        while self._now < start + path.duration + SETTLING_TIME:
            body.target(path.at(self._now - start).q)
            yield
        body.servo(False)
        self._say(NAK if body.stopped else DONE)
        self._waiting = ""


class KstCabinet:
    """A cabinet with its server on a TCP port, and the arm of a twin, in real time.

    Like a real server, the emulated one serves one client and ends with it; another client is
    accepted by the system and gets no reply. After a farewell it starts again. A client that
    vanishes leaves the servo on, until `restart`.
    """

    def __init__(self, bodies: Bodies, port: int, say: Callable[[str], None]) -> None:
        """Switch arm and cabinet on.

        Args:
            bodies: Arm, pendulum and world.
            port: Port to listen on; for 0 the system chooses one.
            say: Receives a text for each event.

        Raises:
            ArmError: The masses of the arm's links are unknown.
            OutsideError: The port is not available.
        """
        try:
            self._listener = socket.create_server((HOST, port))
        except OSError as error:
            raise OutsideError(
                f"cannot listen on {HOST}, port {port} ({error}); stop what uses it, or choose "
                "another"
            ) from None
        self._listener.setblocking(False)
        self.address = f"kst://{HOST}:{self._listener.getsockname()[1]}"
        """Address of the robot."""
        self.bench = SimulatedRig(bodies)
        """Bench with the arm."""
        self._say = say
        self._client: SocketTransport | None = None
        self._server: KstServer | None = None
        # Call each function that a client needs, since compiling it later would be a stall.
        body = self.bench.body
        body.servo(True)
        body.target(body.measured())
        body.torques(external=True)
        self.bench.advance(self.bench.now + 0.001)
        body.servo(False)

    def advance(self, now: float) -> None:
        """Advance the arm to a time [s], and serve the client."""
        self.bench.advance(now)
        if self._server is None:
            with suppress(BlockingIOError):
                self._client = SocketTransport(self._listener.accept()[0])
                self._server = KstServer(self.bench.body, self._client)
        elif not self._server.deserted:
            self._server.advance(now)
            if self._server.deserted:
                self._say("the client has vanished; a running servo continues until start")
            if self._server.ended:
                self.restart()

    def restart(self) -> None:
        """End the server and its servo, and start it again for another client."""
        self._end_server()
        self._say("the robot's server has ended, and starts again")

    def close(self) -> None:
        """Switch the cabinet off."""
        self._end_server()
        self._listener.close()

    def _end_server(self) -> None:
        """Stop the servo, and close all connections: a client that waits is not served later."""
        self.bench.body.servo(False)
        if self._client is not None:
            self._client.close()
        self._client = self._server = None
        with suppress(BlockingIOError):
            while True:
                self._listener.accept()[0].close()
