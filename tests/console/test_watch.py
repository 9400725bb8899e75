"""Runs and their consoles through shared memory."""

from types import SimpleNamespace

import numpy as np
import pytest

from equipoise.console.live import RunWatch
from equipoise.log.recorder import live_runs, open_recorder, push_event, share
from equipoise.outcomes import Phase
from equipoise.rig.interfaces import OperatorMessage
from equipoise.rig.processes import OperatorProxy
from equipoise.rig.run_controller import PHASES
from tests.log.made_up import RIG

HOME = np.array(RIG.arm.home)


@pytest.fixture
def shared():
    with share(RIG) as folder:
        yield folder, open_recorder(folder)[1]


@pytest.fixture
def watch(shared):
    watch = RunWatch(shared[0])
    yield watch
    watch.close()


def ask(operator, text, *answers):
    operator.notify(OperatorMessage("checklist", text, answers))


def asked(watch):
    watch.observe()
    return watch.question


@pytest.fixture
def clock(monkeypatch):
    """The time of the machine [s], to be set."""
    clock = SimpleNamespace(now=1.0)
    monkeypatch.setattr("equipoise.console.live.time", clock)
    clock.monotonic = lambda: clock.now
    return clock


def tick(recorder, time, phase, phi, late=0.001):
    state = PHASES.index(phase)
    recorder.tick.push(time=time, late=late, state=state, u=0.5, estimated_phi=phi, q=HOME + 0.1)


def test_an_observer_sees_all_and_takes_nothing(shared, watch, clock):
    recorder = shared[1]
    watch.observe()
    assert watch.phase is None
    tick(recorder, 1.0, Phase.HOMING, 3.0, late=0.004)
    tick(recorder, 1.01, Phase.BALANCING, 0.1)
    recorder.reply.push(time=1.0, q=HOME)
    recorder.encoder.push(time=1.0, counts=7, received=1.0)
    push_event(recorder.event, 1.0, OperatorMessage("homing", "Moving"))
    watch.observe()
    assert (watch.phase, watch.phi, watch.late, watch.time) == (Phase.BALANCING, 0.1, 0.004, 1.01)
    assert watch.q == pytest.approx(HOME)
    assert [event.text for event in watch.events] == ["Moving"]
    watch.observe()
    assert watch.events == []
    assert len(recorder.tick.take()) == 2
    assert len(recorder.event.take()) == 1


def test_a_measurement_that_is_too_old_is_unknown(shared, watch, clock):
    recorder = shared[1]
    for now, has_posture, has_angle in ((1.0, True, True), (1.2, False, True), (1.4, True, False)):
        clock.now = now
        tick(recorder, now, Phase.BALANCING, 0.1)  # the estimate goes on
        if has_posture:
            recorder.reply.push(time=now, q=HOME)
        if has_angle:
            recorder.encoder.push(time=now, counts=7, received=now)
        watch.observe()
        assert (watch.q is not None, np.isfinite(watch.phi)) == (has_posture, has_angle)
    clock.now += 0.02
    watch.observe()
    assert watch.q is not None  # none new yet, but not old


def test_the_end_of_a_run_is_seen_and_its_memory_is_gone():
    with share(RIG) as folder:
        assert folder in live_runs()
        assert folder.stat().st_mode & 0o077 == 0
        watch = RunWatch(folder)
        watch.observe()
        assert not watch.ended
    watch.observe()
    assert watch.ended
    assert not folder.exists()


def test_an_answer_counts_for_its_question_alone_and_once(shared, watch):
    operator = OperatorProxy(shared[1])
    ask(operator, "First? Type a.", "a")
    first = asked(watch)
    assert first.answers == ("a",)
    ask(operator, "Second? Type b.", "b")
    second = asked(watch)
    watch.say("a", first.time)  # too late
    watch.say("b", second.time)
    watch.say("b", second.time)  # a second press
    assert operator.read_input() == ["b"]
    assert asked(watch) is None
    watch.say("y", 0)
    watch.say("stop")  # needs no question
    assert operator.read_input() == ["stop"]


def test_one_console_has_the_words_of_a_run(shared, watch):
    with pytest.raises(BlockingIOError):
        RunWatch(shared[0])
    watch.close()
    RunWatch(shared[0]).close()
