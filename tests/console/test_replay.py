"""The replay: its time line and events, and its page without a browser."""

import numpy as np
import pytest
import viser

from equipoise.console.replay import ReplayPage, marks_of
from equipoise.log.motion import Motion
from equipoise.rig.explanation import explain
from tests.log.made_up import balanced_on_a_rig, changed_table


def made():
    run = balanced_on_a_rig()
    run = changed_table(run, "tick", q=np.tile(run.conditions.arm.home, (901, 1)))
    event = {"time": [9.5], "name": [b"warning"], "text": [b"The disk is nearly full."]}
    return changed_table(run, "event", **event)


RUN = made()
MOTION = Motion.of(RUN)
FIRST, LAST = float(MOTION.time[0]), MOTION.end


@pytest.fixture(scope="module")
def page():
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield ReplayPage(server, RUN, "run.mcap")
    server.stop()


def test_it_plays_pauses_at_the_end_begins_again_and_steps(page):
    assert (page.time, page.playing) == (-2.0, False)
    page.begin()  # as the first browser does
    page.advance(0.5)
    assert (page.time, page.playing) == (-1.5, True)
    page.advance(99.0)
    page.begin()
    assert (page.time, page.playing) == (LAST, False)
    page.toggle()
    assert (page.time, page.playing) == (FIRST, True)
    page.jump(0.004)
    assert not page.playing
    visited = []
    for ticks in (0, 1, -2):
        page.step(ticks)
        visited.append(page.time)
    assert visited == pytest.approx([0.0, 0.01, -0.01])


def test_the_events_are_phases_warnings_and_the_causes_that_explain_names():
    marks = [(round(time, 2), name) for time, name in marks_of(RUN, MOTION)]
    causes = {f"{one.cause} (a cause of the end)" for one in explain(RUN)}
    assert causes == {name for _, name in marks if name.endswith("of the end)")}
    assert [mark for mark in marks if mark[1] not in causes] == [
        (-6.0, "lifting"),
        (0.0, "balancing"),
        (2.01, "stopping"),
        (2.5, "warning: The disk is nearly full."),
    ]
