"""Parent, loop and writer as processes of their own, in real time, around an arm that is made up.

The loop's process runs the real loop, guard and signals; in place of the course stands a heart that
moves one joint to and fro until a word comes. The whole course over ports and a terminal is in
`tests/faults/real_time.py`.
"""

import multiprocessing
import os
import signal
import sys
import time
from math import cos
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

from equipoise.control.policy import shipped_policy
from equipoise.control.ticks import OperatorMessage, TickOutput, TickRecord
from equipoise.errors import LinkError, OutsideError
from equipoise.logs.conditions import RunEnd
from equipoise.logs.run_log import RunLog
from equipoise.logs.writer import LogEncoder
from equipoise.model.arms.iiwa import iiwa
from equipoise.outcomes import End, Outcome, Phase
from equipoise.rig import processes, realtime
from equipoise.rig.clocks import SystemClock
from equipoise.rig.config import RigSettings
from equipoise.rig.guarded import GuardedRobot
from equipoise.rig.interfaces import Reply, Sample
from equipoise.rig.loop import CANNOT_STOP, run_loop
from equipoise.rig.processes import HEARTBEAT_TIMEOUT, POLL_PERIOD, run_in_processes
from equipoise.rig.request import RunRequest
from equipoise.rig.run_controller import PHASES
from equipoise.safety.rules import limits_of
from equipoise.safety.stop import ramp

pytestmark = [
    pytest.mark.compiled_only,
    pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX's"),
]

ARM = iiwa(7)
H = 0.01
TOLD = 0.100
MOVING, STOPPING = PHASES.index(Phase.BALANCING), PHASES.index(Phase.STOPPING)


# What stands in the loop's process.


class Arm:
    joints = 7

    def __init__(self):
        self.waiting, self.sent = [], []

    def measured(self):
        return np.array(ARM.home)

    def start(self):
        pass

    def send(self, q):
        now = time.monotonic()
        self.waiting.append(Reply(now, now, tuple(q), None))
        self.sent.append(q[6])

    def replies(self):
        waiting, self.waiting = self.waiting, []
        return waiting


class Encoder:
    def samples(self):
        return [Sample(time.monotonic(), 0, False, False, 0)]


class Heart:
    """Moves A7 to and fro, until a word or two seconds have come; then it comes to rest.

    Slowly enough to begin anew at full speed after a stall of a busy machine.
    """

    h = H

    def __init__(self):
        self.tick_number, self.rest, self.end = 0, None, End(Outcome.LASTED)
        self.q = [ARM.home[6]] * 2

    def tick(self, now, inputs):
        n = self.tick_number = self.tick_number + 1
        events = [OperatorMessage("homing", f"process {os.getpid()}")] if n == 1 else []
        if self.rest is None and (inputs.lines or n > 200):
            typed = inputs.lines[0] if inputs.lines else ""
            if typed:
                self.end = End(Outcome.OPERATOR, {"typed": typed})
            events.append(OperatorMessage("stopping", typed or "lasted"))
            speed = (self.q[1] - self.q[0]) / (H / 2.0)
            q = (*ARM.home[:6], self.q[1])
            self.rest = n, ramp(q, (*[0.0] * 6, speed), 0.0, limits_of(ARM))
        wanted = [self.at(2 * n - 1), self.at(2 * n)]
        self.q = [q[6] for q in wanted]
        return TickOutput(
            setpoints=tuple(wanted), q=ARM.home, dq=(0.0,) * 7,
            state=MOVING if self.rest is None else STOPPING, record=TickRecord(), events=events,
            done=self.rest is not None and n > self.rest[0] + 20,
        )  # fmt: skip

    def at(self, n):
        if self.rest is not None:
            begun, way = self.rest
            return way.at((n - 2 * (begun - 1)) * H / 2.0)
        return (*ARM.home[:6], ARM.home[6] + 0.005 * (1.0 - cos(4.0 * n * H / 2.0)))


def move(request, rig, operators, recorder, *, measures, submit):
    """Be the course: no more than a stream."""
    arm = Arm()
    robot = GuardedRobot(arm, limits_of(ARM), H / 2.0)
    robot.start()
    heart = Heart()
    realtime.prepare()  # as a run does: a collection stalls the loop for 200 ms
    ending = run_loop(
        robot,
        Encoder(),
        SystemClock(),
        heart,
        recorder,
        operators[0],
        submit=submit,
    )
    if "SENT" in os.environ:
        np.save(os.environ["SENT"], arm.sent)
    return RunEnd(
        outcome=heart.end.outcome,
        evidence=dict(heart.end.evidence),
        stoppable=ending.stoppable,
        missed=ending.missed,
        lasted=0.0,
    )


