"""Take the pictures of playground, console and replay for the documents, in Chromium.

    python docs/figures/screenshots.py

Needs the extra `test`, and Chromium with its driver (Debian: chromium, chromium-driver).
"""

import contextlib
import io
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from PIL import Image

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1]))

from tests.apps.console.browser import browser, press, shown  # noqa: E402
from tests.program import program, wait_until  # noqa: E402

WIDTH, HEIGHT = 1366, 910
"""Window of the browser [px]."""
PLAYGROUND = 1180
"""Height of a window that shows the table of the playground [px]."""
ADDRESS = r"(http://127\.0\.0\.1:\d+/\?token=\S+)"
PRESS = """
const buttons = [...document.querySelectorAll('button')].filter(e => e.checkVisibility());
buttons.find(e => !e.disabled && /^(Yes|OK)/.test(e.innerText.trim()))?.click();
"""
"""Script that answers a question of the run with yes."""
BALANCED = 9.0
"""Balancing time before the picture of the console [s]."""


@contextlib.contextmanager
def page_at(address: str, height: int = HEIGHT) -> Iterator[Any]:
    """Open a page, without viser's note on a missing graphics card."""
    with browser(WIDTH, height) as page:
        page.get(address)
        wait_until(lambda: shown(page, "#equipoise-state"), "page")
        note = "document.querySelector('.mantine-Notification-closeButton')"
        wait_until(lambda: page.execute_script(f"return {note}"), "note")
        page.execute_script(f"{note}.click()")
        yield page


def save(page: Any, name: str) -> None:
    """Save what the browser shows."""
    picture = Image.open(io.BytesIO(page.get_screenshot_as_png())).convert("RGB")
    picture.save(HERE / f"{name}.webp", quality=82, method=6)


def take_playground() -> None:
    """Take the playground in its first scene, after a push."""
    with program("play") as play, page_at(play.find(ADDRESS)[1], PLAYGROUND) as page:
        time.sleep(4.0)
        press(page, "push right")
        time.sleep(1.5)
        save(page, "play")


def take_console(folder: Path) -> Path:
    """Take the console of an emulated run; return the log of the run."""
    log = folder / "run.mcap"
    with program("rig", "emulate", "--port", "0", "--seed", "3") as rig:
        robot, encoder = (rig.find(rf"{name} +(\S+://\S+)")[1] for name in ("robot", "encoder"))
        words = ("--robot", robot, "--encoder", encoder, "--duration", "20", "--out", str(log))
        with program("console") as console, program("deploy", *words) as run:
            with page_at(console.find(ADDRESS)[1]) as page:
                while "balancing" not in "".join(shown(page, "#equipoise-state")):
                    if run.process.poll() is not None:
                        raise SystemExit("\n".join(run.lines))
                    page.execute_script(PRESS)
                    for phase, act in (("lifting", "lift"), ("armed", "release")):
                        if phase in shown(page, "#equipoise-state")[0]:
                            rig.process.stdin.write(f"{act}\n")
                            rig.process.stdin.flush()
                    time.sleep(0.2)
                time.sleep(BALANCED)
                save(page, "console")
            run.process.wait(60.0)
    return log


def take_replay(log: Path) -> None:
    """Take the replay of a run in its middle."""
    with program("log", "show", str(log)) as show, page_at(show.find(ADDRESS)[1]) as page:
        press(page, "Play")
        time.sleep(6.0)
        press(page, "Pause")
        time.sleep(1.0)
        save(page, "replay")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as room:
        take_playground()
        take_replay(take_console(Path(room)))
