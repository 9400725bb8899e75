"""Hands that do what a run asks for."""

import numpy as np
import pytest

from equipoise.devices.operator import EmulatedOperator, Notice
from equipoise.devices.twin.operator_actions import NUDGE, operator_actions
from tests.devices.in_process import stand

pytestmark = pytest.mark.compiled_only


class Stage:
    def __init__(self):
        self.bench, self.clock = stand()
        self.operator = EmulatedOperator(self.clock, operator_actions(self.bench))

    def tell(self, name, seconds):
        """Tell, and let time pass, in which the operator is asked every 10 ms."""
        self.operator.notify(Notice(name))
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


def test_told_that_they_are_still_on_they_lift_again():
    stage = Stage()
    stage.tell("lift", 5.0)
    stage.tell("armed", 3.0)
    assert stage.lean > np.radians(20.0)
    stage.tell("disarmed", 6.0)
    assert stage.bench.hand.holds
    assert stage.lean < np.radians(3.0)


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


def test_they_nudge_a_pendulum_that_stands_by_itself():
    stage = Stage()
    stage.tell("lift", 8.0)
    rate = []
    stage.bench.watch(lambda: rate.append(abs(stage.bench.phi_dot)))
    stage.tell("nudge", 1.1)
    assert not stage.bench.hand.holds
    assert max(rate) > 0.9 * NUDGE
    stage.wait(1.0)
    assert stage.lean > np.radians(20.0)
