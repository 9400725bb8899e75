"""The emulated operator by messages: words and acts after a reaction time."""

import numpy as np
import pytest

from equipoise.control.ticks import OperatorMessage
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.emulated_operator import REACTION_TIME, EmulatedOperator
from tests.rig.in_process import stand

pytestmark = pytest.mark.compiled_only

HOME = OperatorMessage("home", "Is this home?", ("y", "n"))


def test_it_types_the_first_answer_once_after_its_reaction_time():
    clock = VirtualClock()
    operator = EmulatedOperator(stand()[0], clock)
    operator.notify(HOME)
    clock.wait_until(REACTION_TIME[0] - 0.01)
    assert operator.read_input() == []
    clock.wait_until(REACTION_TIME[1] + 0.01)
    assert operator.read_input() == ["y"]
    assert operator.read_input() == []
    operator.ignored = frozenset({"home"})
    operator.notify(HOME)
    clock.wait_until(5.0)
    assert operator.read_input() == []


def test_its_hand_steadies_lifts_holds_and_lets_go_when_it_is_told():
    bench, clock = stand()
    operator = EmulatedOperator(bench, clock)

    def tell(name, seconds):
        """Tell, and let time pass, in which the operator is asked every 10 ms; return the lean."""
        operator.notify(OperatorMessage(name))
        for _ in range(round(100 * seconds)):
            clock.wait_until(clock.now() + 0.01)
            operator.read_input()
        return np.degrees(abs(bench.truth().phi))

    bench.push(np.radians(200.0))
    assert tell("hang", 6.0) > 179.5
    pressed = []
    bench.watch(lambda: pressed.append(bench.button))
    tell("reference", 2.0)
    assert 90 <= sum(pressed) <= 110
    assert bench.hand.idle
    assert tell("lift", 8.0) < 3.0
    assert bench.hand.holds
    tell("armed", 1.05)
    assert not bench.hand.holds
    assert tell("nothing", 2.0) > 20.0
