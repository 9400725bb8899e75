"""The page of the console in a real browser, before a run that the test plays."""

import threading
import time

import numpy as np
import pytest

from equipoise.arm.iiwa import iiwa7
from equipoise.console import live
from equipoise.log.recorder import open_recorder, push_event, share
from equipoise.outcomes import Phase
from equipoise.rig.interfaces import OperatorMessage
from equipoise.rig.processes import OperatorProxy
from equipoise.rig.run_controller import PHASES
from tests.console.browser import browser, needs_browser, press, requests, shown
from tests.log.made_up import rig_conditions
from tests.program import wait_until

pytestmark = [needs_browser, pytest.mark.slow]

ARM = iiwa7()
STOP_LIMIT = 0.100  # from the press to the word of the run [s]
STOP = "equipoise-stop"


class PlayedRun:
    """A run that ticks in a thread, and notes its operator's words."""

    def __init__(self, recorder):
        self.recorder, self.operator = recorder, OperatorProxy(recorder)
        self.words, self.phase, self.ended = [], Phase.AT_HOME, threading.Event()

    def tick(self):
        begin, home = time.monotonic(), np.array(ARM.home)
        while not self.ended.wait(0.01):
            now = time.monotonic()
            self.words += [(time.time(), word) for word in self.operator.read_input()]
            phi = 0.05 * np.sin(now - begin)
            state = PHASES.index(self.phase)
            recorder = self.recorder
            recorder.take()
            recorder.reply.push(time=now, q=home)
            recorder.tick.push(time=now, late=0.001, state=state, u=0.5, estimated_phi=phi, q=home)

    def ask(self, text, *answers):
        self.operator.notify(OperatorMessage("checklist", text, answers))


@pytest.fixture
def played(monkeypatch):
    """A run, and the address of the console that shows it."""
    monkeypatch.setattr(live, "stay_aside", lambda: None)
    addresses, ended = [], threading.Event()
    with share(rig_conditions(policy_name="<b>run</b>", arm=ARM)) as folder:
        run = PlayedRun(open_recorder(folder)[1])
        monkeypatch.setattr(live, "live_runs", lambda: [folder])
        served = ("127.0.0.1", 0, addresses.append, ended.is_set)
        serving = threading.Thread(target=live.serve, args=served)
        threads = [threading.Thread(target=run.tick), serving]
        for thread in threads:
            thread.start()
        try:
            yield run, wait_until(lambda: addresses, "console")[0]
        finally:
            run.ended.set()
            ended.set()
            for thread in threads:
                thread.join(10.0)


def test_questions_and_stop(played):
    run, address = played
    with browser() as page:
        page.get(address)
        run.ask("Is the fence closed? Type fence.", "fence")
        wait_until(lambda: shown(page, "#equipoise-question"), "question")
        assert shown(page, "#equipoise-question")[0].startswith("Is the fence closed?")
        assert "<b>run</b>" in shown(page, "#equipoise-state")[0]  # as text
        assert Phase.AT_HOME.value in shown(page, "#equipoise-state")[0]

        press(page, "Yes: fence")
        wait_until(lambda: run.words, "answer")
        assert [word for _, word in run.words] == ["fence"]
        wait_until(lambda: not shown(page, "#equipoise-question"), "end of the question")
        markup = OperatorMessage("notice", "<img src=x onerror=alert(1)>")
        push_event(run.recorder.event, 0.0, markup)
        push_event(run.recorder.event, 0.0, OperatorMessage("run", "Run 3 of 10; all survived."))
        run.phase = Phase.BALANCING
        wait_until(lambda: "balancing" in shown(page, "#equipoise-state")[0], "phase")
        assert "Run 3 of 10" in shown(page, "#equipoise-state")[0]
        wait_until(lambda: "<img" in "".join(shown(page, "#equipoise-messages")), "message as text")
        wait_until(lambda: "balanced " in shown(page, "#equipoise-state")[0], "length")
        run.phase = Phase.STOPPING
        wait_until(lambda: "stopping" in shown(page, "#equipoise-state")[0], "rest")
        # A busy page may miss the homing of the next run.
        push_event(run.recorder.event, 0.0, OperatorMessage("run", "Run 4 of 10; all survived."))
        wait_until(lambda: "Run 4 of 10" in shown(page, "#equipoise-state")[0], "next run")
        assert "balanced" not in shown(page, "#equipoise-state")[0]

        page.execute_script(
            "const send = window.fetch; window.fetch = (path, options) => { if (path === '/stop') "
            "window.pressed = performance.timeOrigin + performance.now(); "
            "return send(path, options); };"
        )
        for act in (lambda b: b.send_keys(" "), lambda _: page.find_element("id", STOP).click()):
            run.words.clear()
            act(page.find_element("tag name", "body"))
            arrived, word = wait_until(lambda: run.words, "stop", 5.0)[0]
            assert word == "stop"
            assert arrived - page.execute_script("return window.pressed") / 1e3 < STOP_LIMIT
        origin = address.partition("?")[0]
        assert all(url.startswith((origin, "data:", "blob:")) for url in requests(page))


def test_on_a_phone_stop_lies_in_the_scene_and_the_panel_below(played):
    _, address = played
    with browser(500, 844) as page:
        page.get(address)
        wait_until(lambda: shown(page, "#equipoise-readings"), "readings")
        width, height, *boxes = page.execute_script(
            "const box = (css) => document.querySelector(css).getBoundingClientRect();"
            "return [innerWidth, innerHeight, box('canvas'), box('#equipoise-stop'), "
            "box('#equipoise-state')]"
        )
        scene, stop, state = boxes
        assert scene["width"] == width
        assert 0.3 * height < scene["height"] <= state["top"]
        assert 0.0 <= stop["left"] < stop["right"] < width
        assert scene["top"] < stop["top"] < stop["bottom"] < state["top"]
        assert 0.0 <= state["left"] < state["right"] <= width
        at = [stop["left"] + 0.5 * stop["width"], stop["top"] + 0.5 * stop["height"]]
        script = "return document.elementFromPoint(...arguments).closest('button').id"
        assert page.execute_script(script, *at) == STOP
