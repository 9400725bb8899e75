"""Take the pictures of playground, console and replay for the documents, in Chromium.

    python docs/figures/screenshots.py

Needs the extra `test`, and Chromium with its driver (Debian: chromium, chromium-driver).
"""

import contextlib
import io
import re
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from PIL import Image

from equipoise.console.scene import PERIOD
from equipoise.log.recorder import Recorder, open_recorder, share
from equipoise.log.run_log import RunLog

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1]))

from tests.console.browser import browser, press, shown  # noqa: E402
from tests.program import program, wait_until  # noqa: E402

WIDTH, HEIGHT = 1366, 910
"""Window of the browser [px]."""
PLAYGROUND = 1180
"""Height of a window that shows the table of the playground [px]."""
ADDRESS = r"(http://127\.0\.0\.1:\d+/\?token=\S+)"
BALANCED = r"balanced (9|\d\d)\."
"""State of the console in its picture, as an expression."""
LAST = 3.0
"""Age of the oldest rows that a ring takes [s]: those of the lift come at once."""


@contextlib.contextmanager
def page_at(address: str, height: int = HEIGHT) -> Iterator[Any]:
    """Open a page, without viser's note on a missing graphics card."""
    with browser(WIDTH, height) as page:
        page.get(address)
        wait_until(lambda: shown(page, "#equipoise-state"), "page")
        note = "document.querySelector('.mantine-Notification-closeButton')"
        wait_until(lambda: page.execute_script(f"return {note}"), "note")
        page.execute_script(f"{note}.click()")
        time.sleep(60.0)  # the scene fades in, slowly on a busy machine
        yield page


def save(page: Any, name: str) -> None:
    """Save what the browser shows, its last picture: while it draws, it answers too late."""
    page.execute_script("window.requestAnimationFrame = () => 0")
    time.sleep(2.0)
    picture = Image.open(io.BytesIO(page.get_screenshot_as_png())).convert("RGB")
    picture.save(HERE / f"{name}.webp", quality=82, method=6)


def take_playground() -> None:
    """Take the playground in its first scene, after a push."""
    with program("play") as play, page_at(play.find(ADDRESS)[1], PLAYGROUND) as page:
        wait_until(lambda: "balancing" in "".join(shown(page, "#equipoise-state")), "balance")
        press(page, "push right")
        time.sleep(1.5)
        save(page, "play")


def make_log(folder: Path) -> Path:
    """Return the log of a run on an emulated rig, in virtual time."""
    log = folder / "run.mcap"
    words = ("--robot", "twin:nominal", "--duration", "60", "--seed", "3", "--out", str(log))
    with program("deploy", *words) as run:
        run.process.wait()
    return log


def take_console(log: Path) -> None:
    """Take the console of a run that plays a log, and so keeps its time on a busy machine."""
    run, over = RunLog.load(log), threading.Event()
    with share(run.conditions) as folder, program("console") as console:
        _, recorder = open_recorder(folder)
        with page_at(console.find(ADDRESS)[1]) as page:
            player = threading.Thread(target=play, args=(run, recorder, over))
            player.start()
            state = lambda: "".join(shown(page, "#equipoise-state"))  # noqa: E731
            wait_until(lambda: re.search(BALANCED, state()), "balance")
            save(page, "console")
            over.set()
            player.join()


def play(run: RunLog, recorder: Recorder, over: threading.Event) -> None:
    """Write the rows of a log into the rings of a run, in real time from the release."""
    shift = time.monotonic() - run.release
    rows = {name: run.tables[name].copy() for name in recorder.rings}
    for table in rows.values():
        for column in {"time", "sent", "taken", "received"} & set(table.dtype.names):
            table[column] += shift
    while not over.wait(PERIOD):
        recorder.take()
        now = time.monotonic()
        for name, table in rows.items():
            due = table["time"] <= now
            for row in table[due & (table["time"] > now - LAST)].tolist():
                values = dict(zip(table.dtype.names, row, strict=True))
                recorder.rings[name].push(**values)
            rows[name] = table[~due]
        recorder.pulse["time"], recorder.pulse["ticks"] = now, 1.0


def take_replay(log: Path) -> None:
    """Take the replay of a run in its middle."""
    with program("log", "show", str(log)) as show, page_at(show.find(ADDRESS)[1]) as page:
        press(page, "Play")  # from the first tick: it has played to the end by now
        time.sleep(23.0)
        press(page, "Pause")
        time.sleep(1.0)
        save(page, "replay")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as room:
        log = make_log(Path(room))
        take_playground()
        take_console(log)
        take_replay(log)
