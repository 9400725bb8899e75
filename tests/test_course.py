"""The notebooks of the course run; each check says *not solved* before its solution, *right* after.

A wrong answer is refused with a hint: the first notebook has one for each exercise.
"""

import re
import shutil
from pathlib import Path

import pytest

pytestmark = pytest.mark.full

jupytext = pytest.importorskip("jupytext", reason="jupytext is not installed (extra course)")
nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed (extra course)")

COURSE = Path(__file__).parents[1] / "course"
NOTEBOOKS = sorted(path.stem for path in COURSE.glob("[0-9]_*.py"))
LONGEST = 600.0
"""Time for a cell [s]."""
WRONG = (
    "w2 = 1.0",
    "def holds(seed):\n    return False",
    "friction = 'viscous'",
    "doubled_after = 1",
)
"""A wrong answer to each exercise of the first notebook."""
SAYS = re.compile(r"Exercise (\d+): (.*)")


def with_answers(name, wrong=()):
    """Return a notebook that checks each exercise as it is, with wrong answers, and solved."""
    book = jupytext.read(COURSE / f"{name}.py")
    found = jupytext.read(COURSE / "solutions" / f"{name}.py").cells
    solutions = [
        cell for cell in found if cell.cell_type == "code" and "Solutions of" not in cell.source
    ]
    wrong, cells, exercise = list(wrong), [], False
    for cell in book.cells:
        cells.append(cell)
        if "exercise" in cell.metadata.get("tags", ()):
            exercise = True
        elif exercise and "check(" in cell.source:
            if wrong:
                answer = cell.copy()
                answer.update(source=wrong.pop(0))
                cells += [answer, cell.copy()]
            cells += [solutions.pop(0), cell.copy()]
            exercise = False
    assert solutions == wrong == []
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number}"
    book.cells = cells
    return book


def run(book, folder, answers):
    """Run a notebook; its checks say the answers to each exercise, and a figure is shown."""
    shutil.copy(COURSE / "checks.py", folder)
    nbclient.NotebookClient(
        book, timeout=LONGEST, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()
    outputs = [output for cell in book.cells for output in cell.get("outputs", ())]
    said = [found for output in outputs for found in SAYS.findall(output.get("text", ""))]
    assert len(said) >= 3 * len(answers)
    for i, (_, text) in enumerate(said):
        assert text.startswith(answers[i % len(answers)])
    assert any("image/png" in output.get("data", {}) for output in outputs)


@pytest.mark.compiled_only
@pytest.mark.parametrize(
    ("name", "wrong"),
    [(NOTEBOOKS[0], WRONG), *(pytest.param(n, (), marks=pytest.mark.slow) for n in NOTEBOOKS[1:])],
)
def test_a_notebook_runs(tmp_path, monkeypatch, name, wrong):
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel chooses the one of notebooks
    answers = ("not solved yet", "not yet", "right.") if wrong else ("not solved yet", "right.")
    run(with_answers(name, wrong), tmp_path, answers)
