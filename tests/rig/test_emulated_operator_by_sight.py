"""The operator who sees the bench only, at a made-up run."""

import itertools

import numpy as np
import pytest

from equipoise.model.arms.posture import along_x
from equipoise.rig import simulated_rig
from equipoise.rig.emulated_operator import SightedOperator
from equipoise.worlds.twin.hand import draw_hand_params
from tests.rig.in_process import ARM, stand

pytestmark = pytest.mark.compiled_only


class Stage:
    def __init__(self):
        self.bench, self.clock = stand()
        self.said, self.presses = [], 0
        self.onlooker = SightedOperator(
            self.bench,
            swing_out_time=3.0,
            say=lambda words: self.said.append(words.split()[0]),
        )
        self.bench.watch(self.onlooker.look)
        self.bench.body.servo(True)

    def press(self):
        end = self.clock.now() + 20.0
        while "presses" not in self.said:
            assert self.clock.now() < end
            self.wait(0.01)

    def wait(self, seconds):
        self.clock.wait_until(self.clock.now() + seconds)

    def until(self, doing, longest=60.0):
        end = self.clock.now() + longest
        while self.onlooker.doing != doing:
            assert self.clock.now() < end, f"{self.onlooker.doing} for too long"
            self.wait(0.01)

    def move(self, x):
        """Move the flange to x in 0.8 s, as a self-test does."""
        start = self.bench.truth().x
        s = np.clip(np.arange(0.0, 1.0, 0.005) / 0.8, 0.0, 1.0)
        way = start + (x - start) * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        for q in along_x(ARM, way):
            self.bench.body.target(ARM.with_held(q))
            self.wait(0.005)


@pytest.fixture
def tested():
    """A stage after the self-test's move."""
    stage = Stage()
    stage.press()
    stage.move(0.04)
    assert stage.onlooker.doing == "tests"
    return stage


def test_the_button_is_pressed_where_all_rests_and_again_until_the_arm_moves():
    stage, presses = Stage(), []
    stage.bench.watch(lambda: presses.append(stage.bench.button))
    stage.wait(2.5)
    assert not any(presses)
    stage.wait(20.0)
    assert 3 <= np.count_nonzero(np.diff(np.array(presses, int)) > 0) <= 8
    assert stage.said == ["presses"]


def test_away_from_home_nothing_is_pressed():
    stage = Stage()
    stage.move(0.1)
    stage.wait(10.0)
    assert stage.onlooker.doing == "waits"
    assert stage.said == []


def test_a_swinging_pendulum_is_stopped_by_hand_before_the_button_is_pressed():
    stage = Stage()
    stage.bench.push(np.radians(200.0))
    stage.until("steadies", 10.0)
    stage.press()
    assert stage.said == ["stops", "lets", "presses"]


def test_after_the_self_test_it_waits_lifts_holds_and_lets_go(tested):
    began = tested.clock.now()
    tested.until("holds")
    assert tested.clock.now() - began > 2.5
    tested.wait(4.0)
    assert abs(tested.bench.truth().phi) < np.radians(3.0)
    tested.until("released", 21.0)
    tested.until("fallen", 5.0)
    assert tested.said == ["presses", "sees", "lifts", "lets", "sees"]


def test_for_an_arm_that_does_not_answer_it_lifts_once_more_and_begins_again(tested):
    tested.until("fallen")
    tested.until("holds")
    tested.until("fallen")
    tested.until("steadies")
    tested.until("waits")
    assert abs(tested.bench.truth().phi) > np.radians(179.0)


def test_after_a_run_it_takes_hold_of_the_pendulum_and_begins_again(tested):
    tested.until("released")
    tested.move(0.08)  # not enough to catch it
    tested.until("steadies")
    tested.until("waits")
    tested.move(0.0)
    tested.wait(10.0)
    assert tested.said.count("presses") == 2
    assert tested.said.count("lifts") == 1


@pytest.fixture
def standing(tested, monkeypatch):
    """The same, let go so calmly that the pendulum stands by its dry friction."""

    def calm(random, **more):
        manner = draw_hand_params(random, **more)
        return manner._replace(amplitude=np.zeros_like(manner.amplitude))

    monkeypatch.setattr(simulated_rig, "draw_hand_params", calm)
    tested.until("released")
    return tested


def test_a_pendulum_that_stands_by_itself_is_nudged(standing):
    standing.wait(2.5)
    assert abs(standing.bench.truth().phi) < np.radians(0.1)
    standing.until("fallen", 4.0)
    assert standing.said[-3:] == ["lets", "nudges", "sees"]


def test_a_pendulum_above_an_arm_that_moves_is_left_alone(standing, monkeypatch):
    truth = standing.bench.truth()
    # Three looks in turn: to one side, to the other, at rest; where it began all the time.
    balanced = itertools.cycle([0.05, -0.05, 0.0])
    monkeypatch.setattr(
        standing.bench, "truth", lambda: truth._replace(phi=0.0, x_dot=next(balanced))
    )
    standing.wait(10.0)
    assert standing.said[-1] == "lets"
