"""Parent, loop and writer as processes of their own, in real time, around an arm that is made up.

The loop's process runs the real loop, guard and signals; in place of the course stands a heart that
moves one joint to and fro until a word comes. A whole run over ports and a terminal is in
`tests/faults/test_over_the_wires.py`.
"""

import multiprocessing
import os
import signal
import time
from dataclasses import replace
from math import cos, nan
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

from equipoise import RunLog, iiwa, shipped_policy
from equipoise.control.ticks import OperatorMessage, Sample, TickOutput, TickRecord
from equipoise.errors import LinkError, OutsideError
from equipoise.log.conditions import RunEnd
from equipoise.outcomes import Phase
from equipoise.rig import host, processes
from equipoise.rig.clocks import SystemClock
from equipoise.rig.config import RigSettings
from equipoise.rig.guarded import GuardedRobot
from equipoise.rig.loop import CANNOT_STOP, run_loop
from equipoise.rig.processes import HEARTBEAT_TIMEOUT, POLL_PERIOD, run_in_processes
from equipoise.rig.request import RunRequest
from equipoise.rig.run_controller import PHASES
from equipoise.rig.series import Series
from equipoise.safety.rules import limits_of
from tests.rig.test_loop import Arm

ARM = iiwa(7)
H = 0.01
TOLD = 0.100
POLICY = shipped_policy()
LINKS = ("kst://nowhere", "serial://nowhere")
REQUEST = RunRequest(POLICY, POLICY.actuator, RigSettings(), *LINKS, 2.0)


# What stands in the loop's process.


class Heart:
    """Moves A7 to and fro, until a word or two seconds have come; then the guard stops it.

    Slowly enough to begin anew at full speed after a stall of a busy machine.
    """

    h = H

    def __init__(self):
        self.tick_number, self.rest, self.typed = 0, None, ""

    def tick(self, now, inputs):
        n = self.tick_number = self.tick_number + 1
        events = [OperatorMessage("homing", f"process {os.getpid()}")] if n == 1 else []
        if self.rest is None and (inputs.lines or n > 200):
            self.rest, self.typed = n, "".join(inputs.lines[:1])
            events.append(OperatorMessage("stopping", self.typed or "survived"))
        done, state = False, Phase.BALANCING
        setpoints = [(*ARM.home[:6], self.at(2 * n - half)) for half in (1, 0)]
        if self.rest is not None:
            setpoints, state, done = [(nan,) * 7] * 2, Phase.STOPPING, n > self.rest + 20
        index = PHASES.index(state)
        zero = (0.0,) * 7
        return TickOutput(setpoints, ARM.home, zero, index, TickRecord(), events, done=done)

    def at(self, n):
        return ARM.home[6] + 0.005 * (1.0 - cos(4.0 * n * H / 2.0))


def move(request, rig, operators, recorder, *, prepare, submit, follow):
    """Be the course: no more than a stream."""
    clock, (operator,) = SystemClock(), operators
    arm, heart = Arm(clock), Heart()
    robot = GuardedRobot(arm, limits_of(ARM), H / 2.0)
    robot.start()
    host.prepare()  # as a run does: a collection stalls the loop for 200 ms
    encoder = SimpleNamespace(samples=lambda: [Sample(time.monotonic(), 0, False, False, 0)])
    _, stoppable = run_loop(robot, encoder, clock, heart, recorder, operator)
    if "SENT" in os.environ:
        np.save(os.environ["SENT"], [q[6] for q in arm.sent])
    outcome = "operator" if heart.typed else "survived"
    evidence = {"typed": heart.typed}
    return RunEnd(outcome=outcome, evidence=evidence, stoppable=stoppable, survival=0.0)


def moving(request, memory, *pipes, course=move):
    """Be the loop's process, with another course and nobody beside it."""
    processes.connect = lambda *_, **__: None
    processes.run_on_rig = course
    processes._loop(request, memory, *pipes)


def breaking(request, memory, *pipes):
    def fail(*_, **__):
        raise ZeroDivisionError("by zero")

    moving(request, memory, *pipes, course=fail)


def waiting(request, memory, *pipes):
    """Wait for a robot's server with an encoder that has died."""

    def samples():
        raise LinkError("the encoder is gone")

    def connect(_, tell, attend):
        processes.run_on_rig = lambda *_, **__: attend()
        return SimpleNamespace(sensor=SimpleNamespace(samples=samples))

    processes.connect = connect
    processes._loop(request, memory, *pipes)


def three(request, *parts, follow, **options):
    """Be a series of three runs."""
    for _ in range(2):
        follow(move(request, *parts, follow=follow, **options), request)
    return move(request, *parts, follow=follow, **options)


def series(request, memory, *pipes):
    moving(request, memory, *pipes, course=three)


def one_and_a_word(request, rig, operators, *parts, follow, **options):
    """Be a run, and what is typed before the next."""
    follow(move(request, rig, operators, *parts, follow=follow, **options), request)
    return RunEnd(outcome="operator", evidence={"typed": "".join(operators[0].read_input())})


def interrupted(request, memory, *pipes):
    moving(request, memory, *pipes, course=one_and_a_word)


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
            self.act(self)
        return []

    def texts(self, name):
        return [text for _, n, text in self.told if n == name]

    def told_after(self, text):
        """How long after its act it was told [s], less what the host held the parent up."""
        when = next(when for when, _, said in self.told if text in said)
        looks = [look for look in self.looks if self.acted - 0.05 <= look <= when]
        return when - self.acted - max(0.0, *(np.diff([*looks, when]) - 2.0 * POLL_PERIOD))


