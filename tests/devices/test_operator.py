"""The emulated operator: what is told becomes words and acts, after a reaction time."""

from equipoise.devices.clocks import VirtualClock
from equipoise.devices.operator import REACTION, EmulatedOperator, Notice, Operator


def test_it_is_an_operator():
    assert isinstance(EmulatedOperator(VirtualClock()), Operator)


def test_it_types_the_first_answer_once_after_its_reaction_time():
    clock = VirtualClock()
    operator = EmulatedOperator(clock)
    operator.notify(Notice("home", "Is this home?", ("y", "n")))
    clock.wait_until(REACTION[0] - 0.01)
    assert operator.read_input() == []
    clock.wait_until(REACTION[1] + 0.01)
    assert operator.read_input() == ["y"]
    assert operator.read_input() == []


def test_it_does_with_its_hands_what_an_event_asks_for_and_leaves_others_alone():
    clock, done = VirtualClock(), []
    operator = EmulatedOperator(clock, {"lifting": lambda: done.append(clock.now())})
    operator.notify(Notice("armed", "beep"))
    operator.notify(Notice("lifting", "lift the pendulum"))
    clock.wait_until(2.0)
    assert operator.read_input() == []
    assert done == [2.0]
    assert [event.name for event in operator.told] == ["armed", "lifting"]


def test_answers_come_in_the_order_of_the_questions_that_are_due():
    clock = VirtualClock()
    operator = EmulatedOperator(clock, seed=5)
    for word in ("one", "two", "three"):
        operator.notify(Notice("ask", answers=(word,)))
        clock.wait_until(clock.now() + REACTION[1])
    clock.wait_until(clock.now() + REACTION[1])
    assert operator.read_input() == ["one", "two", "three"]


def test_equal_seeds_react_equally():
    def typed(seed):
        clock = VirtualClock()
        operator = EmulatedOperator(clock, seed=seed)
        operator.notify(Notice("ask", answers=("y",)))
        while not operator.read_input():
            clock.wait_until(clock.now() + 0.001)
        return clock.now()

    assert typed(1) == typed(1)
    assert typed(1) != typed(2)
