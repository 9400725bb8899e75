"""The console through a run on the emulated rig in real time, in a real browser."""

import time

import pytest

from equipoise.logs.run_log import RunLog
from equipoise.outcomes import Phase
from tests.apps.console.browser import browser, needs_browser, press_now, program, shown

pytestmark = [needs_browser, pytest.mark.compiled_only, pytest.mark.slow]

STOP_LIMIT = 0.100  # from the press to the stop in the run's log [s]
NOTE_THE_PRESS = """
const send = window.fetch;
window.fetch = (path, options) => {
  if (path === "/stop") window.pressed ??= performance.timeOrigin + performance.now();
  return send(path, options);
};
"""
ACTS = {Phase.LIFTING.value: "lift", Phase.ARMED.value: "release"}


def state(page):
    return (shown(page, "#equipoise-state") or [""])[0].split("\n")[0]


def answer_until_balancing(run, rig, page):
    """Answer each question by its button, and act at the rig."""
    acted, end = set(), time.monotonic() + 120.0
    while (now := state(page)) != Phase.BALANCING.value:
        assert time.monotonic() < end
        assert run.process.poll() is None, "\n".join(run.lines)
        if not press_now(page, "Yes"):
            press_now(page, "OK")
        if (act := ACTS.get(now)) and act not in acted:
            acted.add(act)
            rig.process.stdin.write(act + "\n")
            rig.process.stdin.flush()
        time.sleep(0.2)


def test_a_run_is_answered_and_stopped_from_the_browser_within_100_ms(tmp_path):
    log = tmp_path / "run.mcap"
    with program("console") as console, program("rig", "emulate", "--port", "0") as rig:
        robot, encoder = (rig.find(rf"{name} +(\S+://\S+)")[1] for name in ("robot", "encoder"))
        words = ("--robot", robot, "--encoder", encoder, "--duration", "20", "--out", str(log))
        with program("deploy", *words) as run, browser() as page:
            page.get(console.find(r"(http://127\.0\.0\.1:\d+/\?token=\S+)")[1])
            page.execute_script(NOTE_THE_PRESS)
            answer_until_balancing(run, rig, page)
            page.find_element("tag name", "body").send_keys(" ")
            run.process.wait(40.0)
            pressed = page.execute_script("return window.pressed") / 1e3
            ended = RunLog.load(log, damaged=True)
    assert ended.end.outcome == "operator"
    stops = (event.time for event in ended.events if event.name == Phase.STOPPING.value)
    assert next(stops) - (pressed - time.time() + time.monotonic()) < STOP_LIMIT