def kill(number):
    return lambda person: os.kill(person.loop, number)


@pytest.fixture
def run(monkeypatch, tmp_path):
    def play(person, loop=moving):
        monkeypatch.setattr(processes, "_loop", loop)
        return run_in_processes(REQUEST, tmp_path / "run.mcap", person, person.live)

    yield play
    for child in multiprocessing.active_children():
        child.kill()


@pytest.fixture
def log(tmp_path):
    return lambda: RunLog.load(tmp_path / "run.mcap", damaged=True)


def came_to_rest(places):
    """Whether A7 has moved, and stands in the end."""
    steps = np.abs(np.diff(places))
    return steps[:20].max() > 1e-6 and (steps[-4:] < 1e-12).all()


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGHUP, marks=pytest.mark.slow)]
)
def test_a_signal_is_a_word_to_the_loop_and_the_log_is_complete(run, log, number):
    handler = signal.getsignal(number)
    outcome = run(Person(lambda _: os.kill(os.getpid(), number)))
    assert outcome.evidence == log().end.evidence == {"typed": processes.STOP}
    assert outcome.stoppable
    assert came_to_rest(log().tables["stream"]["q"][:, 6])
    assert len(log().tables["tick"]) < 150
    assert signal.getsignal(number) == handler


def test_each_run_of_a_series_has_a_log_of_its_own(monkeypatch, tmp_path):
    monkeypatch.setattr(processes, "_loop", series)
    request, person, ends = replace(REQUEST, runs=3, start="hanging"), Person(), []
    last = run_in_processes(request, tmp_path / "run.mcap", person, person.live, ended=ends.append)
    assert [end.outcome for end in (*ends, last)] == ["survived"] * 3
    logs = [RunLog.load(tmp_path / f"run-00{number}.mcap") for number in (1, 2, 3)]
    for log in logs:
        assert came_to_rest(log.tables["stream"]["q"][:, 6])
        assert [event.name for event in log.events].count("homing") == 1
    assert len(Series.load(tmp_path / "run-series.json").runs) == 3


def test_a_word_is_heard_while_the_disk_hangs_between_two_runs(monkeypatch, tmp_path):
    monkeypatch.setattr(processes, "_loop", interrupted)
    monkeypatch.setattr(processes, "JOIN_TIMEOUT", 1.0)
    monkeypatch.setattr(processes.RunLogs, "follow", lambda *_: time.sleep(60.0))
    person = Person(lambda _: os.kill(os.getpid(), signal.SIGTERM), after=2.5)
    request = replace(REQUEST, runs=2, start="hanging")
    last = run_in_processes(request, tmp_path / "run.mcap", person, person.live)
    assert last.evidence == {"typed": processes.STOP}
    assert person.texts("stopping") == ["survived"]
    assert person.texts("warning") == ["the log is incomplete: the disk does not answer"]


def test_a_loop_that_is_killed_is_told_at_once_and_its_log_is_readable(run, log):
    person = Person(kill(signal.SIGKILL), after=1.5)
    with pytest.raises(OutsideError, match="has ended with -9; press the E-stop"):
        run(person)
    assert person.texts("fault") == [f"the loop does not answer: {CANNOT_STOP}"]
    assert person.told_after("does not answer") < TOLD
    # All that it had recorded; a tick may have been under way.
    assert len(log().tables["tick"]) > 100
    assert log().tables["tick"]["time"][-1] > person.acted - 2.0 * H - 0.01
    assert "has ended with -9" in log().end.evidence["text"]


def test_a_loop_that_stands_still_is_told_within_100_ms(run, log):
    class Patient(Person):
        """Lets the loop go on, and stop, some time after it was held."""

        held = True

        def read_input(self):
            super().read_input()
            if self.held and self.acted and self.looks[-1] > self.acted + 0.6:
                self.held = False
                os.kill(self.loop, signal.SIGCONT)
                return ["stop"]
            return []

    person = Patient(kill(signal.SIGSTOP))
    assert run(person).stoppable  # the stall was only one
    assert person.texts("fault") == [f"the loop does not answer: {CANNOT_STOP}"]
    assert HEARTBEAT_TIMEOUT - 2.0 * H < person.told_after("does not answer") < TOLD
    assert came_to_rest(log().tables["stream"]["q"][:, 6])


def run_alone(out, pids):
    processes._loop = moving
    os.environ["SENT"] = str(out.with_suffix(".npy"))
    children = psutil.Process().children
    person = Person(lambda _: pids.send([one.pid for one in children(recursive=True)]), after=0.0)
    run_in_processes(REQUEST, out, person, person.live)


@pytest.mark.full
def test_a_loop_whose_parent_is_gone_comes_to_rest_and_nobody_is_left(tmp_path):
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    out = tmp_path / "run.mcap"
    parent = context.Process(target=run_alone, args=(out, theirs))
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
    assert came_to_rest(np.load(out.with_suffix(".npy")))


def lives(pid):
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


@pytest.mark.full
@pytest.mark.parametrize(
    ("loop", "kind", "saying"),
    [
        (waiting, LinkError, "the encoder is gone"),
        (breaking, OutsideError, r"the run failed \(ZeroDivisionError: by zero .*\); please"),
    ],
)
def test_what_fails_in_the_loops_process_is_one_sentence_here(run, tmp_path, loop, kind, saying):
    with pytest.raises(kind, match=saying):
        run(Person(), loop)
    assert not any(tmp_path.iterdir()), "a log of a run that never was connected"
