"""The notebooks of the course run; each check says *not solved* before, *right* after."""

import re
import shutil
import time
from pathlib import Path

import pytest

jupytext = pytest.importorskip("jupytext", reason="jupytext is not installed (extra course)")
nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed (extra course)")

COURSE = Path(__file__).parents[1] / "course"
NOTEBOOKS = sorted(path.stem for path in COURSE.glob("[0-9]_*.py"))
LONGEST = 600.0
"""Time for all notebooks together, with their exercises run unsolved and solved [s]."""
SAYS = re.compile(r"Exercise (\d+): (.*)")


def with_solutions(name):
    """Return a notebook in which each exercise is run and checked as it is, and then solved."""
    book = jupytext.read(COURSE / f"{name}.py")
    found = jupytext.read(COURSE / "solutions" / f"{name}.py").cells
    solutions = [
        cell for cell in found if cell.cell_type == "code" and "Solutions of" not in cell.source
    ]
    cells, exercise = [], None
    for cell in book.cells:
        cells.append(cell)
        if "exercise" in cell.metadata.get("tags", ()):
            exercise = cell
        elif exercise is not None and "check(" in cell.source:
            again = cell.copy()
            cells += [solutions.pop(0), again]
            exercise = None
    assert solutions == []
    assert exercise is None
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number}"
    book.cells = cells
    return book


def run(name, folder):
    """Run a notebook; return it, with its outputs, and what the checks said."""
    book = with_solutions(name)
    shutil.copy(COURSE / "checks.py", folder)
    nbclient.NotebookClient(
        book, timeout=LONGEST, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()
    said = [SAYS.findall(text) for text in map(printed, book.cells)]
    return book, [found[0] for found in said if found]


def printed(cell):
    return "".join(output.get("text", "") for output in cell.get("outputs", ()))


def assert_taught(said):
    """Each exercise: first it is not solved, with its solution it is right."""
    assert len(said) >= 6
    for (number, before), (same, after) in zip(said[::2], said[1::2], strict=True):
        assert number == same
        assert before.startswith("not solved yet")
        assert after == "right."


def forms(book):
    """Return the forms in which values and figures are shown."""
    outputs = [output for cell in book.cells for output in cell.get("outputs", ())]
    return {form for output in outputs for form in output.get("data", {})}


@pytest.fixture(autouse=True)
def figures_in_the_notebook(monkeypatch):
    """Let the kernel choose its own place for figures."""
    monkeypatch.delenv("MPLBACKEND", raising=False)


@pytest.mark.compiled_only
def test_the_first_notebook_runs(tmp_path):
    book, said = run(NOTEBOOKS[0], tmp_path)
    assert_taught(said)
    assert {"text/html", "image/png"} <= forms(book)


def test_each_notebook_has_its_solutions():
    assert len(NOTEBOOKS) == 5
    assert all(with_solutions(name) for name in NOTEBOOKS)


@pytest.mark.slow
@pytest.mark.compiled_only
def test_all_notebooks_run_within_ten_minutes(tmp_path):
    begun = time.monotonic()
    for name in NOTEBOOKS:
        book, said = run(name, tmp_path)
        assert_taught(said)
        assert {"text/html", "image/png"} & forms(book)
    assert time.monotonic() - begun < LONGEST
