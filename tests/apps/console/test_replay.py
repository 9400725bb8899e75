"""The replay: its time line and events, its page without a browser, and in one."""

import json
from dataclasses import replace
from http.cookiejar import CookieJar
from urllib.error import HTTPError
from urllib.request import HTTPCookieProcessor, Request, build_opener

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from equipoise.apps.console.replay import MAX_MARKS, Playback, ReplayPage, marks_of
from equipoise.logs.motion import Motion
from equipoise.outcomes import Phase
from equipoise.rig.explanation import explain
from equipoise.rig.run_controller import PHASES
from tests.apps.console.browser import (
    browser,
    needs_browser,
    press,
    program,
    requests,
    shown,
    wait_until,
)
from tests.logs.made_up import balanced_on_a_rig, changed_table, conditions

viser = pytest.importorskip("viser", reason="viser is not installed (extra console)")


def made():
    run = balanced_on_a_rig()
    run = changed_table(run, "tick", q=np.tile(run.conditions.arm.home, (901, 1)))
    event = np.zeros(1, run.tables["event"].dtype)
    event["time"], event["name"], event["text"] = 9.5, b"warning", b"The disk is nearly full."
    return replace(run, tables=dict(run.tables) | {"event": event})


RUN = made()
MOTION = Motion.of(RUN)
FIRST, LAST = float(MOTION.time[0]), MOTION.end


def test_it_plays_at_its_speed_pauses_at_the_end_and_begins_again():
    playback = Playback(MOTION)
    playback.advance(1.0)
    assert (playback.time, playback.playing) == (-2.0, False)
    playback.toggle()
    playback.speed = 0.5
    playback.advance(1.0)
    assert (playback.time, playback.playing) == (-1.5, True)
    playback.advance(99.0)
    assert (playback.time, playback.playing) == (LAST, False)
    playback.toggle()
    assert (playback.time, playback.playing) == (FIRST, True)


def test_a_step_pauses_and_visits_each_tick_once():
    playback = Playback(MOTION)
    playback.toggle()
    playback.jump(0.004)
    assert not playback.playing
    visited = []
    for ticks in (0, 1, -2):
        playback.step(ticks)
        visited.append(playback.time)
    assert visited == pytest.approx([0.0, 0.01, -0.01])
    playback.jump(FIRST)
    playback.step(-1)
    assert playback.time == FIRST


@given(st.lists(st.tuples(st.sampled_from("jsat"), st.floats(-20.0, 20.0)), max_size=20))
def test_the_position_is_always_in_the_run(actions):
    playback = Playback(MOTION)
    for name, value in actions:
        match name:
            case "j":
                playback.jump(value)
            case "s":
                playback.step(int(value))
            case "a":
                playback.advance(abs(value))
            case _:
                playback.toggle()
        assert FIRST <= playback.time <= LAST


def test_the_events_are_phases_warnings_and_the_causes_that_explain_names():
    marks = marks_of(RUN, MOTION)
    others = [(round(mark.time, 2), mark.name, mark.text) for mark in marks if not mark.cause]
    assert others == [
        (-6.0, "lifting", ""),
        (0.0, "balancing", ""),
        (2.01, "stopping", ""),
        (2.5, "warning", "The disk is nearly full."),
    ]
    causes = {(mark.name, mark.text) for mark in marks if mark.cause}
    assert causes == {(one.cause, one.evidence) for one in explain(RUN)}
    state = np.resize([PHASES.index(Phase.LIFTING), PHASES.index(Phase.BALANCING)], 901)
    many = changed_table(RUN, "tick", state=state)
    assert len(marks_of(many, Motion.of(many))) == MAX_MARKS


def test_texts_of_the_log_do_not_become_markup():
    evil = "<img src=x onerror=alert(1)>\x1b[2J"
    given = conditions(world="kst://" + evil).model_dump(include={"world"})
    run = replace(RUN, conditions=RUN.conditions.model_copy(update=given))
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        page = ReplayPage(server, run, evil)
        assert "<img" not in page._panel._state.content
        assert "\x1b" not in page._panel._state.content
        assert "&lt;img" in page._panel._state.content
    finally:
        server.stop()


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    RUN.save(path, command="test")
    return path


def test_the_page_is_behind_its_token_and_ends_with_the_verb(log):
    with program("log", "show", str(log), "--json") as replay:
        address = json.loads(replay.find(r"\{.*\}")[0])["replay"]
        assert address.startswith("http://127.0.0.1:")
        base = address.partition("/?")[0]
        opener = build_opener(HTTPCookieProcessor(CookieJar()))
        for wrong in (base, f"{base}/?token=wrong", f"{base}/toggle"):
            with pytest.raises(HTTPError, match="403"):
                opener.open(wrong, timeout=10.0)
        assert b'"/toggle"' in opener.open(address, timeout=10.0).read()
        key = Request(f"{base}/toggle", headers={"X-Equipoise": "1"})
        assert opener.open(key, timeout=10.0).status == 200
        assert replay.end() == 0


def time_of(page):
    """The position in the card of the state [s]."""
    (text,) = shown(page, "#equipoise-state") or ("t = nan s",)
    return float(text.replace("−", "-").partition("t = ")[2].partition(" s")[0])


@needs_browser
@pytest.mark.slow
def test_a_run_is_played_and_searched_in_the_browser(log):
    from selenium.webdriver import ActionChains

    with program("log", "show", str(log), "--json") as replay, browser() as page:
        address = json.loads(replay.find(r"\{.*\}")[0])["replay"]
        page.get(address)
        wait_until(lambda: shown(page, "#equipoise-state"), "replay")
        assert time_of(page) == -2.0
        press(page, "Play")
        wait_until(lambda: time_of(page) == 3.0, "end of the run")
        press(page, "start")
        wait_until(lambda: time_of(page) == -6.0, "start")
        ActionChains(page).send_keys(".").perform()
        wait_until(lambda: time_of(page) == -5.99, "step of a tick")
        ActionChains(page).send_keys(" ").perform()
        wait_until(lambda: time_of(page) > -5.8, "motion after the space bar")
        page.find_element("xpath", "//*[@role='tab'][contains(., 'Events')]").click()
        press(page, "+2.01 s")
        wait_until(lambda: abs(time_of(page) - 2.01) < 0.01, "jump")
        hosts = {each.split("/")[2] for each in requests(page) if each.startswith("http")}
        assert hosts == {address.split("/")[2]}
