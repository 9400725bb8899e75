"""The picture of the rooms in docs/index.md shows the layers that lint-imports enforces."""

import re
import runpy
from pathlib import Path

FIGURES = Path(__file__).parents[1] / "docs" / "figures"


def test_the_committed_picture_is_that_of_the_layers():
    drawn = runpy.run_path(str(FIGURES / "rooms.py"))
    committed = (FIGURES / "rooms.svg").read_text(encoding="utf-8")
    again = "draw it again: python docs/figures/rooms.py"
    assert committed == drawn["draw"](), again
    rooms = re.findall(r'class="room">([^<]*)<', committed)
    package = FIGURES.parents[1] / "src" / "equipoise"
    assert all((package / room).is_dir() or (package / f"{room}.py").is_file() for room in rooms)
    modules = {path.stem for path in package.iterdir() if path.suffix == ".py"}
    folders = {path.parent.name for path in package.glob("*/__init__.py")}
    assert set(rooms) == (modules | folders) - {"__init__", "__main__"}
