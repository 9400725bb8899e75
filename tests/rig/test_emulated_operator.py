"""The emulated operator by messages: words and acts after a reaction time."""

import numpy as np
import pytest

from equipoise.control.ticks import OperatorMessage
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.emulated_operator import REACTION_TIME, EmulatedOperator
from tests.rig.in_process import stand

pytestmark = pytest.mark.compiled_only

BENCH, _ = stand()  # nothing happens there: these look at words and times only


def test_it_types_the_first_answer_once_after_its_reaction_time():
    clock = VirtualClock()
    operator = EmulatedOperator(BENCH, clock)
    operator.notify(OperatorMessage("home", "Is this home?", ("y", "n")))
    clock.wait_until(REACTION_TIME[0] - 0.01)
    assert operator.read_input() == []
    clock.wait_until(REACTION_TIME[1] + 0.01)
    assert operator.read_input() == ["y"]
    assert operator.read_input() == []


def test_it_does_with_its_hands_what_an_event_asks_for_and_leaves_others_alone():
    clock, done = VirtualClock(), []
    operator = EmulatedOperator(BENCH, clock)
    operator.acts = {"lifting": lambda: done.append(clock.now())}
    operator.ignored = frozenset({"home"})
    operator.notify(OperatorMessage("home", "Is this home?", ("y", "n")))
    operator.notify(OperatorMessage("armed", "beep"))
    operator.notify(OperatorMessage("lifting", "lift the pendulum"))
    clock.wait_until(2.0)
    assert operator.read_input() == []
    assert done == [2.0]
    assert [event.name for event in operator.messages] == ["armed", "lifting"]


class Stage:
    def __init__(self):
        self.bench, self.clock = stand()
        self.operator = EmulatedOperator(self.bench, self.clock)

    def tell(self, name, seconds):
        """Tell, and let time pass, in which the operator is asked every 10 ms."""
        self.operator.notify(OperatorMessage(name))
        self.wait(seconds)

    def wait(self, seconds):
        for _ in range(round(100 * seconds)):
            self.clock.wait_until(self.clock.now() + 0.01)
            self.operator.read_input()

    @property
    def lean(self):
        return abs(self.bench.truth().phi)


def test_they_hold_until_they_may_let_go():
    stage = Stage()
    stage.tell("lift", 8.0)
    assert stage.bench.hand.holds
    assert stage.lean < np.radians(3.0)
    stage.tell("armed", 1.05)
    assert not stage.bench.hand.holds
    stage.wait(2.0)
    assert stage.lean > np.radians(20.0)


def test_they_steady_the_pendulum_then_let_go_and_press_the_button():
    stage = Stage()
    stage.bench.push(np.radians(200.0))
    stage.tell("hang", 6.0)
    assert stage.lean > np.radians(179.5)
    pressed = []
    stage.bench.watch(lambda: pressed.append(stage.bench.button))
    stage.tell("reference", 2.0)
    assert 90 <= sum(pressed) <= 110
    assert stage.bench.hand.idle
