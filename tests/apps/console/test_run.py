"""The console through runs on the emulated rig in real time, in a real browser."""

import contextlib
import functools
import os
import re
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from equipoise.logs.run_log import RunLog
from equipoise.outcomes import Outcome, Phase
from tests.apps.console.browser import (
    browser,
    needs_browser,
    press_now,
    program,
    shown,
)

pytestmark = [needs_browser, pytest.mark.compiled_only, pytest.mark.slow]

STOP_LIMIT = 0.100  # from the press to the stop in the run's log [s]
ATTEMPTS = 4  # of a run, where the host withholds its processors
STALLS = {
    str(each) for each in (Outcome.TICK, Outcome.LINK, Outcome.ENCODER_STALE)
}  # causes of an end by the host
REFUSED = re.compile("^error: .*link to the robot")  # before anything moves
RESPONSES = ("Yes", "OK")
NOTE_THE_PRESS = """
const send = window.fetch;
window.fetch = (path, options) => {
  if (path === "/stop") window.pressed ??= performance.timeOrigin + performance.now();
  return send(path, options);
};
"""


class HostStallError(Exception):
    """The run ended because the host withheld its processors."""


def repeated_after_a_stall(test):
    """Run a test again if the host stalled: the run ends then as it should."""

    @functools.wraps(test)
    def repeated(tmp_path, **given):
        for attempt in range(ATTEMPTS):
            folder = tmp_path / str(attempt)
            folder.mkdir()
            try:
                return test(folder, **given)
            except HostStallError as stalled:
                sys.stdout.write(f"the host stalled: {stalled.__cause__}\n")
                if attempt == ATTEMPTS - 1:
                    raise
        return None

    return repeated


@contextlib.contextmanager
def console_of(folder, duration):
    """An emulated rig, a run on it, and a browser with its console."""
    log = folder / "run.mcap"
    with program("rig", "emulate", "--port", "0", "--seed", "3") as rig:
        robot, encoder = (rig.find(rf"{name} +(\S+://\S+)")[1] for name in ("robot", "encoder"))
        words = ("--robot", robot, "--encoder", encoder, "--duration", str(duration))
        with (
            program("deploy", *words, "--out", str(log), "--console") as run,
            browser() as page,
        ):
            page.get(run.find(r"(http://127\.0\.0\.1:\d+/\?token=\S+)")[1])
            page.execute_script(NOTE_THE_PRESS)
            try:
                yield run, rig, log, page
            except AssertionError as failed:
                ended = run.process.poll() is not None
                if ended and (any(map(REFUSED.search, run.lines)) or was_stalled(log)):
                    raise HostStallError from failed
                raise


def was_stalled(log):
    """Whether a rule on lateness ended the run; a stop by the operator is no such end."""
    return log.exists() and RunLog.load(log, damaged=True).outcome in STALLS


def question(page):
    return (shown(page, "#equipoise-question") or [""])[0]


def state(page):
    return (shown(page, "#equipoise-state") or [""])[0].split("\n")[0]


ACTS = {Phase.LIFTING.value: "lift", Phase.ARMED.value: "release"}


def answer_until(run, rig, page, ended):
    """Answer each question by its button, and act at the rig, until a condition holds."""
    asked, acted = [], set()
    end = time.monotonic() + 120.0
    while not ended():
        assert time.monotonic() < end, asked
        assert run.process.poll() is None, "\n".join(run.lines)
        text = question(page)
        new = text and asked[-1:] != [text]
        if new and any(press_now(page, label) for label in RESPONSES):
            asked.append(text)
        if (act := ACTS.get(state(page))) and act not in acted:
            acted.add(act)
            rig.process.stdin.write(act + "\n")
            rig.process.stdin.flush()
        time.sleep(0.05)


def pressed_at(page):
    """The time of the press on the run's clock [s]."""
    wall = page.execute_script("return window.pressed") / 1e3
    return wall - time.time() + time.monotonic()


def stop_delay(page, log):
    """The time from the press to the phase `stopping` in the run's log [s]."""
    events, name = RunLog.load(log, damaged=True).events, Phase.STOPPING.value
    return next(event.time for event in events if event.name == name) - pressed_at(page)


@repeated_after_a_stall
@pytest.mark.parametrize("phase", [Phase.HOMING, Phase.LIFTING, Phase.ARMED, Phase.BALANCING])
def test_a_stop_in_each_phase_reaches_the_loop_within_100_ms(tmp_path, phase):
    with console_of(tmp_path, 20.0) as (run, rig, log, page):
        answer_until(run, rig, page, lambda: state(page) == phase.value)
        page.find_element("tag name", "body").send_keys(" ")
        run.process.wait(40.0)
        delay = stop_delay(page, log)
        sys.stdout.write(f"{phase.value}: {1e3 * delay:.1f} ms\n")
        assert delay < STOP_LIMIT
        assert RunLog.load(log, damaged=True).end.outcome == "operator"


@repeated_after_a_stall
def test_a_console_that_is_killed_does_not_disturb_the_run(tmp_path):
    with console_of(tmp_path, 8.0) as (run, rig, log, page):
        answer_until(run, rig, page, lambda: state(page) == Phase.BALANCING.value)
        time.sleep(3.0)
        killed = time.monotonic()
        os.kill(console_process(run.process.pid), signal.SIGKILL)
        run.process.wait(40.0)
        logged = RunLog.load(log)
        assert logged.end.outcome == "lasted"
        ticks = logged.tables["tick"]
        around = np.abs(ticks["time"] - killed) < 0.5
        largest = 1e3 * ticks["late"][around].max()
        sys.stdout.write(f"largest lateness at the kill: {largest:.2f} ms\n")
        assert (ticks["late"][around] > 0.01).sum() == 0


def console_process(run):
    """The process of the console of a run: the child that has locked the file `console`."""
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if int((folder / "stat").read_text().rpartition(")")[2].split()[1]) != run:
                continue
            if any(os.readlink(each).endswith("/console") for each in (folder / "fd").iterdir()):
                return int(folder.name)
    raise AssertionError("no console runs")
