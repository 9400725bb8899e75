"""The time line of a replay: where it plays, stops, steps and jumps to."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from equipoise.apps.console.playback import SPEEDS, Playback

TICKS = np.arange(-500, 300) * 0.01


@pytest.fixture
def playback():
    return Playback(TICKS, (-5.0, 3.0), (-2.0, 3.0))


def test_it_begins_paused_at_the_start_of_the_shown_part(playback):
    assert (playback.time, playback.playing) == (-2.0, False)
    playback.advance(1.0)
    assert playback.time == -2.0


@pytest.mark.parametrize("speed", SPEEDS.values())
def test_it_plays_at_its_speed(playback, speed):
    playback.speed = speed
    playback.play()
    playback.advance(0.5)
    assert playback.time == pytest.approx(-2.0 + 0.5 * speed)
    assert playback.playing


def test_it_pauses_at_the_end_of_the_shown_part_and_plays_it_again(playback):
    playback.show(-1.0, 1.0)
    playback.play()
    playback.advance(9.0)
    assert (playback.time, playback.playing) == (1.0, False)
    playback.play()
    assert (playback.time, playback.playing) == (-1.0, True)


def test_a_step_pauses_at_the_start_of_a_tick(playback):
    playback.play()
    playback.jump(0.004)
    playback.step(0)
    assert (playback.time, playback.playing) == (0.0, False)
    playback.step(1)
    assert playback.time == 0.01
    playback.step(-2)
    assert playback.time == -0.01
    playback.jump(-5.0)
    playback.step(-1)
    assert playback.time == TICKS[0]
    playback.jump(3.0)
    playback.step(1)
    assert playback.time == TICKS[-1]


def test_steps_visit_each_tick_once_also_where_ticks_are_missing():
    ticks = np.array([0.0, 0.01, 0.05, 0.06])
    playback = Playback(ticks, (0.0, 0.06), (0.0, 0.06))
    visited = [playback.time]
    for _ in range(3):
        playback.step(1)
        visited.append(playback.time)
    np.testing.assert_array_equal(visited, ticks)


def test_a_jump_out_of_the_shown_part_shows_more_of_the_run(playback):
    playback.jump(-4.0)
    assert (playback.time, playback.begin, playback.end) == (-4.0, -4.0, 3.0)
    playback.jump(99.0)
    assert (playback.time, playback.end) == (3.0, 3.0)


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["jump", "show", "step", "advance", "play"]), st.floats(-20.0, 20.0)
        ),
        max_size=20,
    )
)
def test_the_position_is_always_in_the_shown_part_and_that_in_the_run(actions):
    playback = Playback(TICKS, (-5.0, 3.0), (-2.0, 3.0))
    for name, value in actions:
        match name:
            case "jump":
                playback.jump(value)
            case "show":
                playback.show(value, value + 1.0)
            case "step":
                playback.step(int(value))
            case "advance":
                playback.advance(abs(value))
            case _:
                playback.play()
        assert -5.0 <= playback.begin <= playback.time <= playback.end <= 3.0
