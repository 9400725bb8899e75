"""Hands that do what a run asks for."""

import numpy as np
import pytest

from equipoise.devices.operator import EmulatedOperator, Told
from equipoise.devices.twin.hands import Hands
from tests.devices.in_process import stand

pytestmark = pytest.mark.compiled_only


class Stage:
    def __init__(self, **more):
        self.bench, self.clock = stand()
        self.hands = Hands(self.bench, **more)
        self.operator = EmulatedOperator(self.clock, self.hands.acts)

    def tell(self, name, seconds):
        """Tell, and let time pass, in which the operator is asked every 10 ms."""
        self.operator.tell(Told(name))
        self.wait(seconds)

    def wait(self, seconds):
        for _ in range(round(100 * seconds)):
            self.clock.wait_until(self.clock.now() + 0.01)
            self.operator.words()

    @property
    def lean(self):
        return abs(self.bench.truth().phi)


def test_they_hold_until_they_may_let_go_and_not_longer_than_they_like():
    stage = Stage()
    stage.tell("lift", 25.0)
    assert stage.bench.hand.holds
    assert stage.lean < np.radians(3.0)
    stage.tell("armed", 1.05)
    assert stage.hands.released is not None
    assert not stage.bench.hand.holds


def test_they_hold_for_as_long_as_they_like():
    stage = Stage()
    stage.tell("lift", 1.0)
    likes = stage.bench.hand.arrives() + stage.hands.manner.holding
    stage.tell("armed", 30.0)
    assert stage.hands.released == pytest.approx(likes, abs=0.002)


def test_told_that_they_are_still_on_they_hold_on_or_lift_again():
    stage = Stage()
    stage.tell("lift", 1.0)
    stage.tell("armed", 1.0)
    stage.tell("disarmed", 25.0)
    assert stage.hands.released is None
    assert stage.lean < np.radians(3.0)
    stage.tell("armed", 3.0)
    assert stage.hands.released is not None
    stage.tell("disarmed", 6.0)
    assert stage.lean < np.radians(3.0)


def test_they_let_the_pendulum_hang_and_press_the_button():
    stage = Stage()
    stage.bench.push(np.radians(200.0))
    stage.tell("hang", 6.0)
    assert stage.lean > np.radians(179.5)
    assert stage.bench.hand.idle
    pressed = []
    stage.bench.watch(lambda: pressed.append(stage.bench.button))
    stage.tell("reference", 2.0)
    assert 90 <= sum(pressed) <= 110


@pytest.mark.parametrize("side", ["front", "back"])
def test_they_lift_from_the_side_that_is_given(side):
    stage = Stage(side=side)
    stage.tell("lift", 1.5)
    assert stage.hands.manner.side == side
