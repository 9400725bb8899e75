"""The emulated operator: what is told becomes words and acts, after a reaction time."""

from equipoise.devices.clocks import VirtualClock
from equipoise.devices.operator import REACTION, EmulatedOperator, Operator, Told


def test_it_is_an_operator():
    assert isinstance(EmulatedOperator(VirtualClock()), Operator)


def test_it_types_the_first_answer_once_after_its_reaction_time():
    clock = VirtualClock()
    operator = EmulatedOperator(clock)
    operator.tell(Told("home", "Is this home?", ("y", "n")))
    clock.wait_until(REACTION[0] - 0.01)
    assert operator.words() == []
    clock.wait_until(REACTION[1] + 0.01)
    assert operator.words() == ["y"]
    assert operator.words() == []


def test_it_does_with_its_hands_what_an_event_asks_for_and_leaves_others_alone():
    clock, done = VirtualClock(), []
    operator = EmulatedOperator(clock, {"lifting": lambda: done.append(clock.now())})
    operator.tell(Told("armed", "beep"))
    operator.tell(Told("lifting", "lift the pendulum"))
    clock.wait_until(2.0)
    assert operator.words() == []
    assert done == [2.0]
    assert [event.name for event in operator.told] == ["armed", "lifting"]


def test_answers_come_in_the_order_of_the_questions_that_are_due():
    clock = VirtualClock()
    operator = EmulatedOperator(clock, seed=5)
    for word in ("one", "two", "three"):
        operator.tell(Told("ask", answers=(word,)))
        clock.wait_until(clock.now() + REACTION[1])
    clock.wait_until(clock.now() + REACTION[1])
    assert operator.words() == ["one", "two", "three"]


def test_equal_seeds_react_equally():
    def typed(seed):
        clock = VirtualClock()
        operator = EmulatedOperator(clock, seed=seed)
        operator.tell(Told("ask", answers=("y",)))
        while not operator.words():
            clock.wait_until(clock.now() + 0.001)
        return clock.now()

    assert typed(1) == typed(1)
    assert typed(1) != typed(2)