def moving(request, memory, joints, pipe, course=move):
    """Be the loop's process, with another course and nobody beside it."""
    RunRequest.connect = lambda *_, **__: None
    processes.run_on_rig = course
    processes._loop(request, memory, joints, pipe)


def breaking(request, memory, joints, pipe):
    def fail(*_, **__):
        raise ZeroDivisionError("by zero")

    moving(request, memory, joints, pipe, fail)


def waiting(request, memory, joints, pipe):
    """Wait for a robot's server with an encoder that has died."""

    def samples():
        raise LinkError("the encoder is gone")

    def connect(_, tell, attend):
        processes.run_on_rig = lambda *_, **__: attend()
        return SimpleNamespace(sensor=SimpleNamespace(samples=samples))

    RunRequest.connect = connect
    processes._loop(request, memory, joints, pipe)


# Who stands at the screen.


class Person:
    """Keeps what it is told, and does something once, so long after the arm began to move."""

    def __init__(self, act=None, after=0.4):
        self.told, self.looks, self.act, self.after = [], [], act, after
        self.began = self.acted = None
        self.loop = 0

    def notify(self, event):
        now = time.monotonic()
        self.told.append((now, event.name, event.text))
        if event.name == "homing":
            self.began, self.loop = now, int(event.text.split()[1])

    def live(self, phase, phi):
        pass

    def read_input(self):
        now = time.monotonic()
        self.looks.append(now)
        if self.act and self.began and self.acted is None and now > self.began + self.after:
            self.acted = time.monotonic()
            return self.act(self) or []
        return []

    def texts(self, name):
        return [text for _, n, text in self.told if n == name]

    def told_after(self, text):
        """How long after its act it was told [s], less what the host held the parent up."""
        when = next(when for when, _, said in self.told if text in said)
        looks = [look for look in self.looks if self.acted - 0.05 <= look <= when]
        return when - self.acted - max(0.0, *(np.diff([*looks, when]) - 2.0 * POLL_PERIOD))


def kill(number):
    def act(person):
        os.kill(person.loop, number)

    return act


def signal_here(number):
    return lambda _: os.kill(os.getpid(), number)


@pytest.fixture
def request_of_a_run():
    policy = shipped_policy()
    return RunRequest(
        policy=policy, actuator=policy.actuator, settings=RigSettings(), robot="kst://nowhere",
        encoder="serial://nowhere", duration=2.0, t1=False, dry_run=False, seed=0,
    )  # fmt: skip


@pytest.fixture
def run(monkeypatch, tmp_path, request_of_a_run):
    def play(person, loop=moving):
        monkeypatch.setattr(processes, "_loop", loop)
        return run_in_processes(request_of_a_run, tmp_path / "run.mcap", person, person.live)

    yield play
    for child in multiprocessing.active_children():
        child.kill()


def came_to_rest(log):
    """The log goes on to where the arm stands, without a gap."""
    stream = log.tables["stream"]
    steps = np.abs(np.diff(stream["q"][:, 6]))
    return steps[:20].max() > 1e-6 and (steps[-4:] < 1e-12).all()


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGHUP, marks=pytest.mark.slow)]
)
def test_a_signal_is_a_word_to_the_loop_and_the_log_is_complete(run, tmp_path, number):
    handler = signal.getsignal(number)
    outcome = run(Person(signal_here(number)))
    assert outcome.evidence == {"typed": processes.STOP}
    assert outcome.stoppable
    log = RunLog.load(tmp_path / "run.mcap", damaged=True)
    assert log.end.evidence == {"typed": processes.STOP}
    assert came_to_rest(log)
    assert len(log.tables["tick"]) < 150
    assert signal.getsignal(number) == handler


def test_a_loop_that_is_killed_is_told_at_once_and_its_log_is_readable(run, tmp_path):
    person = Person(kill(signal.SIGKILL), after=1.5)
    with pytest.raises(OutsideError, match="has ended with -9; press the E-stop"):
        run(person)
    assert person.texts("fault") == [f"the loop does not answer: {CANNOT_STOP}"]
    assert person.told_after("does not answer") < TOLD
    log = RunLog.load(tmp_path / "run.mcap", damaged=True)
    # All that it had recorded; a tick may have been under way.
    assert len(log.tables["tick"]) > 100
    assert log.tables["tick"]["time"][-1] > person.acted - 2.0 * H - 0.01
    assert "has ended with -9" in log.end.evidence["text"]


def test_a_loop_that_stands_still_is_told_within_100_ms(run, tmp_path):
    class Patient(Person):
        """Holds the loop once it moves, and lets it go on, and stop, a second later."""

        def read_input(self):
            super().read_input()
            if self.began and self.acted is None and self.looks[-1] > self.began + 0.4:
                self.acted = time.monotonic()
                os.kill(self.loop, signal.SIGSTOP)
            elif self.acted and self.looks[-1] > self.acted + 0.6 and self.held:
                self.held = False
                os.kill(self.loop, signal.SIGCONT)
                return ["stop"]
            return []

    person = Patient()
    person.held = True
    outcome = run(person)
    assert outcome.stoppable  # the stall was only one
    assert person.texts("fault") == [f"the loop does not answer: {CANNOT_STOP}"]
    late = person.told_after("does not answer")
    assert HEARTBEAT_TIMEOUT - 2.0 * H < late < TOLD
    assert came_to_rest(RunLog.load(tmp_path / "run.mcap", damaged=True))


def test_a_log_that_fails_does_not_disturb_the_run_and_is_told_at_once(run, tmp_path, monkeypatch):
    person = Person(lambda _: monkeypatch.setattr(LogEncoder, "write", full_disk), after=1.2)
    outcome = run(person)
    assert (outcome.outcome, outcome.stoppable) == ("lasted", True)
    (warning,) = person.texts("warning")
    assert warning.startswith("the log is incomplete: ")
    assert person.told_after("incomplete") < TOLD
    log = RunLog.load(tmp_path / "run.mcap", damaged=True)
    assert log.end is None
    assert 0 < len(log.tables["tick"]) < 200


def full_disk(*_):
    raise OSError(28, "No space left on device")


def test_where_the_operator_cannot_be_told_anything_the_arm_comes_to_rest(run, tmp_path):
    class Mute(Person):
        def live(self, phase, phi):
            if self.began and time.monotonic() > self.began + 0.3:
                raise BrokenPipeError("nobody reads")

    with pytest.raises(BrokenPipeError):
        run(Mute())
    log = RunLog.load(tmp_path / "run.mcap", damaged=True)
    assert [event.text for event in log.events if event.name == "stopping"] == [processes.STOP]
    assert len(log.tables["tick"]) < 150
    assert came_to_rest(log)


def run_alone(request, out, pids):
    processes._loop = moving
    os.environ["SENT"] = str(out.with_suffix(".npy"))

    class Telling(Person):
        def read_input(self):
            if self.loop and not self.acted:
                self.acted = time.monotonic()
                pids.send([child.pid for child in psutil.Process().children(recursive=True)])
            return []

    person = Telling()
    run_in_processes(request, out, person, person.live)


def test_a_loop_whose_parent_is_gone_comes_to_rest_and_nobody_is_left(request_of_a_run, tmp_path):
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    out = tmp_path / "run.mcap"
    parent = context.Process(target=run_alone, args=(request_of_a_run, out, theirs))
    parent.start()
    assert ours.poll(30.0)
    left = ours.recv()
    time.sleep(0.2)
    parent.kill()
    parent.join()
    until = time.monotonic() + processes.JOIN_TIMEOUT + 5.0
    while any(map(lives, left)) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(map(lives, left))
    steps = np.abs(np.diff(np.load(out.with_suffix(".npy"))))
    assert steps.max() > 1e-6
    assert (steps[-4:] < 1e-12).all()


def lives(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.parametrize(
    ("loop", "kind", "saying"),
    [
        (waiting, LinkError, "the encoder is gone"),
        (
            breaking,
            OutsideError,
            r"the run failed \(ZeroDivisionError: by zero .*\); please report",
        ),
    ],
)
def test_what_fails_in_the_loops_process_is_one_sentence_here(run, tmp_path, loop, kind, saying):
    with pytest.raises(kind, match=saying):
        run(Person(), loop)
    assert not any(tmp_path.iterdir()), "a log of a run that never was connected"


def test_without_room_for_the_log_nothing_begins(monkeypatch, tmp_path, request_of_a_run):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setattr(processes, "_loop", None)
    with pytest.raises(OutsideError, match="cannot write"):
        run_in_processes(request_of_a_run, tmp_path / "file" / "run.mcap", Person(), print)
